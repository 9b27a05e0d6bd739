"""The Block of a subdomain with a sparse stiffness: K⁺, K_bb and S; equal ones share factors."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any
from weakref import WeakSet, WeakValueDictionary

import numpy as np
from petsc4py import PETSc
from scipy.linalg.lapack import dpocon, dpotrf, dpotri

from tfeti_dolfinx.common.arrays import TINY, Array, LocalMatrix, as_petsc_matrix
from tfeti_dolfinx.common.validation import check_stiffness
from tfeti_dolfinx.errors import FactorError, InputError
from tfeti_dolfinx.subdomains.block import (
    TOLERANCES,
    Block,
    OperatorKind,
    Springs,
    SubdomainData,
    candidate_modes,
    fixing_dofs,
    kernel_of,
    outside_motions,
)
from tfeti_dolfinx.subdomains.factor import CholeskyFactor, NotPositiveDefiniteError
from tfeti_dolfinx.subdomains.kplus import (
    GeneralisedInverse,
    InverseFactory,
    gives_no_energy,
    regularised,
    why_indefinite,
)
from tfeti_dolfinx.subdomains.mixed import MixedFactor

# --- The stiffness of a subdomain, or of equal ones -------------------------------------------


class Stiffness:
    """K, its kernel, its generalised inverse, and what it is on traces.

    Equal subdomains share one; it lives as long as one of them uses it. Creation raises an
    InputError where K is not symmetric, not finite or not positive semidefinite; a FactorError
    where a factor could not be made. K is scipy CSR, shape ``(n, n)``, and becomes its own.

    Attributes:
        null: The kernel of K, shape ``(n, q)``.
        kernel: R, shape ``(n, r)``: that, and the motions of springs.
        springs: The soft ones, if the factory of inverses takes them out; K has them.
        diagonal: Diagonal of K.
        pinv_on: A trace, ascending, on which a dense K⁺ is known, maybe empty, and this.
        entries: Entries of the factor; of an inverse that the user brings, as if it were dense.
        mixed: Whether the factor is in single precision, so that ``roughly`` costs less.
    """

    def __init__(self, name: str, x: Array, K: Any, factory: InverseFactory) -> None:
        self.product = LocalMatrix(K)  # K, for products
        check_stiffness(name, K, product=self.product)
        self.name, self.x, self.K, self.factory = name, x, K, factory
        self.size = int(K.shape[0])
        self.bs = self.size // max(len(x), 1)
        self._traced: WeakValueDictionary[bytes, Traced] = WeakValueDictionary()
        self.springs: Springs | None = None
        self.mixed = False
        self.pinv_on: Any = np.empty(0, dtype=np.int32), np.empty((0, 0))
        centre = x.mean(axis=0)
        length = np.linalg.norm(x - centre, axis=1).max()
        self.diagonal = K.diagonal()
        modes = candidate_modes(x, self.bs, centre, length)
        self.kernel = self.null = R = kernel_of(K, modes)
        outside = outside_motions(modes, R)
        factory.factorizations += 1
        fixing = fixing_dofs(x, np.arange(self.size) // self.bs)
        try:
            # plane ones fit into the cache, as do those that are applied to many vectors at once
            mixed = factory.mixed and x.shape[1] == 3 and outline(x) not in factory.shared
            self._pinv: GeneralisedInverse = factory.inverse(K, R, fixing, mixed)
            self.entries = self.size**2 / 2.0
            if isinstance(self._pinv, CholeskyFactor):
                self.entries = self._pinv.entries
                self.mixed = isinstance(self._pinv, MixedFactor)
                # single precision makes no factor of such a stiffness
                if not self.mixed and gives_no_energy(K, np.hstack((R, outside)), x, self._pinv):
                    raise NotPositiveDefiniteError("a pivot is zero but for rounding")
        except NotPositiveDefiniteError as error:
            why = why_indefinite(K, R, outside, fixing, x, factory.prefix)
            raise InputError(f"{name}: {why}") from error
        except FactorError as error:
            raise FactorError(f"{name}: {error}") from error
        if factory.soft:
            soft = factory.soft * float(np.mean(self.diagonal)) * len(x) ** (-2.0 / x.shape[1])
            self.springs = Springs.of(outside, self.product.__matmul__, soft)
        if self.springs is not None:
            self.kernel = np.hstack((R, self.springs.directions))

    def solve(self, b: Array) -> Array:
        """K⁺ b on all unknowns, shapes ``(n,)`` or ``(n, q)``; K₁⁺ b where there are springs."""
        return self._solve(b) if self.springs is None else self.springs.without(self._solve, b)

    def roughly(self, b: Array) -> Array:
        """K⁺ b as ``solve``, to what a factor in single precision gives."""
        assert isinstance(self._pinv, CholeskyFactor)
        rough = self._pinv.roughly
        return rough(b) if self.springs is None else self.springs.without(rough, b)

    def _solve(self, b: Array) -> Array:
        if b.ndim == 1 or isinstance(self._pinv, CholeskyFactor):
            return self._pinv.solve(b)
        # an inverse that the user brings may know single vectors only
        return np.stack([self._pinv.solve(column) for column in b.T], axis=1)

    @cached_property
    def stretch_over_shear(self) -> float:
        """About (λ + 2μ)/μ, as ``stretch_over_shear`` finds it."""
        return stretch_over_shear(self.x, self.bs, self.product.__matmul__)

    def on_trace(self, trace: Array) -> Traced:
        """K_bb and S on a trace, ascending, the same for all that use it."""
        key = trace.tobytes()
        if (found := self._traced.get(key)) is None:
            found = self._traced[key] = Traced(self, trace)
        return found


class Traced:
    """A stiffness seen from a trace, ascending; each matrix is made when it is first asked for."""

    def __init__(self, stiffness: Stiffness, trace: Array) -> None:
        self._of, self.trace = stiffness, trace
        self.inside = np.delete(np.arange(stiffness.size), trace)

    @cached_property
    def schur(self) -> Array | None:
        """S where a dense (K⁺)_bb is known and has an inverse that keeps its digits; else None.

        (K_ρ⁻¹)_bb is S_ρ⁻¹, and S is S_ρ − W(R_bᵀW)⁻¹Wᵀ with W = S_ρR_b: K_ρ differs from K by as
        many ranks as R has columns, and SR_b = 0.
        """
        R, (known, A) = self._of.kernel[self.trace], self._of.pinv_on
        if not len(self.inside) or not len(self.trace) or not len(known):
            return None
        rows = np.minimum(np.searchsorted(known, self.trace), len(known) - 1)
        if not np.array_equal(known[rows], self.trace):
            return None
        # K_ρ⁻¹, unlike a K⁺ of one's own, or without springs
        if not isinstance(self._of._pinv, CholeskyFactor) or self._of.springs is not None:
            return None
        if R.size and np.linalg.svd(R, compute_uv=False)[-1] <= TOLERANCES.on_trace:
            return None
        A = A if len(rows) == len(known) else A[np.ix_(rows, rows)]
        sizes = 1.0 / np.sqrt(A.diagonal())
        A = sizes[:, None] * A * sizes
        L, failed = dpotrf(A.T)  # in the order of columns, without a copy
        if failed or dpocon(L, np.abs(A).sum(axis=1).max())[0] < TOLERANCES.invertible:
            return None
        S = sizes[:, None] * dpotri(L, overwrite_c=True)[0] * sizes
        S += S.T  # below the diagonal it was 0
        np.fill_diagonal(S, 0.5 * S.diagonal())
        W = S @ R
        try:
            S -= W @ np.linalg.solve(R.T @ W, W.T)  # in place, as columns lie one after the other
        except np.linalg.LinAlgError:  # a soft part moves far beside stiff ones
            return None
        return S

    def apply_schur(self, w: Array) -> Array:
        """S w = K_bb w − K_bi K_ii⁻¹ K_ib w, shapes ``(t,)`` or ``(t, q)``; K_ii factored once."""
        if self.schur is not None:
            return self.schur @ w
        Kw = self.stiffness @ w
        if self.inner is None:
            return Kw
        return Kw - self.coupling.transposed(self.inner.roughly(self.coupling @ w))

    @cached_property
    def stiffness(self) -> LocalMatrix:
        """K_bb, that on the trace."""
        return LocalMatrix(self._of.product.part(self.trace, self.trace))

    @cached_property
    def coupling(self) -> LocalMatrix:
        """K_ib."""
        return LocalMatrix(self._of.product.part(self.inside, self.trace))

    @cached_property
    def inner(self) -> CholeskyFactor | None:
        """K_ii⁺; K_ii is singular where the trace leaves a motion free, say normal rows only.

        None where there is no inside, or no trace that would ask for it.
        """
        stiffness, inside = self._of, self.inside
        if len(inside) == 0 or len(self.trace) == 0:
            return None
        # the triangle has the null space of the kernel's trace rows, and few rows itself
        triangle = np.linalg.qr(stiffness.null[self.trace], mode="r")
        _, sizes, V = np.linalg.svd(triangle)
        seen = int(np.sum(sizes > TOLERANCES.on_trace * sizes.max(initial=0.0)))
        R = stiffness.null[inside] @ V[seen:].T
        factory, K_ii = stiffness.factory, stiffness.product.part(inside, inside)
        factory.factorizations += 1
        try:
            factor = factory.factor if stiffness.mixed else CholeskyFactor
            if R.shape[1] or stiffness.mixed:
                K_ii = LocalMatrix(K_ii).entries().csr()
            fixing = fixing_dofs(stiffness.x, inside // stiffness.bs) if R.shape[1] else inside[:0]
            return regularised(K_ii, R, fixing, factory.prefix, factor)
        except FactorError as error:
            raise FactorError(
                f"{stiffness.name}: the stiffness of the unknowns that no constraint touches, for "
                f"the dirichlet preconditioner: {error}"
            ) from error


def stretch_over_shear(x: Array, bs: int, multiply: Callable[[Array], Array]) -> float:
    """About (λ + 2μ)/μ of a subdomain, whatever its cells are.

    On a subdomain, which is free, uᵀKu of a stretch along an axis is the volume times λ + 2μ, and
    that of a shear along it the volume times μ. The smallest ratio over the axes, but for the
    radius x[0] of an axisymmetric model, along which nothing is free; 0 where unknowns are no
    displacements.
    """
    if bs != x.shape[1] or bs == 1 or len(x) == 0:
        return 0.0
    x = x - x.mean(axis=0)

    def energy(axis: int, values: Array) -> float:
        u = np.zeros_like(x)
        u[:, axis] = values
        return float(u.ravel() @ multiply(u.ravel()))

    along = [energy(i, x[:, i]) for i in range(bs)]
    across = [max(energy(i, x[:, (i + 1) % bs]), TINY) for i in range(bs)]
    is_radius = energy(0, np.full(len(x), np.ptp(x))) > across[0]
    return min(a / b for a, b in list(zip(along, across, strict=True))[is_radius:])


# --- Equal subdomains -------------------------------------------------------------------------


@dataclass(frozen=True)
class EqualityTolerances:
    """Tolerances of equal subdomains."""

    # of the size of a subdomain: nodes nearer than that have the same place. Which nodes are meant
    # is all that it decides, so it is far below a cell and far above rounding of coordinates; the
    # root keeps places of regular grids, which are rational, off the middle between two roundings
    place: float = 1e-7 * 2.0**0.5
    # of the largest entry: rounding of a stiffness of cells of size h at x is 1e-16 x / h, and a
    # modulus that differs by more is another one
    entry: float = 1e-12


EQUAL = EqualityTolerances()


@dataclass(eq=False)
class EqualSubdomains:
    """The stiffnesses of a rank, each held once."""

    factory: InverseFactory  # makes their inverses
    # those that `keep` holds, by names of subdomains
    kept: dict[str, tuple[Stiffness, Traced | None]] = field(default_factory=dict)
    _of_shape: dict[bytes, WeakSet[Stiffness]] = field(default_factory=lambda: defaultdict(WeakSet))

    def keep(self, blocks: Sequence[Block]) -> None:
        """Hold the stiffnesses of Blocks, with their factors, for those that come after them.

        One is let go as soon as the subdomain of its name has another.
        """
        for block in blocks:
            if isinstance(block, SparseBlock) and block.equals is self:
                self.kept[block.name] = (block.stiffness, block.__dict__.get("traced"))

    def find(self, name: str, x: Array, K: Any) -> tuple[Stiffness, Array]:
        """Return the stiffness equal to K, or a new one, and the places of K's unknowns in it."""
        bs = K.shape[0] // len(x)
        shape, nodes = places_in_order(x)
        known = self._of_shape[bytes([bs]) + shape]
        for stiffness in known:
            its_nodes, place = places_in_order(stiffness.x)[1], np.empty_like(nodes)
            place[nodes] = its_nodes
            here = (place[:, None] * bs + np.arange(bs)).ravel().astype(np.int32)
            if _equal(K, stiffness, here):
                return stiffness, here
            del stiffness
        self.kept.pop(name, None)  # its factors go before others are made
        made = Stiffness(name, x, K, self.factory)
        known.add(made)
        return made, np.arange(K.shape[0], dtype=np.int32)


def outline(x: Array) -> bytes:
    """Number and extents of nodes, which subdomains that are equal have in common."""
    sizes = np.ptp(x, axis=0) if len(x) else np.zeros(1)
    digits = np.rint(sizes / (1e3 * EQUAL.place * (sizes.max() or 1.0)))
    return np.append(digits, len(x)).astype(np.int64).tobytes()


def places_in_order(x: Array) -> tuple[bytes, Array]:
    """Return the places of the nodes beside the lowest corner in their order, and this order.

    Sizes that differ show in K; as a part of the places they would have to be rounded.
    """
    corner = x.min(axis=0)
    size = float((x.max(axis=0) - corner).max()) or 1.0
    places = np.rint((x - corner) / (EQUAL.place * size)).astype(np.int64)
    nodes = np.lexsort(places.T)
    return places[nodes].tobytes(), nodes


def _equal(K: Any, other: Stiffness, here: Array) -> bool:
    """Return whether K equals the other stiffness, unknown i being the other's ``here[i]``."""
    allowed = EQUAL.entry * np.abs(other.K.data).max(initial=0.0)
    # the diagonals tell most of those apart that are not
    if not np.abs(K.diagonal() - other.diagonal[here]).max(initial=0.0) <= allowed:
        return False
    apart = other.product.part(here, here)
    apart.axpy(-1.0, as_petsc_matrix(K), PETSc.Mat.Structure.UNKNOWN)
    return bool(np.abs(apart.getValuesCSR()[2]).max(initial=0.0) <= allowed)


# --- Block of sparse finite elements ----------------------------------------------------------


class SparseBlock(Block):
    """Block of a sparse stiffness: factors of K_ρ and, when asked for, of K_ii.

    They belong to its stiffness, which it may share with Blocks that are equal to it. The numbering
    of the stiffness is that of the first of them. Creation raises an InputError where K is not
    symmetric, not finite or not positive semidefinite, or the load is not finite; a FactorError
    where a factor could not be made. ``equals`` finds the stiffness among those of equal
    subdomains; without it, it shares none. ``stiffness`` is K with its factors, until they are
    let go, ``place`` the unknown of it for each of its own, shape ``(n,)``.
    """

    def __init__(
        self,
        data: SubdomainData,
        factory: InverseFactory | None = None,
        equals: EqualSubdomains | None = None,
    ) -> None:
        self._factory, self.equals = factory or InverseFactory(), equals
        super().__init__(data)

    def set_stiffness(self, K: Any) -> None:
        """Take a stiffness."""
        self.stiffness, self.place = self._found(K)
        stiffness = self.stiffness
        # the first of equal ones has the arrays of the stiffness themselves
        here = slice(None) if stiffness.x is self.x else self.place
        self.diagonal, self.kernel = stiffness.diagonal[here], stiffness.kernel[here]
        if (own := stiffness.springs) is not None:
            self.springs = Springs(
                own.directions[self.place], own.stretches[self.place], own.stiffness
            )

    def _found(self, K: Any) -> tuple[Stiffness, Array]:
        """Return a Stiffness of K, and the place of each unknown in it; boundary elements' else."""
        if self.equals is not None:
            return self.equals.find(self.name, self.x, K)
        return Stiffness(self.name, self.x, K, self._factory), np.arange(K.shape[0])

    def multiply(self, u: Array) -> Array:
        """K u on all unknowns, shapes ``(n,)``."""
        return (self.stiffness.product @ scattered(u, self.place))[self.place]

    def solve(self, b: Array) -> Array:
        """K⁺ b on all unknowns, shapes ``(n,)``."""
        return self.stiffness.solve(scattered(b, self.place))[self.place]

    def apply_schur(self, w: Array) -> Array:
        """S w = K_bb w − K_bi K_ii⁻¹ K_ib w, shapes ``(t,)``; K_ii is factored once."""
        return self.traced.apply_schur(scattered(w, self.trace_rows))[self.trace_rows]

    def prepare(self, kind: OperatorKind) -> None:
        """Factor K_ii for ``"schur"``, where S is not known from a dense K⁺."""
        if kind == "schur" and self.traced.schur is None:
            self.traced.inner, self.traced.coupling  # noqa: B018

    def retrace(self, trace_dofs: Array) -> None:
        """Replace the trace; the factor of K_ii goes with it, that of K stays."""
        if not np.array_equal(trace_dofs, self.trace_dofs):
            self.trace_dofs = trace_dofs
            self.__dict__.pop("traced", None)

    def destroy(self) -> None:
        """Let the factors go, which nobody else may need."""
        for own in ("stiffness", "traced"):
            self.__dict__.pop(own, None)

    @cached_property
    def traced(self) -> Traced:
        """The stiffness on the trace, in its own numbering."""
        return self.stiffness.on_trace(np.sort(self.place[self.trace_dofs]))

    @property
    def trace_rows(self) -> Array:
        """Row of ``traced`` for each trace unknown, shape ``(t,)``."""
        return np.searchsorted(self.traced.trace, self.place[self.trace_dofs])


def scattered(x: Array, places: Array) -> Array:
    """Return y with ``y[places] = x``."""
    y = np.empty(x.shape)
    y[places] = x
    return y
