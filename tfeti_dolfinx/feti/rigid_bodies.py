"""Rigid motions of bodies: which ones rows leave free, and their names."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import qr
from scipy.sparse import csc_array, csr_array, hstack
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.common.arrays import Array, Entries, beside, columns_of, entries_at, sum_rows
from tfeti_dolfinx.common.parallel import bcast_from_root, rows_over
from tfeti_dolfinx.subdomains.subdomains import Subdomains


@dataclass(frozen=True)
class MotionTolerances:
    """Tolerances of what counts as a free motion."""

    # stiffness, as a share of the stiffest motion of the same body, that counts as none: rounding
    # makes 1e-15 of it, and pins on neighbouring nodes of a fine mesh hold a turn by 1e-9
    null: float = 1e-13
    # share of a motion's square that lies outside a subdomain's kernel, and so moves a spring:
    # kernels beside weak springs are inexact, and a share is the square of an angle
    sprung: float = 1e-8
    # work of a body's load that counts as none, as a share of the largest that loads of this size
    # could do: what users balance by hand is seldom exact
    balance: float = 1e-9
    rounding: float = 1e-14  # the same of the load of any body
    # eigenvalue of the modes' Gram matrix, as a share of the largest, that is none: on nodes of a
    # line or a point some mode is no motion of its own
    dependent: float = 1e-12
    # size of a row on motions of bodies, over its own, below which it only glues
    gluing: float = 1e-6
    no_grip: float = 1e-12  # the same of an entry of another row that is only rounding
    # of a row between bodies, what it sees of them as one, how far its sides are apart over
    # their size: by gaps, what a step of Newton's is off, or curved facets, 0.008 on eight chords.
    # Stresses are off by less than that. What holds a row's body in space is most of a row
    as_one: float = 0.1
    # of the largest coefficient of a motion: a body that moves by less takes no part
    takes_part: float = 1e-3
    # a motion is named after modes of this share or more, which leaves out what a rotation about
    # another centre mixes in
    dominant: float = 0.3
    named: int = 4  # bodies that a sentence names; of more it tells how many
    # of the stiffest motion of the same body: a stiffness that hardly holds one, by contacts whose
    # normals are off by less than 6 degrees from a right angle
    nearly: float = 1e-2


TOLERANCES = MotionTolerances()
# bodies that meet, numbered as in ``BodyRows.gram``, and k × k blocks
Pairs = tuple[Array, Array]

# --- Dense algebra on parts of sparse matrices with few columns -------------------------------


def parts_of_columns(A: csr_array) -> Iterator[tuple[Array, Array, Array]]:
    """Columns of A that meet in rows, these rows, and the dense matrix there; part by part."""
    if A.shape[1] == 0:
        return
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


def on_rows(parts: list[tuple[Array, Array]], n: int) -> csr_array:
    """Dense matrices on some of n rows each, maybe none, one beside the other."""
    widths = [dense.shape[1] for _, dense in parts]
    if not sum(widths):
        return csr_array((n, 0))
    columns = np.split(np.arange(sum(widths)), np.cumsum(widths)[:-1])
    pairs = list(zip(parts, columns, strict=True))
    row = np.concatenate([np.repeat(rows, len(own)) for (rows, _), own in pairs])
    column = np.concatenate([np.tile(own, len(rows)) for (rows, _), own in pairs])
    values = np.concatenate([dense.ravel() for _, dense in parts])
    return entries_at(row, column, values, (n, sum(widths))).csr()


def orthonormal_columns(A: csr_array) -> csr_array:
    """Return an orthonormal basis of the span of independent columns, part by part."""
    if not A.shape[1]:
        return A
    parts = [(rows, np.linalg.qr(dense)[0]) for _, rows, dense in parts_of_columns(A)]
    return on_rows(parts, A.shape[0])


def independent(columns: Array) -> Array:
    """Select by pivoting as many rows as columns, on which the columns are independent."""
    if columns.shape[1] == 0:
        return np.empty(0, dtype=np.int64)
    return np.asarray(qr(columns.T, pivoting=True, mode="r")[1][: columns.shape[1]])


# --- Rows on motions of bodies ----------------------------------------------------------------


@dataclass(frozen=True)
class BodyRows:
    """Rows of a matrix on k motions of n bodies each; a row has parts on the bodies it meets."""

    row: Array  # of each part, ascending, shape (p,)
    body: Array  # of each part, shape (p,)
    parts: Array  # shape (p, k)
    shape: tuple[int, int, int]  # number of rows, n, k

    @classmethod
    def of(cls, A: Any, n: int, k: int) -> BodyRows:
        """Return the rows of a CSR matrix, shape ``(m, n k)``."""
        row = np.repeat(np.arange(A.shape[0]), np.diff(A.indptr))
        body, motion = np.divmod(A.indices.astype(np.int64), k)
        met, which = np.unique(row * n + body, return_inverse=True)
        parts = np.zeros((len(met), k))
        parts[which, motion] = A.data
        return cls(*np.divmod(met, max(n, 1)), parts, (A.shape[0], n, k))

    def turned(self, U: Array) -> BodyRows:
        """Return the product with square blocks of the bodies, shape ``(n, k, k)``."""
        return replace(self, parts=np.einsum("pi,pij->pj", self.parts, U[self.body]))

    def __matmul__(self, y: Array) -> Array:
        """Return the product with a motion of the bodies, shape ``(n k,)``."""
        _, n, k = self.shape
        parts = np.einsum("pi,pi->p", self.parts, y.reshape(n, k)[self.body])
        return np.bincount(self.row, parts, minlength=self.shape[0]).astype(float)

    def transposed(self, x: Array) -> Array:
        """Return the product of the transpose with a vector of the rows, shape ``(n k,)``."""
        return sum_rows(self.body, self.parts * x[self.row, None], self.shape[1]).ravel()

    def without(self, motions: csr_array) -> BodyRows:
        """Return the nearest rows that do not see motions, columns, which they hardly see."""
        (_, n, k), parts = self.shape, self.parts.copy()
        for _, rows, dense in parts_of_columns(motions):
            W = np.zeros((n * k, dense.shape[1]))
            W[rows] = dense
            of_parts = W.reshape(n, k, -1)[self.body]
            own = np.flatnonzero(of_parts.any(axis=(1, 2)))
            of_parts = of_parts[own]
            row, place = np.unique(self.row[own], return_inverse=True)
            seen = sum_rows(place, np.einsum("pi,pic->pc", parts[own], of_parts), len(row))
            gram = sum_rows(place, np.einsum("pic,pid->pcd", of_parts, of_parts), len(row))
            share = np.einsum("rcd,rd->rc", np.linalg.pinv(gram, hermitian=True), seen)
            by = np.einsum("pic,pc->pi", of_parts, share[place])
            squares = [sum_rows(place, of**2, len(row)).sum(axis=1) for of in (by, parts[own])]
            much, whole = np.sqrt(squares)
            hardly = (much > TOLERANCES.no_grip) & (much <= TOLERANCES.as_one * whole)
            parts[own] -= np.where(hardly[place, None], by, 0.0)
        return replace(self, parts=parts)

    def entries(self, shown: Array, numbers: Array, width: int) -> Entries:
        """Return flagged entries of the parts, not 0, in columns with these numbers.

        Flags have shape ``(p, k)``, numbers ``(n, k)``, ascending.
        """
        shown = shown & (self.parts != 0.0)
        count = np.zeros(self.shape[0], dtype=np.int64)
        np.add.at(count, self.row, shown.sum(axis=1))
        table = np.concatenate(([0], np.cumsum(count)))
        return Entries(self.parts[shown], numbers[self.body][shown], table, (len(count), width))

    def csr(self) -> csr_array:
        """Return the matrix, scipy CSR, shape ``(m, n k)``."""
        _, n, k = self.shape
        every = np.ones(self.parts.shape, dtype=bool)
        return self.entries(every, np.arange(n * k).reshape(n, k), n * k).csr()

    def gram(self, some: Array) -> Pairs:
        """Return AᵀA of flagged rows: pairs i n + j of bodies that meet, and their blocks."""
        _, n, k = self.shape
        kept = some[self.row]
        row, body, parts = self.row[kept], self.body[kept], self.parts[kept]
        # all bodies of a row with each of them
        first, last = np.searchsorted(row, row), np.searchsorted(row, row, side="right")
        count = last - first
        left = np.repeat(np.arange(len(row)), count)
        right = np.arange(len(left)) - np.repeat(np.cumsum(count) - last, count)
        pairs, which = np.unique(body[left] * n + body[right], return_inverse=True)
        blocks = np.zeros((len(pairs), k, k))
        for a, b in np.ndindex(k, k):
            products = parts[left, a] * parts[right, b]
            blocks[:, a, b] = np.bincount(which, products, minlength=len(pairs))
        return pairs, blocks


# --- Motions of bodies ------------------------------------------------------------------------


@dataclass(frozen=True)
class Motions:
    """A space of motions of bodies, each of k coordinates.

    These are used, from the largest to the smallest:

    ============================  =============================================================
    ``Bodies.unsprung``           not resisted by springs that stiffnesses have
    ``CoarseSpace.unheld``        nor by equality rows, soft springs among them: what contact holds
    ``Recovered.loose``           nor by a row of contact with a force, at an iterate
    ``CoarseSpace.free_motions``  nor by any row
    ============================  =============================================================
    """

    single: Array  # orthonormal directions of each body, as columns, shape (bodies, k, k)
    free: Array  # which of them the body can take alone, shape (bodies, k)
    # what holds each of them, as a share of the body's stiffest motion, its neighbours at rest,
    # shape (bodies, k)
    stiffness: Array
    joint: csr_array  # motions of several bodies together, scipy CSR, shape (bodies * k, c)

    @cached_property
    def alone(self) -> csr_array:
        """The motions of single bodies as columns, shape ``(bodies * k, a)``."""
        n, k = self.free.shape
        columns = np.repeat(np.arange(n * k).reshape(n, k), k, axis=0).ravel()
        table, shape = k * np.arange(n * k + 1), (n * k, n * k)
        every = Entries(self.single.ravel(), columns, table, shape)
        return columns_of(every, np.flatnonzero(self.free)).csr()

    @property
    def count(self) -> int:
        """Number of motions."""
        return int(self.free.sum()) + self.joint.shape[1]

    @property
    def moving(self) -> Array:
        """Flags of the bodies that some motion moves, shape ``(bodies,)``."""
        joint = np.diff(self.joint.indptr).reshape(self.free.shape)
        return np.any(self.free | (joint > 0), axis=1)

    @property
    def columns(self) -> csr_array:
        """All of them as columns, those of single bodies first."""
        if not self.free.any():
            return self.joint
        return csr_array(hstack([self.alone, self.joint], format="csr"))


def unsprung(shares: Array) -> Motions:
    """Return motions that springs do not resist, from the shares of squares outside of kernels."""
    values, vectors = np.linalg.eigh(shares)
    sprung = vectors * (values > TOLERANCES.sprung)[:, None, :]
    # of the projector, whose directions are the modes' own where there are no springs
    values, vectors = np.linalg.eigh(sprung @ np.swapaxes(vectors, 1, 2))
    none = csr_array((shares.shape[0] * shares.shape[1], 0))
    return Motions(vectors, values < 0.5, values, none)


def unresisted(grams: Sequence[Pairs], within: Motions) -> Motions:
    """Return motions of a space of single bodies' motions that rows do not resist.

    1. Scale: the stiffest motion of each body is 1, and what is not in the space is left out.
    2. Body by body: directions that a body can take alone, its neighbours at rest.
    3. On what is left the Gram matrix gets unit diagonal blocks; its null space is that of
       connected components of bodies.

    Args:
        grams: JᵀJ of the rows, as ``BodyRows.gram`` has it, to be added up.
        within: The space to look in; its joint motions are not looked at.
    """
    V, free, null = within.single, within.free, TOLERANCES.null
    pairs, which = np.unique(np.concatenate([pairs for pairs, _ in grams]), return_inverse=True)
    i, j = np.divmod(pairs, max(len(V), 1))
    blocks = np.zeros((len(pairs), *V.shape[1:]))
    np.add.at(blocks, which, np.concatenate([part for _, part in grams]))

    def between(U: Array, A: Array) -> Array:
        return np.asarray(np.swapaxes(U[i], 1, 2) @ A @ U[j])

    def of_bodies(A: Array) -> Array:
        found = np.zeros(V.shape)
        found[i[i == j]] = A[i == j]
        return found

    # 1. scale; rows that hold only what is not in the space leave their rounding there
    whole = between(V, blocks)
    A = np.where(free[i][:, :, None] & free[j][:, None, :], whole, 0.0)
    largest, at_all = (
        np.linalg.eigvalsh(of_bodies(matrix)).max(axis=1, initial=0.0) for matrix in (A, whole)
    )
    grip = largest > null * at_all
    scale = np.where(grip, np.where(grip, largest, 1.0) ** -0.5, 0.0)
    A = A * (scale[i] * scale[j])[:, None, None]
    # 2. single bodies; twice the stiffest motion keeps apart what is not in the space
    apart = np.where(free, 0.0, 2.0)[:, :, None] * np.eye(free.shape[1])
    stiffness, vectors = np.linalg.eigh(of_bodies(A) + apart)
    held = (stiffness > null) & (stiffness < 1.5)
    # 3. several bodies, in coordinates in which each alone resists all its motions alike
    U = vectors * np.where(held, np.where(held, stiffness, 1.0) ** -0.5, 0.0)[:, None, :]
    way = scale[:, None, None] * (V @ U)
    joint = [
        ((len(free[0]) * own[:, None] + np.arange(len(free[0]))).ravel(), way[own] @ X)
        for own, X in _null_space(between(U, A), i, j, held)
    ]
    parts = [(rows, X.reshape(len(rows), -1)) for rows, X in joint]
    return Motions(
        V @ vectors, stiffness <= null, np.maximum(stiffness, 0.0), on_rows(parts, free.size)
    )


def _null_space(blocks: Array, i: Array, j: Array, held: Array) -> Iterator[tuple[Array, Array]]:
    """Null space of a Gram matrix with unit diagonal blocks, by components of bodies.

    Yields the bodies of a component, and its part of the null space, shape ``(bodies, k, c)``.
    """
    n, k = held.shape
    strong = np.abs(blocks).max(axis=(1, 2), initial=0.0) > TOLERANCES.null
    if not np.any(strong & (i != j)):
        return
    links = csr_array((strong[strong], (i[strong], j[strong])), shape=(n, n))
    label = connected_components(links, directed=False)[1]
    place = np.empty(n, dtype=np.int64)
    for component in np.flatnonzero(np.bincount(label, minlength=1) > 1):
        own = np.flatnonzero(label == component)
        # what is rounding may link bodies of other components
        some = np.flatnonzero((label[i] == component) & (label[j] == component))
        place[own] = np.arange(len(own))
        A = np.zeros((len(own), k, len(own), k))
        A[place[i[some]], :, place[j[some]]] = blocks[some]
        inside = held[own].ravel()
        values, vectors = np.linalg.eigh(A.reshape(len(inside), -1)[np.ix_(inside, inside)])
        X = np.zeros((len(inside), len(values)))
        X[inside] = vectors
        yield own, X[:, values <= TOLERANCES.null * len(values)].reshape(len(own), k, -1)


# --- Rigid motions of bodies in kernel coordinates --------------------------------------------


class Bodies:
    """Motions of the bodies, in coordinates in which every motion has the mean square 1.

    Creation is collective.

    Attributes:
        names: Their names, and ``mode_names`` those of the candidate modes, for messages.
        count: Number of bodies on all ranks.
        k: Candidate modes of each.
        frames: Modes' coefficients of each coordinate, shape ``(bodies, k, k)``.
        nodes: Number of nodes of each body, copies counted once, shape ``(bodies,)``.
        motions: Kernel coordinates of the motions; each coordinate is of one body.
        unsprung: Motions that springs do not resist.
        loads: ‖f‖ of each body, shape ``(bodies,)``.
        negligible: Work of each body's load, on a motion of mean square 1, that counts as none,
            and ``unloaded``, that is its own rounding; shape ``(bodies,)``.
    """

    def __init__(
        self, subdomains: Subdomains, names: Sequence[str], mode_names: Sequence[str]
    ) -> None:
        self._subdomains, comm = subdomains, subdomains.comm
        self.names, self.mode_names = names, mode_names
        self.count, self.k = subdomains.num_bodies, subdomains.num_modes
        metric = subdomains.modes_metric()
        self.nodes = metric[:, :1, :1].max(axis=(1, 2), initial=1.0)
        # symmetric inverse roots; a direction without extent is left as it is
        values, vectors = np.linalg.eigh(metric / self.nodes[:, None, None])
        extent = values > TOLERANCES.dependent * values.max(axis=1, initial=0.0, keepdims=True)
        roots = np.where(extent, values, 1.0) ** -0.5
        W = (vectors * roots[:, None, :]) @ np.swapaxes(vectors, 1, 2)
        self.frames = W = bcast_from_root(comm, np.asarray(W))
        shares = np.swapaxes(W, 1, 2) @ subdomains.modes_outside() @ W
        self.unsprung = bcast_from_root(comm, unsprung(shares))
        inside = rows_over(comm, subdomains.modes_in_kernel)
        self.motions = BodyRows.of(inside, self.count, self.k).turned(self.frames)
        self.update_load()

    def update_load(self) -> None:
        """Measure the Blocks' present loads. Collective."""
        subdomains, own = self._subdomains, self._subdomains.load_rounding
        squares = [[float(block.load @ block.load) for block in subdomains.blocks]]
        squares += [[float(own[part] @ own[part]) for part in subdomains.dof_parts]]
        self.loads, noise = np.sqrt(subdomains.of_bodies(squares))
        largest, noise = self.loads * np.sqrt(self.nodes), noise * np.sqrt(self.nodes)
        self.unloaded = np.maximum(noise, TOLERANCES.rounding * largest)
        others = np.maximum(noise, TOLERANCES.rounding * largest.max(initial=0.0))
        self.negligible = np.maximum(TOLERANCES.balance * largest, others)

    def as_one(self, unheld: Motions) -> csr_array:
        """Return motions of those bodies as one that are free to move, orthonormal. Collective."""
        parts = np.stack([self.part_of(u) for u in self._subdomains.modes_as_one().T], axis=1)
        parts.reshape(self.count, self.k, -1)[~unheld.free.all(axis=1)] = 0.0
        # far from the origin a turn about it is a translation but for a little
        columns, sizes, _ = np.linalg.svd(parts, full_matrices=False)
        return csr_array(columns[:, sizes > TOLERANCES.dependent * sizes.max(initial=0.0)])

    def part_of(self, u: Array) -> Array:
        """Coordinates of the bodies' motion in u, by least squares over the nodes. Collective."""
        W, moments = self.frames, self._subdomains.moments(u)
        return np.asarray(np.einsum("bij,bi->bj", W, moments) / self.nodes[:, None]).ravel()

    def elastic(self, u: Array) -> Array:
        """Return u less the bodies' motion in it. Collective."""
        return u - self._subdomains.modes_motion(self.amounts(self.part_of(u)))

    def driven(self, free: Motions, load: Array) -> Array | None:
        """Return the part of a load's work on free motions, if it is more than rounding."""
        if not free.count:
            return None
        alone = (free.alone @ (free.alone.T @ load)).reshape(self.count, self.k)
        alone[np.linalg.norm(alone, axis=1) <= self.negligible] = 0.0
        if np.any(alone):
            return np.asarray(alone.ravel())
        Q = orthonormal_columns(free.joint)
        joint = np.asarray(Q @ (Q.T @ load))
        each = np.linalg.norm(joint.reshape(self.count, self.k), axis=1)
        if not joint @ load > self.negligible @ each:
            return None
        # a turn that facets hold a little is a small part of a free motion, but does the work
        work = joint * np.abs(load)
        return np.asarray(joint / np.abs(joint).max() + work / np.abs(work).max())

    def amounts(self, motion: Array) -> Array:
        """Return the coefficient of each mode in a motion, shape ``(bodies, k)``."""
        return np.einsum("bij,bj->bi", self.frames, motion.reshape(self.count, self.k))

    # --- what messages say of motions

    def sentence(self, amounts: Array) -> str:
        """Return a sentence about a motion, from how much of each mode is in it."""
        moving, modes = self._parts(amounts)
        if len(moving) == 1:
            return f"{self.names[moving[0]]} is free to move ({modes})"
        rest = len(moving) - TOLERANCES.named
        names = ", ".join(self.names[b] for b in moving[: TOLERANCES.named])
        more = f" and {rest} more" if rest > 0 else ""
        return f"{names}{more} are free to move together ({modes})"

    def moved_rigidly(self, u: Array, bends: float) -> str:
        """Return a sentence on the bodies that move most, but for less than a share bends, or "".

        Collective; u on all unknowns.
        """
        amounts = self.amounts(self.part_of(u))
        sizes = self._subdomains.body_sizes([u, self.elastic(u)])
        moved, bent = bcast_from_root(self._subdomains.comm, sizes)
        rigid = (bent <= bends * moved) & (moved >= 0.5 * moved.max(initial=0.0))
        return self.sentence(np.where(rigid[:, None], amounts, 0.0)) if np.any(rigid) else ""

    def listed(self, motions: Motions) -> list[dict[str, Any]]:
        """List motions: ``bodies``, ``mode`` and the ``stiffness`` that holds them, 0 for none.

        Of several free motions of the same bodies any combination is one, too: such are named of
        which each has a coordinate that the others leave alone.
        """
        found: list[dict[str, Any]] = []

        def add(which: Sequence[int], columns: Array, stiffness: float) -> None:
            if stiffness == 0.0:
                columns = columns @ np.linalg.inv(columns[np.sort(independent(columns))])
            for motion in columns.T:
                moving, mode = self._parts(motion.reshape(len(which), self.k))
                names = [self.names[which[b]] for b in moving]
                found.append({"bodies": names, "mode": mode, "stiffness": stiffness})

        for body in np.flatnonzero(motions.free.any(axis=1)):
            vectors = self.frames[body] @ motions.single[body]
            own, held = motions.free[body], motions.stiffness[body]
            loose = own & (held <= TOLERANCES.null)
            add([body], vectors[:, loose], 0.0)
            for j in np.flatnonzero(own & ~loose):
                add([body], vectors[:, [j]], float(held[j]))
        for _, rows, joint in parts_of_columns(motions.joint):
            which, place = np.unique(rows // self.k, return_inverse=True)
            coordinates = np.zeros((len(which), self.k, joint.shape[1]))
            coordinates[place, rows % self.k] = joint
            amounts = self.frames[which] @ coordinates
            add(which, amounts.reshape(-1, joint.shape[1]), 0.0)
        return found

    def _parts(self, amounts: Array) -> tuple[Array, str]:
        """Return the bodies that take part in a motion, and its dominant mode."""
        parts = np.abs(amounts)
        moving = np.flatnonzero(parts.max(axis=1) > TOLERANCES.takes_part * parts.max())
        share = parts[moving].max(axis=0)
        dominant = np.flatnonzero(share > TOLERANCES.dominant * share.max())
        return moving, " and ".join(self.mode_names[m] for m in dominant)


# --- Basis of the kernel with the bodies' motions ---------------------------------------------


@dataclass(frozen=True)
class KernelBasis:
    """T = [M, E]: motions M of bodies, and unit vectors E of the subdomains' other coordinates.

    Gluing rows of a stiff body, and rows of a turn that hardly any contact resists, may differ by
    so much that GGᵀ in the subdomains' own coordinates hides one behind the rounding of the other.
    Columns GᵀM know nothing of gluing, and those of motions that only contact holds nothing of
    conditions.
    """

    # directions of each body as columns, shape (bodies, k, k)
    directions: Array
    kept: Array  # flags of those in M, shape (bodies, k)
    unheld: Array  # flags of those that no equality row resists
    free: Array  # flags of those that no row resists
    motions: BodyRows  # kernel coordinates of all directions, orthonormal those of M
    coordinates: BodyRows  # T⁻¹ of the bodies' motions
    rest: Array  # coordinates that M does not take the place of

    def kernel(self, y: Array) -> Array:
        """T y."""
        along = np.zeros(self.kept.shape)
        along[self.kept] = y[: len(y) - len(self.rest)]
        x = self.motions @ along
        x[self.rest] += y[len(y) - len(self.rest) :]
        return x

    def transposed(self, x: Array) -> Array:
        """Tᵀx."""
        return np.concatenate((self.motions.transposed(x)[self.kept.ravel()], x[self.rest]))

    def rows(self, Gt: csr_array, J: BodyRows, equalities: Array) -> csr_array:
        """Gᵀ T from Gᵀ and its rows J on motions of bodies, what is known to be zero left out."""
        along, body = J.turned(self.directions), J.body
        zero = np.where(equalities[J.row, None], self.unheld[body], self.free[body])
        numbers, width = np.cumsum(self.kept) - 1, int(self.kept.sum())
        numbers = numbers.reshape(self.kept.shape)
        GtM = along.entries(self.kept[body] & ~zero, numbers, width)
        return beside(GtM, columns_of(Gt, self.rest)).csr()


def kernel_basis(bodies: Bodies, unheld: Motions, free: Motions) -> KernelBasis:
    """Return the basis with all motions of bodies that no springs resist.

    The directions of each body are orthonormal in the kernel, each a combination of those before
    it: free ones, those that contact holds, those that equality rows hold.
    """
    # projectors onto the motions of single bodies
    bases = [m.single * m.free[:, None, :] for m in (bodies.unsprung, unheld, free)]
    of_unsprung, of_unheld, of_free = (F @ np.swapaxes(F, 1, 2) for F in bases)
    # eigenvalues: free −2, held by contact −1, by equality rows 0, by springs 3
    values, V = np.linalg.eigh(3.0 * (np.eye(bodies.k) - of_unsprung) - of_unheld - of_free)
    kept, X = values < 1.5, bodies.motions
    size = sum_rows(X.body, X.parts[:, :, None] * X.parts[:, None, :], bodies.count)
    gram = np.swapaxes(V, 1, 2) @ size @ V
    gram = np.where(kept[:, :, None] & kept[:, None, :], gram, np.eye(bodies.k))
    directions = V @ np.linalg.inv(np.swapaxes(np.linalg.cholesky(gram), 1, 2))
    motions = X.turned(directions)
    # coordinates on which the motions of each body are independent, and T⁻¹ of all of them
    pins: list[Array] = [np.empty(0, dtype=np.int64)]
    first: list[Array] = [np.empty((0, bodies.k))]
    left = X.parts.copy()
    order = np.argsort(X.body, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(X.body[order])) + 1) if len(order) else ():
        M = motions.parts[own][:, kept[X.body[own[0]]]]
        chosen = independent(M)
        pins.append(own[chosen])
        first.append(np.linalg.solve(M[chosen], X.parts[own[chosen]]))
        left[own] -= M @ first[-1]
    pinned = np.concatenate(pins)
    others = np.delete(np.arange(len(left)), pinned)
    rest = np.delete(np.arange(X.shape[0]), X.row[pinned])
    coordinates = BodyRows(
        np.append(np.arange(len(pinned)), len(pinned) + np.searchsorted(rest, X.row[others])),
        X.body[np.append(pinned, others)],
        np.concatenate((*first, left[others])),
        X.shape,
    )
    unheld_of, free_of = kept & (values < -0.5), kept & (values < -1.5)
    return KernelBasis(directions, kept, unheld_of, free_of, motions, coordinates, rest)
