"""The generalised inverse K⁺ of a subdomain, and why a stiffness has none."""

import logging
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
from petsc4py import PETSc
from scipy.sparse import csr_array, diags_array

from tfeti_dolfinx.common.arrays import TINY, Array, plus
from tfeti_dolfinx.subdomains.factor import CholeskyFactor, NotPositiveDefiniteError
from tfeti_dolfinx.subdomains.mixed import MIXED, MixedFactor, cholmod

log = logging.getLogger(__name__)

# --- K⁺ -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class InverseTolerances:
    """Tolerances of generalised inverses."""

    still: float = 1e-8  # entry of a kernel, over its largest, that is rounding
    # of the diagonal: what this makes positive definite was indefinite by rounding only, which in
    # assembly and factor comes to 1e-14 or so
    rounding: float = 1e-12
    # length of a subdomain over its shortest edge from which on rounding may hide the energy of its
    # softest deformations, which falls with the fourth power in sheets
    fine: float = 1e3
    spread: float = 1e8  # ratio of diagonal entries of K from which on rounding may do so
    # of the mean of the diagonal, over n^(2/d) for n nodes, which is about what its neighbours hold
    # a subdomain with: stiffer springs are left in K, and cost no more there
    soft: float = 0.5
    # the same in tangents, where forces of springs, which are others in each, are no start
    weak: float = 0.05


TOLERANCES = InverseTolerances()


class GeneralisedInverse(Protocol):
    """K⁺ with K K⁺ K = K, symmetric positive semidefinite."""

    def solve(self, b: Array) -> Array:
        """K⁺ b, shape ``(n,)``."""


# from K, its kernel, the unknowns of fixing nodes and a prefix of options to K⁺
MakeInverse = Callable[[Any, Array, Array, str], GeneralisedInverse]


# from a matrix and a prefix of options to its factor
MakeFactor = Callable[[Any, str], CholeskyFactor]


def regularised(
    K: Any,
    R: Array,
    fixing_dofs: Array,
    prefix: str = "tfeti_sub_",
    factor: MakeFactor = CholeskyFactor,
) -> CholeskyFactor:
    """Factor K_ρ = K + ρ Nᵀ(NNᵀ)⁻¹N, N the kernel on a few fixing unknowns, ρ = max diag K.

    K_ρ⁻¹ is an exact generalised inverse, because N R is regular (Brzobohatý, Dostál, Kozubek,
    Kovář, Markopoulos, IJNME 88, 2011, section 4). Raise a NotPositiveDefiniteError where K_ρ has
    no Cholesky factor; a FactorError where it could not be made for another reason. K is scipy CSR,
    or PETSc's where R has no columns; the fixing unknowns ascend.
    """
    if R.shape[1] == 0:
        return factor(K, prefix)
    Q, _ = np.linalg.qr(R[fixing_dofs])
    # what moves in no motion may be far stiffer
    moves = np.abs(R).max(axis=1) > TOLERANCES.still * np.abs(R).max()
    added = K.diagonal()[moves].max() * (Q @ Q.T)
    count = len(fixing_dofs)
    row, column = np.repeat(fixing_dofs, count), np.tile(fixing_dofs, count)
    return factor(plus(K, row, column, added.ravel()), prefix)


@dataclass
class InverseFactory:
    """Factory of generalised inverses."""

    kplus: MakeInverse | None = None  # makes the generalised inverse; None: `regularised`
    prefix: str = "tfeti_sub_"  # prefix of the factors' PETSc options
    factorizations: int = 0  # of this rank so far
    soft: float = TOLERANCES.soft  # springs below this are taken out of stiffnesses
    mixed: bool = False  # whether large factors may be in single precision
    # outlines that several subdomains have: they may be equal, and apply one factor at once
    shared: Collection[bytes] = ()

    def inverse(self, K: Any, R: Array, fixing_dofs: Array, mixed: bool) -> GeneralisedInverse:
        """Make the generalised inverse of a stiffness, whose factor may be ``mixed``.

        Raise as ``regularised``.
        """
        if self.kplus is not None:
            return self.kplus(K, R, fixing_dofs, self.prefix)
        return regularised(K, R, fixing_dofs, self.prefix, self.factor if mixed else CholeskyFactor)

    def factor(self, A: Any, prefix: str) -> CholeskyFactor:
        """Return a factor in single precision where that pays and does, else PETSc's.

        Options with the prefix are PETSc's, and ask for its factor. Where single precision does not
        do for one, it is not tried again: others are like it. Raise as ``CholeskyFactor``.
        """
        pays = self.mixed and MIXED.size <= A.shape[0] <= MIXED.most
        own = cholmod() if pays else None
        if own is not None and not PETSc.Options(prefix).getAll():
            try:
                return MixedFactor(A, own, partial(self._exact, prefix))
            except ArithmeticError as error:
                log.debug("a factor of %d unknowns: %s", A.shape[0], error)
                self.mixed = False
        return CholeskyFactor(A, prefix)

    def _exact(self, prefix: str, A: Any) -> CholeskyFactor:
        """Make a factor in the place of one in single precision."""
        self.factorizations += 1
        return CholeskyFactor(A, prefix)


# --- Causes of indefinite stiffnesses -----------------------------------------------------------


def why_indefinite(
    K: Any, R: Array, outside: Array, fixing_dofs: Array, x: Array, prefix: str
) -> str:
    """Say what is wrong with a stiffness whose K_ρ has no Cholesky factor, or a useless one.

    Raise a FactorError where it could not be found out, say for want of memory.
    """
    diagonal = K.diagonal()
    shifted = csr_array(K + diags_array(TOLERANCES.rounding * diagonal))
    try:
        factor = regularised(shifted, R, fixing_dofs, prefix)
    except NotPositiveDefiniteError:
        return (
            "the stiffness is not positive semidefinite; expected a linear elastic form, or of a "
            "nonlinear one a tangent of a material that does not soften"
        )
    if gives_no_energy(K, np.hstack((R, outside)), x, factor):
        return (
            f"the form gives no energy to motions besides the {R.shape[1]} of a rigid body that it "
            "leaves free; expected a linear elastic form of the whole strain, with quadrature that "
            "is fine enough (one point leaves hourglasses to quadrilaterals and hexahedra)"
        )
    extents = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    return (
        "the stiffness is indefinite by rounding: its softest deformations are lost next to its "
        f"stiffest (its length is {extents[0] / max(extents[-1], TINY):.0e} of its thickness, its "
        f"diagonal spans a factor of {diagonal.max() / diagonal.min():.0e}); expected subdomains "
        "and cells that are less flat, or moduli that differ less"
    )


def gives_no_energy(K: Any, rigid: Array, x: Array, inverse: CholeskyFactor) -> bool:
    """Return whether an inverse of K_ρ blows up a motion that is not rigid and has no energy.

    Pivots that should be 0 are positive where rounding makes them so. ``rigid`` are all rigid
    motions, as springs may hold some by little. It takes one solve.
    """
    noise = np.sin(np.arange(K.shape[0]) ** 2.0)
    u = inverse.solve(noise - rigid @ (rigid.T @ noise))
    u -= rigid @ (rigid.T @ u)
    lost = float(u @ (K @ u)) <= TOLERANCES.rounding * float(u @ (K.diagonal() * u))
    if not lost:
        return False
    # rounding may be as large as the energy of the softest deformations
    entries, diagonal = K.tocoo(), K.diagonal()
    row, column = (index // (K.shape[0] // len(x)) for index in entries.coords)
    edges = np.linalg.norm(x[row] - x[column], axis=1)[row != column]
    length = np.linalg.norm(np.ptp(x, axis=0))
    fine = length > TOLERANCES.fine * edges.min(initial=np.inf)
    return not (fine or diagonal.max() > TOLERANCES.spread * diagonal.min())
