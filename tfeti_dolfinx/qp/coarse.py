"""The coarse problem as a QP solver sees it: projectors P and Q."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.parallel import bcast_from_root, summed
from tfeti_dolfinx.qp.sets import Face

# --- The coarse space of Gλ = e ---------------------------------------------------------------

# of the largest forces on an equation: those on a light one beside it count as so large at least,
# since the rounding of the largest reaches them
LIGHT = 1e-4

# what ``imbalance`` says where Gλ = e holds as well as factors can tell
HELD = 1e-9

NOTHING: Array = np.zeros(0)


class Coarse(Protocol):
    """The constraint Gλ = e, λ in a face with the free directions Z.

    With G_f = GZ the projectors are Q = Z G_fᵀ(G_f G_fᵀ)⁺G_f Zᵀ and P = ZZᵀ − Q. Vectors keep the
    layout of all rows. Without a face Z = I, so that P = I − Q.

    Attributes:
        dimension: Number r of equations.
        e: Right side, replicated, shape ``(r,)``.
    """

    @property
    def dimension(self) -> int:
        """Number r of equations."""
        ...

    @property
    def e(self) -> Array:
        """Right side, replicated, shape ``(r,)``."""
        ...

    def residual(self, x: PETSc.Vec) -> Array:
        """e − G_f Zᵀx, replicated, shape ``(r,)``. Collective."""
        ...

    def forces(self, x: PETSc.Vec) -> Array:
        """Return the sum of the moduli of the terms of each entry of the residual. Collective."""
        ...

    def damped_solve(self, face: Face, y: Array, damping: float) -> Array:
        """(G_f G_fᵀ + damping·GGᵀ)⁻¹y, f a face of all rows. Collective."""
        ...

    def solve(self, y: Array) -> Array:
        """(G_f G_fᵀ)⁺y, y replicated."""
        ...

    def project(self, x: PETSc.Vec) -> None:
        """x ← P x. Collective."""
        ...

    def project_against(
        self, x: PETSc.Vec, y: PETSc.Vec, more: Array = NOTHING
    ) -> tuple[float, float, Array]:
        """x ← P x; yᵀPx and yᵀy, for y in the face. Collective, one reduction.

        Ranks may round yᵀPx differently.

        Args:
            x: Projected in place.
            y: In the face.
            more: Numbers of this rank that are summed up over all ranks on the way.

        Returns:
            Both products, and the sums.
        """
        ...

    def apply_Q(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = Q x. Collective."""
        ...

    def norm_Q(self, x: PETSc.Vec) -> float:
        """‖Q x‖, the same on all ranks. Collective."""
        ...

    def particular(self, x: PETSc.Vec) -> None:
        """x = Z G_fᵀ(G_f G_fᵀ)⁺e, the smallest Gλ = e of the face, if it has one. Collective."""
        ...

    def coordinates(self, x: PETSc.Vec) -> Array:
        """(G_f G_fᵀ)⁺G_f Zᵀ x, replicated. Collective."""
        ...

    def combine(self, mu: Array, x: PETSc.Vec) -> None:
        """x = ZZᵀGᵀ μ."""
        ...

    def on_face(self, face: Face) -> Coarse:
        """Return the same constraint on (another) face of all rows. Collective."""
        ...

    def destroy(self) -> None:
        """Free what a factor holds. Collective."""
        ...


def imbalance(coarse: Coarse, x: PETSc.Vec) -> float:
    """Return the largest entry of Gx − e over the size of its terms, at most 1. Collective."""
    forces = coarse.forces(x)
    floor = max(LIGHT * float(forces.max(initial=0.0)), TINY)
    own = np.max(np.abs(coarse.residual(x)) / np.maximum(forces, floor), initial=0.0)
    return bcast_from_root(x.getComm().tompi4py(), float(own))


def _products(x: PETSc.Vec, y: PETSc.Vec, more: Array) -> tuple[float, float, Array]:
    """yᵀx, yᵀy, and more sums. Collective, one reduction."""
    own = y.array_r
    sums = summed(x.getComm().tompi4py(), np.append((own @ x.array_r, own @ own), more))
    return float(sums[0]), float(sums[1]), sums[2:]


class NoCoarse:
    """No equality constraint: Q = 0, at no cost.

    Args:
        face: The face; default all rows.
    """

    dimension = 0

    def __init__(self, face: Face | None = None) -> None:
        self._face, self.e = face, np.zeros(0)

    def residual(self, x: PETSc.Vec) -> Array:
        """None."""
        return np.zeros(0)

    def forces(self, x: PETSc.Vec) -> Array:
        """None."""
        return np.zeros(0)

    def damped_solve(self, face: Face, y: Array, damping: float) -> Array:
        """None."""
        return y

    def solve(self, y: Array) -> Array:
        """None."""
        return y

    def project(self, x: PETSc.Vec) -> None:
        """x ← ZZᵀx."""
        if self._face is not None:
            x.array[:] = self._face.restricted(x.array_r)

    def project_against(
        self, x: PETSc.Vec, y: PETSc.Vec, more: Array = NOTHING
    ) -> tuple[float, float, Array]:
        """x ← ZZᵀx; yᵀx and yᵀy."""
        self.project(x)
        return _products(x, y, more)

    def apply_Q(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = 0."""
        y.set(0.0)

    def norm_Q(self, x: PETSc.Vec) -> float:
        """0."""
        return 0.0

    def particular(self, x: PETSc.Vec) -> None:
        """x = 0."""
        x.set(0.0)

    def coordinates(self, x: PETSc.Vec) -> Array:
        """None."""
        return np.zeros(0)

    def combine(self, mu: Array, x: PETSc.Vec) -> None:
        """x = 0."""
        x.set(0.0)

    def on_face(self, face: Face) -> NoCoarse:
        """Only masks."""
        return NoCoarse(face)

    def destroy(self) -> None:
        """Nothing to free."""


class DenseCoarse:
    """A constraint from a dense G, for a program on one rank.

    Args:
        G: Shape ``(r, m)``.
        e: Shape ``(r,)``.
        face: The face; default all rows.
    """

    def __init__(self, G: Array, e: Array, face: Face | None = None) -> None:
        self._G, self._face, self.e, self.dimension = G, face, e, len(e)
        self._Gf = G if face is None else np.asarray((face.Z @ (face.Z.T @ G.T)).T)
        self._inverse = np.linalg.pinv(self._Gf @ self._Gf.T, hermitian=True)

    def residual(self, x: PETSc.Vec) -> Array:
        """e − G_f Zᵀx."""
        return np.asarray(self.e - self._Gf @ x.array_r)

    def forces(self, x: PETSc.Vec) -> Array:
        """Σ|G_f Zᵀ||x| + |e|."""
        return np.asarray(np.abs(self._Gf) @ np.abs(x.array_r) + np.abs(self.e))

    def damped_solve(self, face: Face, y: Array, damping: float) -> Array:
        """(G_f G_fᵀ + damping·GGᵀ)⁺y."""
        GZ = (face.Z.T @ self._G.T).T
        gram = GZ @ GZ.T + damping * self._G @ self._G.T
        return np.asarray(np.linalg.pinv(gram, hermitian=True) @ y)

    def solve(self, y: Array) -> Array:
        """(G_f G_fᵀ)⁺y."""
        return np.asarray(self._inverse @ y)

    def project(self, x: PETSc.Vec) -> None:
        """x ← P x."""
        values = x.array_r if self._face is None else self._face.restricted(x.array_r)
        x.array[:] = values - self._Gf.T @ self.coordinates(x)

    def project_against(
        self, x: PETSc.Vec, y: PETSc.Vec, more: Array = NOTHING
    ) -> tuple[float, float, Array]:
        """x ← P x; yᵀPx and yᵀy."""
        self.project(x)
        return _products(x, y, more)

    def apply_Q(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = Q x."""
        self.combine(self.coordinates(x), y)

    def norm_Q(self, x: PETSc.Vec) -> float:
        """‖Q x‖."""
        return float(np.linalg.norm(self._Gf.T @ self.coordinates(x)))

    def particular(self, x: PETSc.Vec) -> None:
        """x = Z G_fᵀ(G_f G_fᵀ)⁺e."""
        self.combine(self._inverse @ self.e, x)

    def coordinates(self, x: PETSc.Vec) -> Array:
        """(G_f G_fᵀ)⁺G_f Zᵀ x."""
        return np.asarray(self._inverse @ (self._Gf @ x.array_r))

    def combine(self, mu: Array, x: PETSc.Vec) -> None:
        """x = ZZᵀGᵀ μ."""
        x.array[:] = self._Gf.T @ mu

    def on_face(self, face: Face) -> DenseCoarse:
        """Return the same G on a face."""
        return DenseCoarse(self._G, self.e, face)

    def destroy(self) -> None:
        """Nothing to free."""


# --- Oblique projection of dependent multipliers ----------------------------------------------


class Oblique(Protocol):
    """Projectors of a face Z on whose vectors u others depend: λ = (I + C)u.

    With G_f = GZ and H = G(I + C)ZG_fᵀ: P = Z(I − G_fᵀH⁺G(I + C)Z)Zᵀ. Vectors are this rank's
    parts, in the layout of all rows.
    """

    def coordinates(self, x: Array) -> Array:
        """H⁺G(I + C)ZZᵀx, replicated, shape ``(r,)``. Collective."""
        ...

    def project(self, x: Array) -> Array:
        """P x, shapes ``(m,)`` or ``(m, q)``. Collective."""
        ...

    def restoring(self, y: Array) -> Array:
        """Return u = ZG_fᵀH⁺y, which solves G(I + C)u = y if that is solvable. Not collective."""
        ...


class NoOblique:
    """Without Gλ = e: only masks.

    Args:
        face: The face.
    """

    def __init__(self, face: Face) -> None:
        self._face = face

    def coordinates(self, x: Array) -> Array:
        """None."""
        return np.zeros(0)

    def project(self, x: Array) -> Array:
        """ZZᵀx."""
        return self._face.restricted(x)

    def restoring(self, y: Array) -> Array:
        """0."""
        return np.zeros(self._face.Z.shape[0])
