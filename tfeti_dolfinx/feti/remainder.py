"""The defect problem of iterative refinement, as a dual problem of its own."""

from __future__ import annotations

from dataclasses import replace

from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import Array, joined
from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.feti.coarse import CoarseSpace
from tfeti_dolfinx.feti.dual import Dual
from tfeti_dolfinx.feti.recovery import bent, recover, without_rigid_motions
from tfeti_dolfinx.qp.coarse import Coarse, NoCoarse
from tfeti_dolfinx.qp.problem import QP
from tfeti_dolfinx.qp.sets import Face, FeasibleSet
from tfeti_dolfinx.subdomains.local_operators import LocalOperator
from tfeti_dolfinx.subdomains.subdomains import Subdomains


class DefectProblem:
    """The dual problem of δλ and δu, for λ = λ₀ + δλ and u = u₀ + δu.

    K δu + Bᵀδλ = f − K v₀ − Bᵀλ₀, B δu = c − B u₀ on what is closed, λ₀ + δλ in Ω: the same F with
    another d, another e and Ω − λ₀. Where subdomains bend by far more than the solution does, the
    rounding of λ alone moves K⁺(f − Bᵀλ) by more than u may be wrong by; δλ has digits that λ has
    no room for. v₀ is u₀, or u₀ less motions of subdomains: of these K makes forces that are its
    rounding, which may be more than what bends a body that moves far. Creation and all methods are
    collective.

    Args:
        dual: The dual problem.
        lam: λ₀, this rank's part.
        u: u₀, this rank's part, shape ``(n,)``.
        v: v₀, this rank's part, shape ``(n,)``; default u₀.

    Attributes:
        constraints: Those of the dual problem.
        subdomains: Its subdomains.
        coarse: Its coarse space, for this e.
        feasible: Ω − λ₀.
        pressing: After ``recover``: contact rows whose force is more than the solver's error.
    """

    constraints: Constraints
    subdomains: Subdomains
    coarse: CoarseSpace
    feasible: FeasibleSet

    def __init__(self, dual: Dual, lam: Array, u: Array, v: Array | None = None) -> None:
        self._dual, self._lam, self._u = dual, lam, u
        self._v = u if v is None else v
        self.constraints, self.subdomains = dual.constraints, dual.subdomains
        self.pressing = dual.pressing
        self.feasible = dual.feasible.shifted(lam)
        B, subdomains = self.constraints.B, self.subdomains
        w, on_trace, x = B.createVecRight(), B.createVecRight(), dual.d.duplicate()
        x.array[:] = lam
        B.multTranspose(x, w)
        force = _force_left(subdomains, self._v) - subdomains.extended(w.array_r)
        self._response = subdomains.solve(force)
        self.coarse = dual.coarse.under(force)
        self._c, self.d = dual.d.duplicate(), dual.d.duplicate()
        on_trace.array[:] = u[subdomains.trace]
        B.mult(on_trace, self._c)
        self._c.aypx(-1.0, self.constraints.c)
        on_trace.array[:] = self._response[subdomains.trace]
        B.mult(on_trace, self.d)
        self.d.axpy(-1.0, self._c)
        for vec in (w, on_trace, x):
            vec.destroy()

    @property
    def lifting(self) -> LocalOperator:
        """S of this rank's subdomains."""
        return self._dual.lifting

    def qp(self) -> QP:
        """Return the quadratic program of δλ."""
        coarse: Coarse = self.coarse if self.coarse.dimension else NoCoarse()
        return replace(self._dual.qp(), d=self.d, coarse=coarse, feasible=self.feasible)

    def start(self, face: Face) -> PETSc.Vec:
        """Return the least δλ on the face of λ₀ that balances the load's defect."""
        coarse, lam = self.qp().coarse.on_face(face), self.d.duplicate()
        coarse.particular(lam)
        coarse.destroy()
        lam.array[:] = self.feasible.onto(lam.array_r, face.status)
        return lam

    def recover(self, lam: PETSc.Vec, gradient: PETSc.Vec, face: Face, error: float) -> Array:
        """u₀ + δu of a δλ; arguments as of the dual problem."""
        B, c = self.constraints.B, self._c
        du, gap, _ = recover(B, c, self.coarse, lam, gradient, face, self._response)
        u = self._dual.smallest(self._u + du, gap, self._lam + lam.array_r, face, error)
        self.pressing = self._dual.pressing
        return u

    def at_rest(self, lam: PETSc.Vec) -> Array:
        """v₀ + δv of a δλ, shape ``(n,)``. Collective."""
        B, subdomains = self.constraints.B, self.subdomains
        return self._v + without_rigid_motions(subdomains, bent(B, subdomains, lam, self._response))

    def destroy(self) -> None:
        """Destroy the vectors."""
        self._c.destroy()
        self.d.destroy()


def _force_left(subdomains: Subdomains, u: Array) -> Array:
    """f − K u without its resultants, which are rounding, shape ``(n,)``."""
    left = []
    for block, part in zip(subdomains.blocks, subdomains.dof_parts, strict=True):
        force = block.multiply(u[part])
        left.append(block.load - force + block.kernel @ (block.kernel.T @ force))
    return joined(left)
