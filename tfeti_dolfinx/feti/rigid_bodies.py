"""Rigid motions: bodies, their names, the kernel and its null spaces."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from mpi4py import MPI
from scipy.linalg import qr
from scipy.sparse import (
    block_diag,
    bsr_array,
    coo_array,
    csc_array,
    csr_array,
    diags_array,
    eye_array,
    hstack,
    vstack,
)
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.parallel import bcast_from_root
from tfeti_dolfinx.subdomains.factor import CholeskyFactor
from tfeti_dolfinx.subdomains.subdomains import Subdomains

# --- Dense algebra on parts of sparse matrices with few columns -------------------------------


def parts_of_columns(A: csr_array) -> Iterator[tuple[Array, Array, Array]]:
    """Columns that meet in rows, these rows, and the dense matrix there; part by part.

    Args:
        A: Shape ``(n, c)``.
    """
    columns = csc_array(A)
    columns.sort_indices()
    touched = csr_array(
        (np.ones(columns.nnz), columns.indices, columns.indptr), shape=columns.shape[::-1]
    )
    _, label = connected_components(touched @ touched.T, directed=False)
    order = np.argsort(label, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        if len(own):
            part = columns[:, own]
            rows = np.unique(part.indices)
            yield own, rows, csr_array(part)[rows].toarray()


def spread(rows: Array, dense: Array, n: int) -> csr_array:
    """Return a dense matrix on some of n rows."""
    width = dense.shape[1]
    places = np.repeat(rows, width), np.tile(np.arange(width), len(rows))
    return csr_array((dense.ravel(), places), shape=(n, width))


def side_by_side(parts: list[csr_array], n: int) -> csr_array:
    """Matrices of n rows, maybe none, one after the other."""
    return csr_array(hstack([csr_array((n, 0)), *parts]))


def by_parts(A: csr_array, change: Callable[[Array], Array]) -> csr_array:
    """Columns made of those of each part, as by ``change`` of its dense matrix.

    Args:
        A: Shape ``(n, c)``.
        change: From a dense matrix to one of as many rows.
    """
    n = A.shape[0]
    changed = [spread(rows, change(dense), n) for _, rows, dense in parts_of_columns(A)]
    return side_by_side(changed, n)


def orthonormal_columns(A: csr_array) -> csr_array:
    """Return an orthonormal basis of the span of independent columns."""
    return by_parts(A, lambda dense: np.linalg.qr(dense)[0])


# --- Motions of bodies ------------------------------------------------------------------------

# Stiffness, as a share of the stiffest motion of the same body, that counts as none: rounding
# makes 1e-15 of it, and pins on neighbouring nodes of a fine mesh hold a turn by 1e-9.
NULL = 1e-13
# Components of more coordinates than this are looked at by a sparse factor: the time of a dense
# eigenproblem grows with the cube of its size.
DENSE = 500
# Shift of that factor: above rounding, below the softest chain of a thousand bodies.
SHIFT = 1e-12
# Inverse iterations, each of which damps what is not null by SHIFT over its stiffness, so that
# even the softest chain is gone after a few; and vectors at first, doubled if all are null.
SWEEPS, BLOCK = 4, 32
# Eigenvalue of a projector, 0 or 1 but for rounding, from which on it is 1.
HALF = 0.5
# Stiffness given to directions outside the space, and where those inside, at most 1, end.
OUTSIDE, INSIDE = 2.0, 1.5


@dataclass(frozen=True)
class Motions:
    """A space of motions of bodies, each of k coordinates.

    Attributes:
        single: Orthonormal directions of each body, as columns, shape ``(bodies, k, k)``.
        free: Which of them the body can take alone, shape ``(bodies, k)``.
        stiffness: What holds each of them, as a share of the body's stiffest motion, its
            neighbours at rest, shape ``(bodies, k)``.
        joint: Motions of several bodies together, scipy CSR, shape ``(bodies * k, c)``.
    """

    single: Array
    free: Array
    stiffness: Array
    joint: csr_array

    @cached_property
    def alone(self) -> csr_array:
        """The motions of single bodies as columns, shape ``(bodies * k, a)``."""
        return csr_array(block_diagonal(self.single)[:, np.flatnonzero(self.free.ravel())])

    @property
    def none(self) -> Motions:
        """The space without motions."""
        nothing, held = np.zeros_like(self.free), np.full(self.free.shape, OUTSIDE)
        return Motions(self.single, nothing, held, csr_array((self.free.size, 0)))

    @property
    def count(self) -> int:
        """Number of motions."""
        return int(self.free.sum()) + self.joint.shape[1]


def block_diagonal(blocks: Array) -> csr_array:
    """Square blocks of shape ``(n, k, k)`` as one sparse matrix."""
    n, k = blocks.shape[:2]
    index = np.arange(n + 1)
    return csr_array(bsr_array((blocks, index[:-1], index), shape=(n * k, n * k)))


def diagonal_blocks(A: csr_array, k: int) -> Array:
    """Diagonal blocks of a sparse matrix, shape ``(n, k, k)``."""
    n = A.shape[0] // max(k, 1)
    entries = A.tocoo()
    row, column = entries.coords
    inside = row // max(k, 1) == column // max(k, 1)
    blocks = np.zeros((n, k, k))
    row, column = row[inside], column[inside]
    np.add.at(blocks, (row // max(k, 1), row % max(k, 1), column % max(k, 1)), entries.data[inside])
    return blocks


def unsprung(springs: Array) -> Motions:
    """Return motions that springs do not resist.

    Args:
        springs: Projector onto what they resist, shape ``(bodies, k, k)``.
    """
    values, vectors = np.linalg.eigh(springs)
    none = csr_array((springs.shape[0] * springs.shape[1], 0))
    return Motions(vectors, values < HALF, values, none)


def unresisted(gram: csr_array, within: Motions, below: float = NULL) -> Motions:
    """Return motions of a space of single bodies' motions that rows do not resist.

    What a body can do alone is found body by body. On what is left the rows' Gram matrix has
    unit diagonal blocks; its null space is that of connected components of bodies.

    Args:
        gram: JᵀJ of the rows, shape ``(bodies * k,) * 2``.
        within: The space to look in; its joint motions are not looked at.
        below: Motions of a single body held by less than this share of its stiffest motion are
            taken in too; those of several bodies must be free (and may have parts in those).
    """
    k = within.free.shape[1]
    V = block_diagonal(within.single)
    kept = diags_array(within.free.ravel().astype(float))
    whole = csr_array(V.T @ gram @ V)
    A = csr_array(kept @ whole @ kept)
    largest, at_all = (_largest(matrix, k) for matrix in (A, whole))
    # rows that hold only what is not in the space leave their rounding here
    grip = largest > NULL * at_all
    scale = diags_array(np.repeat(np.where(grip, np.where(grip, largest, 1.0) ** -0.5, 0.0), k))
    A = csr_array(scale @ A @ scale)
    blocks = diagonal_blocks(A, k)
    # what is not in the space is held; twice the stiffest motion keeps it apart in the order
    blocks[:, np.arange(k), np.arange(k)] += np.where(within.free, 0.0, OUTSIDE)
    stiffness, vectors = np.linalg.eigh(blocks)
    held = (stiffness > NULL) & (stiffness < INSIDE)
    # coordinates in which every body alone resists all its motions alike
    U = block_diagonal(vectors * (np.where(held, stiffness, 1.0) ** -0.5)[:, None, :])
    U = csr_array(U[:, np.flatnonzero(held.ravel())])
    joint = scale @ (U @ _null_space(csr_array(U.T @ A @ U), np.nonzero(held)[0]))
    single = within.single @ vectors
    return Motions(single, stiffness <= below, np.maximum(stiffness, 0.0), csr_array(V @ joint))


def _largest(A: csr_array, k: int) -> Array:
    """Return the largest eigenvalue of each diagonal block."""
    return np.asarray(np.linalg.eigvalsh(diagonal_blocks(A, k)).max(axis=1, initial=0.0))


def _null_space(A: csr_array, body: Array) -> csr_array:
    """Null space of a Gram matrix with unit blocks, by components of bodies."""
    if A.shape[0] == 0:
        return csr_array((0, 0))
    members = csr_array(
        (np.ones(len(body)), (body, np.arange(len(body)))), shape=(body.max() + 1, len(body))
    )
    strong = csr_array((abs(A.data) > NULL, A.indices, A.indptr), shape=A.shape)
    _, label = connected_components(members @ strong @ members.T, directed=False)
    component = label[body]
    order = np.argsort(component, kind="stable")
    cuts = np.flatnonzero(np.diff(component[order])) + 1
    columns = []
    for own in np.split(order, cuts):
        if body[own[0]] == body[own[-1]]:
            continue  # a body alone: nothing is left free of it
        null = _component_null(csr_array(A[own][:, own]))
        columns.append(spread(own, null, A.shape[0]))
    return side_by_side(columns, A.shape[0])


def _component_null(A: csr_array) -> Array:
    """Null space of a Gram matrix: dense if it is small, else by inverse iteration on blocks."""
    n = A.shape[0]
    if n <= DENSE:
        values, vectors = np.linalg.eigh(A.toarray())
        return np.asarray(vectors[:, values <= NULL * n])
    factor, size = CholeskyFactor(csr_array(A + SHIFT * eye_array(n))), BLOCK
    while True:
        X = np.random.default_rng(0).standard_normal((n, size))
        for _ in range(SWEEPS):
            X = np.linalg.qr(np.stack([factor.solve(x) for x in X.T], axis=1))[0]
        values, vectors = np.linalg.eigh(X.T @ (A @ X))
        null = values <= NULL * n
        if not null[-1] or size == n:  # the block holds more than the null space
            factor.destroy()
            return np.asarray(X @ vectors[:, null])
        size = min(2 * size, n)


# --- Rigid motions of bodies in kernel coordinates --------------------------------------------

# Share of a motion's square that lies outside a subdomain's kernel, and so moves a spring:
# kernels beside weak springs are inexact, and a share is the square of an angle.
SPRUNG = 1e-8
# Work of a body's load that counts as none, as a share of the largest that loads of this size
# could do (what users balance by hand is seldom exact), and of that of any body (rounding).
BALANCE, ROUNDING = 1e-9, 1e-14
# Eigenvalue of the modes' Gram matrix, as a share of the largest, that is none: on nodes of a line
# or a point some mode is no motion of its own, and only rounding is left of it.
DEPENDENT = 1e-12


class Bodies:
    """Motions of the bodies, in coordinates in which every motion has the mean square 1.

    Args:
        subdomains: This rank's Blocks. The constructor is collective.
        first: This rank's first kernel coordinate.
        dimension: Kernel coordinates of all ranks, r.

    Attributes:
        count: Number of bodies on all ranks.
        k: Candidate modes of each.
        frames: Modes' coefficients of each coordinate, shape ``(bodies, k, k)``.
        metric: Sums of the modes' products over a body's nodes, shape ``(bodies, k, k)``.
        nodes: Number of nodes of each body, copies counted once, shape ``(bodies,)``.
        motions: Kernel coordinates of the motions, scipy CSR, shape ``(r, bodies * k)``.
        size: Their Gram matrices, shape ``(bodies, k, k)``.
        springs: Projectors onto motions that springs resist, shape ``(bodies, k, k)``.
        loads: ‖f‖ of each body, shape ``(bodies,)``.
        negligible: Work of each body's load, on a motion of mean square 1, that counts as none,
            shape ``(bodies,)``.
    """

    def __init__(self, subdomains: Subdomains, first: int, dimension: int) -> None:
        self._subdomains, comm = subdomains, subdomains.comm
        self.count, self.k = subdomains.num_bodies, subdomains.num_modes
        self.metric = subdomains.modes_metric()
        self.nodes = self.metric[:, :1, :1].max(axis=(1, 2), initial=1.0)
        self.frames = bcast_from_root(comm, _frames(self.metric / self.nodes[:, None, None]))
        self.springs = bcast_from_root(comm, self._springs(subdomains.modes_outside()))
        inside = _replicated(subdomains.modes_in_kernel, first, dimension, comm)
        self.motions = csr_array(inside @ block_diagonal(self.frames))
        self.size = diagonal_blocks(csr_array(self.motions.T @ self.motions), self.k)
        self.update_load()

    def update_load(self) -> None:
        """Measure the Blocks' present loads. Collective."""
        self.loads = self._subdomains.load_norms()
        largest = self.loads * np.sqrt(self.nodes)
        self.negligible = np.maximum(BALANCE * largest, ROUNDING * largest.max(initial=0.0))

    def part_of(self, u: Array) -> Array:
        """Return the bodies' motion in a displacement, by least squares over the nodes. Collective.

        Args:
            u: This rank's part of the displacement, shape ``(n,)``.

        Returns:
            Coordinates, shape ``(bodies * k,)``.
        """
        W, moments = self.frames, self._subdomains.moments(u)
        return np.asarray(np.einsum("bij,bi->bj", W, moments) / self.nodes[:, None]).ravel()

    def amounts(self, motion: Array) -> Array:
        """Return the coefficient of each mode in a motion, shape ``(bodies, k)``."""
        return np.einsum("bij,bj->bi", self.frames, motion.reshape(self.count, self.k))

    def _springs(self, shares: Array) -> Array:
        W = self.frames
        values, vectors = np.linalg.eigh(np.swapaxes(W, 1, 2) @ shares @ W)
        sprung = values > SPRUNG
        return (vectors * sprung[:, None, :]) @ np.swapaxes(vectors, 1, 2)


def _frames(gram: Array) -> Array:
    """Symmetric inverse roots; a direction without extent is left as it is."""
    values, vectors = np.linalg.eigh(gram)
    extent = values > DEPENDENT * values.max(axis=1, initial=0.0, keepdims=True)
    roots = np.where(extent, values, 1.0) ** -0.5
    return np.asarray((vectors * roots[:, None, :]) @ np.swapaxes(vectors, 1, 2))


def _replicated(local: csr_array, first: int, dimension: int, comm: MPI.Intracomm) -> csr_array:
    """Return the rows of all ranks, on every rank; this rank's begin at first."""
    entries = local.tocoo()
    row, column = entries.coords
    every = ((first + row).astype(np.int64), column.astype(np.int64), entries.data)
    rows, columns, values = (np.concatenate(comm.allgather(part)) for part in every)
    return csr_array(coo_array((values, (rows, columns)), shape=(dimension, local.shape[1])))


# --- Names of motions in messages -------------------------------------------------------------

# Of the largest coefficient: a body that moves by less than this takes no part in a motion, which
# is known to rounding only; and a motion is named after modes of this share or more, which leaves
# out what a rotation about another centre mixes in.
TAKES_PART, DOMINANT = 1e-3, 0.3
# bodies that a sentence names; of more it tells how many
NAMED = 4


def free_to_move(amounts: Array, body_names: Sequence[str], mode_names: Sequence[str]) -> str:
    """Return a sentence about a motion.

    Args:
        amounts: How much of each mode is in it, shape ``(bodies, k)``.
        body_names: Names of the bodies.
        mode_names: Names of their modes.
    """
    moving, modes = _parts(amounts, mode_names)
    if len(moving) == 1:
        return f"{body_names[moving[0]]} is free to move ({modes})"
    names = ", ".join(body_names[b] for b in moving[:NAMED])
    more = f" and {len(moving) - NAMED} more" if len(moving) > NAMED else ""
    return f"{names}{more} are free to move together ({modes})"


def _parts(amounts: Array, mode_names: Sequence[str]) -> tuple[Array, str]:
    """Return the bodies that take part in a motion, and its dominant mode."""
    parts = np.abs(amounts)
    moving = np.flatnonzero(parts.max(axis=1) > TAKES_PART * parts.max())
    share = parts[moving].max(axis=0)
    modes = " and ".join(mode_names[m] for m in np.flatnonzero(share > DOMINANT * share.max()))
    return moving, modes


def listed(
    motions: Motions, bodies: Bodies, body_names: Sequence[str], mode_names: Sequence[str]
) -> list[dict[str, object]]:
    """A list of motions: ``bodies``, ``mode`` and the ``stiffness`` that holds them, 0 for none.

    Of several free motions of one body any combination is one, too; they are named after the
    modes that span them best.
    """
    found: list[dict[str, object]] = []
    for body in np.flatnonzero(motions.free.any(axis=1)):
        vectors = bodies.frames[body] @ motions.single[body]
        own, stiffness = motions.free[body], motions.stiffness[body]
        loose = own & (stiffness <= NULL)
        for mode in _spanning(vectors[:, loose], mode_names):
            found.append({"bodies": [body_names[body]], "mode": mode, "stiffness": 0.0})
        for j in np.flatnonzero(own & ~loose):
            _, mode = _parts(vectors[:, j][None, :], mode_names)
            held = float(stiffness[j])
            found.append({"bodies": [body_names[body]], "mode": mode, "stiffness": held})
    for _, rows, joint in parts_of_columns(motions.joint):
        moving, place = np.unique(rows // bodies.k, return_inverse=True)
        for motion in _plain(joint).T:
            coefficients = np.zeros((len(moving), bodies.k))
            coefficients[place, rows % bodies.k] = motion
            amounts = np.einsum("bij,bj->bi", bodies.frames[moving], coefficients)
            parts, mode = _parts(amounts, mode_names)
            names = [body_names[b] for b in moving[parts]]
            found.append({"bodies": names, "mode": mode, "stiffness": 0.0})
    return found


def _plain(joint: Array) -> Array:
    """Return motions that span the same, each with a coordinate that the others leave alone."""
    rows = qr(joint.T, pivoting=True, mode="r")[1][: joint.shape[1]]
    return np.asarray(joint @ np.linalg.inv(joint[np.sort(rows)]))


def _spanning(vectors: Array, mode_names: Sequence[str]) -> list[str]:
    """Return names of as many motions as there are columns."""
    count = vectors.shape[1]
    if count == 1:
        return [_parts(vectors.T, mode_names)[1]]
    if count == 0:
        return []
    return [mode_names[m] for m in sorted(qr(vectors.T, pivoting=True, mode="r")[1][:count])]


# --- Kernel basis with the bodies' motions as coordinates -------------------------------------

# what holds a direction, in the order of the coordinates
CONTACT, EQUALITIES, SPRINGS = 1, 2, 5


@dataclass(frozen=True)
class KernelBasis:
    """T = [M, E]: motions M of bodies, and unit vectors E of the subdomains' other coordinates.

    Gluing rows of a stiff body are larger than the contact rows that hold it by the root of the
    ratio of stiffnesses, and so may be rows of conditions on it. In the subdomains' own
    coordinates GGᵀ would be a sum of both, and rounding of the one could exceed the other.
    Columns GᵀM know nothing of gluing, and those of motions that only contact holds nothing of
    conditions.

    Attributes:
        combined: Directions of each body as columns, so that M = bodies.motions @ combined, shape
            ``(bodies * k, a)``.
        motions: M, orthonormal, shape ``(r, a)``.
        pins: Coordinates that M takes the place of.
        rest: The others.
        inverse: Inverse of M's rows at the pins.
        unheld: Flags of the motions that no equality row resists, shape ``(a,)``.
        free: Flags of the motions that no row resists, shape ``(a,)``.
    """

    combined: csr_array
    motions: csr_array
    pins: Array
    rest: Array
    inverse: csr_array
    unheld: Array
    free: Array

    def products(self, x: Array) -> Array:
        """Tᵀx."""
        return np.concatenate((self.motions.T @ x, x[self.rest]))

    def kernel(self, y: Array) -> Array:
        """T y."""
        x = self.motions @ y[: len(self.pins)]
        x[self.rest] += y[len(self.pins) :]
        return np.asarray(x)

    def coordinates(self, X: csr_array) -> csr_array:
        """T⁻¹X."""
        first = self.inverse @ X[self.pins]
        return csr_array(vstack([first, X[self.rest] - self.motions[self.rest] @ first]))

    def rows(self, Gt: csr_array, J: csr_array, equalities: Array) -> csr_array:
        """Gᵀ T, what is known to be zero left out.

        Args:
            Gt: Gᵀ in the subdomains' coordinates.
            J: The same rows on motions of bodies.
            equalities: Flags of the rows.
        """
        of_equalities = diags_array(equalities.astype(float)) @ J
        GtM = of_equalities @ self.combined.multiply(~self.unheld)
        GtM = GtM + (J - of_equalities) @ self.combined.multiply(~self.free)
        return csr_array(hstack([GtM, csc_array(Gt)[:, self.rest]]))


def kernel_basis(bodies: Bodies, unheld: Motions, free: Motions) -> KernelBasis:
    """Return the basis with all motions of bodies that no springs resist, the free ones apart.

    Args:
        bodies: The bodies.
        unheld: Motions that neither springs nor equality rows resist.
        free: Motions that nothing resists.
    """
    directions, held_by = _directions(bodies, unheld, free)
    kept = held_by < SPRINGS
    combined = csr_array(block_diagonal(directions)[:, np.flatnonzero(kept.ravel())])
    motions = csr_array(bodies.motions @ combined)
    body = np.repeat(np.arange(bodies.count), kept.sum(axis=1))
    pins, inverse = _pins(csc_array(motions), body)
    rest = np.setdiff1d(np.arange(motions.shape[0]), pins)
    unheld_of, free_of = held_by[kept] < EQUALITIES, held_by[kept] < CONTACT
    return KernelBasis(combined, motions, pins, rest, inverse, unheld_of, free_of)


def _directions(bodies: Bodies, unheld: Motions, free: Motions) -> tuple[Array, Array]:
    """Return directions of each body that are orthonormal in the kernel, and what holds each.

    Each is a combination of those before it: free ones, those that contact holds, those that
    equality rows hold, those that springs resist.
    """
    order = 3.0 * bodies.springs - _projector(unheld) - _projector(free)
    values, V = np.linalg.eigh(order)
    held_by = np.rint(values) + EQUALITIES
    kept = held_by < SPRINGS
    gram = np.swapaxes(V, 1, 2) @ bodies.size @ V
    gram = np.where(kept[:, :, None] & kept[:, None, :], gram, np.eye(bodies.k))
    return V @ np.linalg.inv(np.swapaxes(np.linalg.cholesky(gram), 1, 2)), held_by


def _projector(motions: Motions) -> Array:
    """Projectors onto the motions of single bodies, shape ``(bodies, k, k)``."""
    F = motions.single * motions.free[:, None, :]
    return np.asarray(F @ np.swapaxes(F, 1, 2))


def _pins(motions: csc_array, body: Array) -> tuple[Array, csr_array]:
    """Coordinates on which the motions of each body are independent, and the inverse there."""
    if len(body) == 0:
        return np.empty(0, dtype=np.int64), csr_array((0, 0))
    pins, inverses = [], []
    for own in np.split(np.arange(len(body)), np.flatnonzero(np.diff(body)) + 1):
        part = csr_array(motions[:, own])
        rows = np.flatnonzero(np.diff(part.indptr))
        dense = part[rows].toarray()
        chosen = independent(dense)
        pins.append(rows[chosen])
        inverses.append(np.linalg.inv(dense[chosen]))
    return np.concatenate(pins), csr_array(block_diag([csr_array(X) for X in inverses]))


def independent(columns: Array) -> Array:
    """Select by pivoting as many rows as columns, on which the columns are independent."""
    if columns.shape[1] == 0:
        return np.empty(0, dtype=np.int64)
    return np.asarray(qr(columns.T, pivoting=True, mode="r")[1][: columns.shape[1]])


# --- Orthonormal basis of null(Gᵀ) ------------------------------------------------------------


@dataclass(frozen=True)
class NullBasis:
    """A null space of unit vectors and a few others.

    Attributes:
        alone: Coordinates of the unit vectors.
        joint: Orthonormal, zero at those coordinates, as columns, scipy CSR, shape ``(r, c)``.
    """

    alone: Array
    joint: csr_array

    def removed(self, x: Array) -> Array:
        """x less its part in the space."""
        x = x - self.joint @ (self.joint.T @ x) if self.joint.shape[1] else np.array(x)
        x[self.alone] = 0.0
        return np.asarray(x)

    def pins(self, scale: Array) -> Array:
        """Select as many coordinates as vectors, on which these are independent.

        Args:
            scale: Coordinates are to be counted in these units.
        """
        pins = [self.alone]
        for _, rows, dense in parts_of_columns(self.joint):
            joint = dense / scale[rows, None]
            size = np.maximum(np.linalg.norm(joint, axis=0), TINY)
            pins.append(rows[independent(joint / size)])
        return np.concatenate(pins)

    def extended(self, count: int) -> NullBasis:
        """Return the same space, 0 on so many more coordinates."""
        rows = self.joint.shape[0] + count
        table = (self.joint.data, self.joint.indices, np.pad(self.joint.indptr, (0, count), "edge"))
        return NullBasis(self.alone, csr_array(table, shape=(rows, self.joint.shape[1])))


def null_basis(alone: Array, joint: csr_array) -> NullBasis:
    """Basis of unit vectors and others.

    Args:
        alone: Coordinates of the unit vectors.
        joint: Other vectors as columns, independent of them.
    """
    others = np.ones(joint.shape[0])
    others[alone] = 0.0
    kept = csr_array(diags_array(others) @ joint)
    kept.eliminate_zeros()
    return NullBasis(alone, orthonormal_columns(kept))
