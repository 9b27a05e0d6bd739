"""The law of a homogeneous, isotropic body, read from the stiffness of its finite elements."""

from __future__ import annotations

from typing import Any

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.boundary.steklov import Law
from tfeti_dolfinx.boundary.surface import Surface
from tfeti_dolfinx.errors import InputError

# Of the largest entry: what rounding and quadrature of a constant stress leave
SAME = 1e-7


def law_of(K: Any, surface: Surface, name: str) -> Law:
    """μ and ν of the constant stress σ that linear displacements have.

    Where a body has them and nothing else, its nodes get the forces of σn on the surface alone.

    Args:
        K: Stiffness of finite elements, shape ``(d n, d n)``.
        surface: The surface of the body, its points those of all n nodes.
        name: Name for messages.

    Raises:
        InputError: K is not that of such a body.
    """
    x = surface.panels.x
    d = x.shape[1]
    if not np.all(np.isfinite(K.data)) or K.diagonal().min() <= 0.0:
        raise InputError(
            f"{name}: boundary elements take the law of a body from the bilinear form, which has "
            "no elasticity there; expected it on all bodies"
        )
    y = x - x.mean(axis=0)
    # u_i = y_j for all i and j, and translations
    linear = np.einsum("ki,nj->nkij", np.eye(d), y).reshape(d * len(x), d * d)
    moved = np.hstack((linear, np.tile(np.eye(d), (len(x), 1)) * np.abs(y).max()))
    forces = K @ moved
    C = (linear.T @ forces[:, : d * d] / surface.panels.volume).reshape(d, d, d, d)
    law = _isotropic(C)
    expected = np.zeros_like(forces)
    stress = law.stress(np.eye(d * d).reshape(d * d, d, d))
    expected[:, : d * d] = np.einsum("lki,ni->nkl", stress, surface.normals).reshape(-1, d * d)
    most = SAME * np.max(abs(K) @ np.abs(moved))
    if not (law.mu > 0.0 and -1.0 < law.nu < 0.5 and np.abs(forces - expected).max() <= most):
        raise InputError(
            f"{name}: boundary elements need one homogeneous, isotropic law, and nothing beside "
            "it such as springs or masses; the bilinear form has something else there. Expected "
            "constant moduli, or finite elements for this volume"
        )
    return law


def _isotropic(C: Array) -> Law:
    """μ and ν of a tensor that is isotropic."""
    mu, lmbda = float(C[0, 1, 0, 1]), float(C[0, 0, 1, 1])
    return Law(mu, lmbda / (2.0 * (lmbda + mu)) if lmbda + mu > 0.0 else np.nan)
