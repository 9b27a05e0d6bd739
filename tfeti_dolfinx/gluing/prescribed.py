"""Dirichlet values, spread over all torn copies of a node."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from dolfinx import fem

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.checks import checked_type, shown
from tfeti_dolfinx.compat import prescribed_values, space_of
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mesh.spaces import component_of, described, is_same_space

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
        InputError: Conditions do not fit V, contradict each other at a node, or are not finite.
    """
    bcs = checked_conditions(bcs, dofs.V)
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


def checked_conditions(
    bcs: Iterable[fem.DirichletBC], V: fem.FunctionSpace
) -> list[fem.DirichletBC]:
    """The conditions as a list. Collective.

    Raises:
        InputError: They are no Dirichlet conditions on V or a component of V, or one of them has
            no unknowns, or some that V has not.
    """
    conditions = listed_conditions(bcs)
    count = np.zeros(len(conditions), dtype=np.int64)
    with raised_on_all_ranks(V.mesh.comm):
        for number, bc in enumerate(conditions):
            _check_space(f"Dirichlet condition {number}", bc, V)
            count[number] = len(bc.dof_indices()[0])
    total = V.mesh.comm.allreduce(count)
    if not np.all(total):
        raise InputError(
            f"Dirichlet condition {int(np.argmin(total))} holds nowhere: it has no unknowns on any "
            "rank; expected at least one"
        )
    return conditions


def listed_conditions(bcs: Iterable[fem.DirichletBC]) -> list[fem.DirichletBC]:
    """The conditions as a list. Not collective.

    Raises:
        InputError: They are nothing that gives Dirichlet conditions.
    """
    if isinstance(bcs, fem.DirichletBC) or not isinstance(bcs, Iterable):
        raise InputError(
            f"bcs is {shown(bcs)}; expected a list of Dirichlet conditions, [] for none"
        )
    conditions = list(bcs)
    for number, bc in enumerate(conditions):
        what = f"Dirichlet condition {number}"
        checked_type(bc, fem.DirichletBC, what, "a dolfinx.fem.DirichletBC")
    return conditions


def _check_space(what: str, bc: fem.DirichletBC, V: fem.FunctionSpace) -> None:
    space = space_of(bc)
    if space.mesh is not V.mesh._cpp_object:
        raise InputError(
            f"{what} is on another mesh; expected a space on decomposition.mesh, the torn mesh"
        )
    own = component_of(V, list(space.component()))
    if own is None or not is_same_space(space, own):
        raise InputError(
            f"{what} is on {described(space)}; expected the space of a, "
            f"{described(V._cpp_object)}, or V.sub(i) of it"
        )
    size = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
    highest = int(bc.dof_indices()[0].max(initial=-1))
    if highest >= size:
        raise InputError(
            f"{what} prescribes the unknown {highest}, but this rank has {size}; expected "
            "unknowns that were located in the space of a"
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
