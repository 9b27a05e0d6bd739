"""Motions of subdomains that something holds, but softly: a coarse space for preconditioners.

Springs or inertia in a stiffness leave fewer kernel modes than a free subdomain has, and on what is
left of its rigid motions K⁺ is large: F ≈ F₀ + ĜᵀD⁻¹Ĝ with Ĝ = R̂ᵀBᵀ, D = R̂ᵀKR̂. The natural
coarse space does not know of them, and M_f is an inverse of F₀ alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from petsc4py import PETSc
from scipy.sparse import csr_array, diags_array, hstack, vstack

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import bcast_from_root, joined_over, summed
from tfeti_dolfinx.feti.coarse import CoarseSpace, transposed_G
from tfeti_dolfinx.feti.operator import DualOperator
from tfeti_dolfinx.feti.projectors import FaceFactors, Grams, NullModes
from tfeti_dolfinx.qp.problem import FaceOperator
from tfeti_dolfinx.qp.sets import Face
from tfeti_dolfinx.subdomains.subdomains import Subdomains


@dataclass(frozen=True)
class SoftParameters:
    """Parameters of soft motions."""

    steps: int = 3  # steps of the power method
    # the eigenvalue that it finds from which on a coarse problem pays: with cτ/H = 1.4 on squares,
    # 1.8 on cubes
    large: float = 2.4
    # of the stiffness of a motion's rows: the least energy that it is taken to have
    rounding: float = 1e-30


PARAMETERS = SoftParameters()


class Balanced:
    """M = (I − YC)ᵀ M_f (I − YC) + CᵀDC with C = XYᵀ, beside a part that is solved for apart.

    Mandel, Comm. Numer. Methods Engrg. 9, 1993, 233–241. Where D = (CFCᵀ)⁻¹ and Y = FCᵀD it is the
    inverse of F on the range of Cᵀ; what is only near to that remains positive semidefinite, and
    definite if no x has both (I − YC)x = 0 and DCx = 0. Vectors of rows are this rank's parts;
    coordinates may be replicated or distributed. The functions are collective.

    Args:
        on_face: M_f, which is taken over.
        energy: D, shape of the coordinates.
        solve: X c.
        forces: Y c, in the face.
        moved: Yᵀ y, y in the face.
        owned: What is destroyed with it.
    """

    def __init__(
        self,
        on_face: FaceOperator,
        energy: Array,
        *,
        solve: Callable[[Array], Array],
        forces: Callable[[Array], Array],
        moved: Callable[[Array], Array],
        owned: Sequence[Any] = (),
    ) -> None:
        self._on_face, self._energy, self._owned = on_face, energy, owned
        self._solve, self._forces, self._moved = solve, forces, moved

    def __call__(self, x: Array) -> Array:
        """M x, x in the face. Collective."""
        c = self._solve(self._moved(x))
        y = self._on_face(x - self._forces(c))
        return y - self._forces(self._solve(self._moved(y) - self._energy * c))

    def destroy(self) -> None:
        """Free what it has been given. Collective."""
        for item in (self._on_face, *self._owned):
            item.destroy()


class Deflation(Protocol):
    """A coarse space of a preconditioner on faces."""

    count: int  # number of its motions, of all subdomains
    factors: FaceFactors  # makes the factors of faces, and counts them

    def balanced(self, face: Face, on_face: FaceOperator) -> FaceOperator:
        """Return M_f, which is taken over, with these motions. Collective."""

    def destroy(self) -> None:
        """Free what belongs to it. Collective."""


class SoftModes:
    """Ĝ of the motions that springs hold more softly than rows would. Creation is collective.

    Such are those with R̂ᵀKR̂ < σ‖Ĝᵀ‖², σ the mean stiffness of a scaled row. They make eigenvalues
    of M_f F up to about 1 and the largest one of D⁻¹ĜM_fĜᵀ: where that is small M_f is better
    alone, and none of them is taken; some would be worse than all or none. Where every subdomain
    has all its rigid motions in the kernel there are none, and nothing is multiplied; else M_f is
    three times.
    """

    def __init__(
        self,
        B: PETSc.Mat,
        coarse: CoarseSpace,
        weights: Array,
        preconditioner: DualOperator,
        prefix: str = "tfeti_coarse_",
    ) -> None:
        self._comm = coarse.comm
        # this rank's rows of Ĝᵀ, with all motions outside of kernels as columns, and D
        rows, own = coarse.subdomains.soft_motions()
        energy, Gt = joined_over(self._comm, own), csr_array((B.getLocalSize()[0], 0))
        if len(energy):
            Gt = transposed_G(B, rows, len(energy))
        sigma = mean_stiffness(coarse.subdomains, weights)
        squares = np.bincount(Gt.indices, Gt.data**2, minlength=Gt.shape[1]).astype(float)
        squares = summed(self._comm, squares)
        soft = bcast_from_root(self._comm, np.flatnonzero(energy < sigma * squares))
        if len(soft):
            scale = np.sqrt(np.maximum(energy[soft], PARAMETERS.rounding * sigma * squares[soft]))
            # the power method for ĜMĜᵀ, of motions of energy 1
            G, size = csr_array(Gt[:, soft] / scale), 0.0
            v = np.random.default_rng(0).standard_normal(len(soft))
            for _ in range(PARAMETERS.steps):
                v /= np.linalg.norm(v)
                with preconditioner.charged_to("soft motions"):
                    image = summed(self._comm, G.T @ preconditioner(G @ v))
                size, v = float(v @ image), image
            if not bcast_from_root(self._comm, size > PARAMETERS.large):
                soft = soft[:0]
        self.count = len(soft)
        null = coarse.null
        if self.count:
            null = vstack([null, csr_array((self.count, null.shape[1]))], format="csr")
        self.factors = FaceFactors(self._comm, NullModes(null), prefix)
        self._grams: Grams | None = None
        if self.count == 0:
            return
        self._energy = np.concatenate((np.zeros(coarse.dimension), energy[soft]))
        self._damping = diags_array(self._energy / sigma)
        self._Gt = csr_array(hstack((coarse.Gt, Gt[:, soft]), format="csr"))
        contact = np.concatenate((coarse.bounded, coarse.rubbing))
        self._grams = Grams(self._Gt, contact, self._comm)

    def balanced(self, face: Face, on_face: FaceOperator) -> FaceOperator:
        """An approximate inverse of F on a face; M_f itself where nothing is soft. Collective.

        Y = [G; Ĝ]ᵀ, X = ([G; Ĝ][G; Ĝ]ᵀ + [0 0; 0 D/σ])⁻¹: CFCᵀ is taken for D⁻¹. Where springs
        are soft it nearly is; where they are not, C is small. On faces [G; Ĝ] may lack rank: what
        is left free Cᵀ does not see.
        """
        if self._grams is None:
            return on_face
        factor = self.factors.factor(csr_array(self._grams.of_face(face) + self._damping))
        return Balanced(
            on_face,
            self._energy,
            solve=factor.solve,
            forces=lambda c: face.restricted(self._Gt @ c),
            moved=lambda y: summed(self._comm, self._Gt.T @ face.restricted(y)),
        )

    def destroy(self) -> None:
        """Nothing of PETSc is kept."""


# from B, the natural coarse space, weights, preconditioner and a prefix of options
MakeDeflation = Callable[[PETSc.Mat, CoarseSpace, Array, DualOperator, str], Deflation]


def mean_stiffness(subdomains: Subdomains, weights: Array) -> float:
    """σ, the mean stiffness of a row scaled with D, the weights. Collective."""
    terms = np.array([np.sum(subdomains.diagonal / weights), len(weights)])
    stiffness, unknowns = summed(subdomains.comm, terms)
    return float(stiffness / max(unknowns, 1.0))
