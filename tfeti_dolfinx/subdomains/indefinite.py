"""Why a stiffness is not positive definite beside its kernel: by rounding, or by its form."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array

from tfeti_dolfinx.arrays import TINY, Array
from tfeti_dolfinx.subdomains.factor import CholeskyFactor, NotPositiveDefiniteError
from tfeti_dolfinx.subdomains.kplus import regular_matrix

# Of the diagonal: what this makes positive definite was indefinite by rounding only, which in
# assembly and factor comes to 1e-14 or so.
ROUNDING = 1e-12
# Of the energy that springs between its nodes get from a motion: an elastic form gives it more
# than this, however flat the subdomain or small its shear modulus; rounding leaves 1e-12 or less.
NO_ENERGY = 1e-10
# so many motions without energy are counted at most
COUNTED = 20


def why_indefinite(K: Any, R: Array, fixing_dofs: Array, x: Array, prefix: str) -> str:
    """Say what is wrong with a stiffness whose K_ρ has no Cholesky factor, or a useless one.

    Args:
        K: Stiffness, its diagonal positive, shape ``(n, n)``.
        R: Kernel, shape ``(n, r)``.
        fixing_dofs: Unknowns of the fixing nodes.
        x: Points of the nodes.
        prefix: Prefix of the factor's PETSc options.

    Raises:
        FactorError: It could not be found out, say for want of memory.
    """
    diagonal = K.diagonal()
    shifted = regular_matrix(K, R, fixing_dofs) + diags_array(ROUNDING * diagonal)
    try:
        factor = CholeskyFactor(shifted, prefix)
    except NotPositiveDefiniteError:
        return "the stiffness is not positive semidefinite; expected a linear elastic form"
    free = _motions_without_energy(K, R, x, factor.solve)
    factor.destroy()
    if free:
        count = f"{'at least ' if free == COUNTED else ''}{free} motion{'s' * (free > 1)}"
        return (
            f"the form gives no energy to {count} beside the {R.shape[1]} of a rigid body that it "
            "leaves free; expected a linear elastic form of the whole strain, with quadrature "
            "that is fine enough (one point leaves hourglasses to quadrilaterals and hexahedra)"
        )
    extents = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    flat = extents[0] / max(extents[-1], TINY)
    return (
        "the stiffness is indefinite by rounding: its softest deformations are lost beside its "
        f"stiffest (its length is {flat:.0e} of its thickness, its diagonal spans a factor of "
        f"{diagonal.max() / diagonal.min():.0e}); expected subdomains and cells that are less "
        "flat, or moduli that differ less"
    )


def check_rank(K: Any, R: Array, x: Array, solve: Callable[[Array], Array]) -> None:
    """Raise if K⁺ blows up a motion that is not rigid and that K gives no energy.

    Pivots that should be 0 are positive where rounding makes them so. It takes one solve.

    Args:
        K: Stiffness, shape ``(n, n)``.
        R: Kernel, shape ``(n, r)``.
        x: Points of the nodes.
        solve: K⁺ b, shapes ``(n,)``.

    Raises:
        NotPositiveDefiniteError: It does.
    """
    u = _beside(R, solve(_beside(R, _drawn(K.shape[0], 1)[:, 0])))
    energy, rounding = float(u @ (K @ u)), ROUNDING * float(u @ (K.diagonal() * u))
    if energy > rounding:
        return
    stretches = _springs(K, x) @ u
    if abs(energy) <= NO_ENERGY * (float(stretches @ stretches) + rounding):
        raise NotPositiveDefiniteError("a pivot is zero but for rounding")


def _motions_without_energy(K: Any, R: Array, x: Array, solve: Callable[[Array], Array]) -> int:
    """Count motions beside the kernel that springs resist and K does not, up to ``COUNTED``.

    Args:
        K: Stiffness, shape ``(n, n)``.
        R: Kernel, shape ``(n, r)``.
        x: Points of the nodes.
        solve: Inverse of a K_ρ that is regular, shapes ``(n, q)``.
    """
    U = _drawn(K.shape[0], min(COUNTED, K.shape[0] - R.shape[1]))
    for _ in range(2):  # subspace iteration: what it looks for stands out by 1e8 or more
        U = np.linalg.qr(_beside(R, solve(U)))[0]
    energies, turn = np.linalg.eigh(U.T @ (K @ U))
    U = U @ turn
    # what springs hardly resist, in flat cells or where nodes hang together by a point, is lost
    resisted = np.sum((_springs(K, x) @ U) ** 2, axis=0)
    resisted += ROUNDING * np.sum(U * (K.diagonal()[:, None] * U), axis=0)
    return int(np.sum(np.abs(energies) <= NO_ENERGY * resisted))


def _drawn(n: int, count: int) -> Array:
    return np.random.default_rng(0).standard_normal((n, count))


def _beside(R: Array, u: Array) -> Array:
    """The part that is orthogonal to the kernel."""
    return u - R @ (R.T @ u)


def _springs(K: Any, x: Array) -> csr_array:
    """Return the stretches of springs between all pairs of nodes that share a cell.

    Springs resist what an elastic body resists, and about as much: a rod of volume V, length h and
    modulus E has the stiffness EV/h². Entries of K are as large as that for the shortest way
    across a cell. Of a scalar field springs resist differences.

    Returns:
        Times the root of the stiffness, shape ``(pairs, n)``.
    """
    bs, entries = K.shape[0] // len(x), K.tocoo()
    row, column = (index // bs for index in entries.coords)
    upper = row < column
    numbers = row[upper].astype(np.int64) * len(x) + column[upper]
    pairs, which = np.unique(numbers, return_inverse=True)
    size = np.bincount(which, np.abs(entries.data[upper]), minlength=len(pairs))
    i, j = np.divmod(pairs, len(x))
    along = x[j] - x[i]
    length = np.maximum(np.linalg.norm(along, axis=1), TINY)
    shortest = np.full(len(x), np.inf)
    for end in (i, j):
        np.minimum.at(shortest, end, length)
    direction = along / length[:, None] if bs > 1 else np.ones((len(pairs), 1))
    root = np.sqrt(size) * np.minimum(shortest[i], shortest[j]) / length
    values = (root[:, None] * direction).ravel()
    rows = np.tile(np.repeat(np.arange(len(pairs)), bs), 2)
    columns = (node[:, None] * bs + np.arange(bs) for node in (j, i))
    at = (rows, np.concatenate([numbers.ravel() for numbers in columns]))
    return csr_array(coo_array((np.append(values, -values), at), shape=(len(pairs), K.shape[0])))
