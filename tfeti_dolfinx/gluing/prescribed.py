"""Dirichlet values, spread over all torn copies of a node."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from dolfinx import fem

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.compat import is_on_mesh, prescribed_values
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.dofs import TornDofs

AGREEMENT = 1e-10


@dataclass(frozen=True)
class Prescribed:
    """Components that Dirichlet conditions prescribe, for the owned groups.

    Attributes:
        flag: Whether a component is prescribed, shape ``(g, bs)``.
        value: Its value, 0 where it is not, shape ``(g, bs)``.
    """

    flag: Array
    value: Array


def prescribe(dofs: TornDofs, bcs: Sequence[fem.DirichletBC]) -> Prescribed:
    """Collect Dirichlet values and spread them to all copies of their nodes. Collective.

    Raises:
        InputError: A condition is on another mesh, conditions contradict each other at a node, or
            a value is not finite.
    """
    _check_mesh(dofs, bcs)
    size = dofs.V.dofmap.index_map.size_local * dofs.bs
    values = prescribed_values(bcs, size)
    low = np.fmin.reduce(values, axis=0, initial=np.inf)
    high = np.fmax.reduce(values, axis=0, initial=-np.inf)
    low = dofs.reduce(dofs.to_primal(low).reshape(-1, dofs.bs), np.minimum, np.inf)
    high = dofs.reduce(dofs.to_primal(high).reshape(-1, dofs.bs), np.maximum, -np.inf)
    flag = low <= high
    with raised_on_all_ranks(dofs.comm):
        _check_finite(bcs)
        _check_agreement(low, high, flag)
    return Prescribed(flag=flag, value=np.where(flag, low, 0.0))


def _check_mesh(dofs: TornDofs, bcs: Sequence[fem.DirichletBC]) -> None:
    for number, bc in enumerate(bcs):
        if not is_on_mesh(bc, dofs.V.mesh):
            raise InputError(
                f"Dirichlet condition {number} is on another mesh; expected a space on "
                "decomposition.mesh, the torn mesh"
            )


def _check_finite(bcs: Sequence[fem.DirichletBC]) -> None:
    for number, bc in enumerate(bcs):
        value = bc.g.x.array if hasattr(bc.g, "x") else bc.g.value
        if not np.all(np.isfinite(value)):
            raise InputError(f"Dirichlet condition {number} has a value that is not finite")


def _check_agreement(low: Array, high: Array, flag: Array) -> None:
    scale = np.abs(np.concatenate((low[flag], high[flag]))).max(initial=0.0)
    spread = np.subtract(high, low, out=np.zeros_like(low), where=flag)
    wrong = spread > AGREEMENT * scale
    if not np.any(wrong):
        return
    group, component = np.argwhere(wrong)[0]
    raise InputError(
        f"Dirichlet conditions contradict each other: component {component} of a node is "
        f"prescribed as {low[group, component]} and as {high[group, component]} "
        f"(at {wrong.sum()} components of nodes on this rank)"
    )
