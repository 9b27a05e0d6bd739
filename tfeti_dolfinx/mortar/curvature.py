"""The smooth surface that straight facets stand for: how far it lies beside them."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations_with_replacement

import numpy as np

from tfeti_dolfinx.common.arrays import Array, sum_rows
from tfeti_dolfinx.common.parallel import Exchange, any_rank, owner_of
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.facets import FacetKind, Facets, points
from tfeti_dolfinx.mortar.segments import tangents
from tfeti_dolfinx.mortar.tolerances import SEARCH


def with_curvature(facets: Facets, dofs: TornDofs, kind: FacetKind) -> Facets:
    """The same facets with the curvature of a smooth surface through their vertices. Collective.

    At each vertex the heights of its neighbours over its tangent plane are fitted by z = a·t + ½
    tᵀKt, a the error of the averaged normal, by least squares of what each neighbour says of the
    curvature. What remains of the normal equations without a is added up over the vertices of a
    facet, so that a vertex at the rim, whose neighbours lie to one side, leaves to the others what
    it does not know. Vertices at edges say nothing. Facets whose geometry has a higher degree are
    curved themselves, and stay as they are.
    """
    normals, groups = facets.vertex_normals, facets.vertices.ravel()
    cosine = np.einsum("nvg,ng->nv", normals, facets.normal)
    turns = bool(np.any(cosine < 1.0 - SEARCH.turned))
    if kind.geometry.degree > 1 or not any_rank(dofs.comm, turns):
        return facets
    n, v, gdim = normals.shape
    axes = tangents(normals.reshape(-1, gdim)).reshape(n, v, gdim - 1, gdim)
    M, b = _normal_equations(facets.corners, normals, axes)
    sharp = (cosine <= SEARCH.edge).astype(float)
    exchange = Exchange(dofs.comm, owner_of(dofs.group_offsets, groups))
    vertex, place = np.unique(exchange.send(groups), return_inverse=True)
    M, b, sharp = (
        sum_rows(place, exchange.send(part.reshape(n * v, *part.shape[2:])), len(vertex))
        for part in (M, b, sharp)
    )
    S, r = _without_slopes(M, b, gdim - 1)
    S[sharp > 0.0], r[sharp > 0.0] = 0.0, 0.0
    S, r = (exchange.answer(part[place]).reshape(n, v, *part.shape[1:]) for part in (S, r))
    return replace(facets, curvature=_on_facets(facets, axes, S, r))


def beside(kind: FacetKind, facets: Facets, rows: Array, xi: Array) -> Array:
    """Vectors, ``(m, gdim)``, from points of facets, ``(m, tdim)``, to the smooth surface.

    What a quadratic surface is beside its interpolant in the vertices, −½ Σφ_i (x_i − x)ᵀK(x_i −
    x), along the facet's normal.
    """
    x, K = facets.x[rows], facets.curvature[rows]
    d = x[:, : kind.hats.size] - points(kind.geometry, x, xi)[:, None]
    height = -0.5 * np.sum(kind.hats.values(xi) * np.sum((d @ K) * d, axis=2), axis=1)
    return height[:, None] * facets.normal[rows]


def _monomials(t: Array) -> Array:
    """½ tᵀKt = Σ_k m_k(t) K_k, K_k the entries of K on and above the diagonal."""
    n = t.shape[-1]
    return np.stack(
        [
            (0.5 if i == j else 1.0) * t[..., i] * t[..., j]
            for i, j in combinations_with_replacement(range(n), 2)
        ],
        axis=-1,
    )


def _normal_equations(x: Array, normals: Array, axes: Array) -> tuple[Array, Array]:
    """Return matrices and right sides of the least squares for a and K at each vertex, a first.

    Directions count as on the tangent plane, lengths as in space: then a circle has its own
    curvature, however far its points are apart. Shapes ``(n, v, s, s)`` and ``(n, v, s)``.
    """
    d = x[:, None] - x[:, :, None]  # of vertex v to the others
    length = np.linalg.norm(d, axis=3)
    t = np.einsum("nvwg,nvkg->nvwk", d, axes)
    flat = np.linalg.norm(t, axis=3)
    u = t / np.where(flat > 0.0, flat, np.inf)[..., None]
    other = length > 0.0
    inverse = np.divide(1.0, length, out=np.zeros_like(length), where=other)
    rows = np.concatenate((u * inverse[..., None], _monomials(u)), axis=3)
    height = np.einsum("nvwg,nvg->nvw", d, normals) * inverse**2
    return rows.swapaxes(2, 3) @ rows, np.einsum("nvwi,nvw->nvi", rows, height)


def _without_slopes(M: Array, b: Array, count: int) -> tuple[Array, Array]:
    """The normal equations of K alone: the Schur complement of a, the first ``count`` unknowns."""
    on_a = np.linalg.pinv(M[:, :count, :count], hermitian=True)
    eliminated = M[:, count:, :count] @ on_a
    S = M[:, count:, count:] - eliminated @ M[:, :count, count:]
    r = b[:, count:] - np.einsum("gij,gj->gi", eliminated, b[:, :count])
    return S, r


def _on_facets(facets: Facets, axes: Array, S: Array, r: Array) -> Array:
    """Curvature of facets from the equations of their vertices, shape ``(n, gdim, gdim)``."""
    k = axes.shape[2]
    own = tangents(facets.normal)
    turn = _rotations(np.einsum("nvig,njg->nvij", axes, own))
    # K at a vertex, turn K turnᵀ, from the entries of K on the facet
    unit = np.zeros((S.shape[-1], k, k))
    for entry, (i, j) in enumerate(combinations_with_replacement(range(k), 2)):
        unit[entry, i, j] = unit[entry, j, i] = 1.0
    i, j = np.array(list(combinations_with_replacement(range(k), 2))).T
    turn = turn[:, :, None]
    P = (turn @ unit @ turn.swapaxes(3, 4))[..., i, j].swapaxes(2, 3)
    value, vector = np.linalg.eigh(np.sum(P.swapaxes(2, 3) @ S @ P, axis=1))
    right = np.einsum("nvki,nvk->ni", P, r)
    along = np.einsum("nik,ni->nk", vector, right)
    along = np.divide(along, value, out=np.zeros_like(along), where=value > SEARCH.unknown)
    K = np.einsum("nik,nk,iab->nab", vector, along, unit, optimize=True)
    return own.swapaxes(1, 2) @ K @ own


def _rotations(A: Array) -> Array:
    """Return the rotations of tangents of one plane to those of another, from their products."""
    if A.shape[-1] == 1:
        return np.ones_like(A)
    cosine, sine = A[..., 0, 0] + A[..., 1, 1], A[..., 1, 0] - A[..., 0, 1]
    length = np.hypot(cosine, sine)
    turn = np.array([[cosine, -sine], [sine, cosine]]) / np.where(length > 0.0, length, 1.0)
    return np.moveaxis(turn, (0, 1), (-2, -1))
