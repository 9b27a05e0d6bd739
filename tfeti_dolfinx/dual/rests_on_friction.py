"""Whether friction that alone holds a motion of bodies balances the load where they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array, diags_array

from tfeti_dolfinx.arrays import TINY, Array, sum_rows
from tfeti_dolfinx.dual.coarse import CoarseSpace
from tfeti_dolfinx.dual.recovery import missed
from tfeti_dolfinx.dual.smallest import orthonormal
from tfeti_dolfinx.gluing.constraints import Constraints
from tfeti_dolfinx.parallel import agreed

# of rtol: how far a body may be from where friction balances its load
FAR = 20.0
# rounding of displacements, of the largest; of the work of a load, of the most that it could do;
# and of that of friction what says nothing of where a body is
NOISE, ROUNDING, NO_HOLD = 2.5e-13, 1e-14, 1e-6


@dataclass(frozen=True)
class Lost:
    """Motions of bodies along which a displacement is wrong, or not determined; on all ranks.

    Attributes:
        motions: As columns on the bodies' motions, scipy CSR, shape ``(bodies * k, lost)``.
        share: What friction bears along each, of the most that the largest load could do, shape
            ``(lost,)``.
    """

    motions: csr_array
    share: Array


def lost_on_friction(
    coarse: CoarseSpace, constraints: Constraints, u: Array, lam: Array, rtol: float
) -> Lost | None:
    """Motions that friction alone holds, but not where the displacement is. Collective.

    Along a motion y that neither springs, nor equality rows, nor closed normals resist, friction
    balances the load e: ρ(t) = yᵀe − Σψ_i (T_i y)ᵀq_i/‖q_i‖, q_i the slips of u + ty, is 0 or jumps
    over it at t = 0. It falls with t, so u is farther than t from such a place along y if ρ does
    not change its sign between −t and t. Where ψ_i is tiny nothing else sees that: τ_i moves
    nothing, and a slip that it does not allow is hardly work. Products with B, none with F.

    Args:
        coarse: The coarse space.
        constraints: Rows, their limits and coefficients.
        u: This rank's displacement, shape ``(n,)``.
        lam: The multipliers of this rank's rows.
        rtol: The relative tolerance that was asked for.

    Returns:
        Those motions of which that is so for 20 rtol of the displacement, or None.
    """
    w = missed(constraints, u[coarse.subdomains.trace])
    slips = np.array(w.array_r)
    w.destroy()
    allowed = _allowed(coarse, u, rtol)
    N = _held_by_nothing_else(coarse, constraints, slips, allowed)
    if N.shape[1] == 0:
        return None
    law = _Sliding(coarse, constraints, slips, lam, N)
    reach = _largest(N, np.repeat(allowed, coarse.bodies.k))
    back, ahead = law.left(-reach), law.left(reach)
    # what friction bears is lost in the noise of the solution: there it must say where a body is
    weak = law.most <= rtol * law.load
    sure = np.where(weak, np.maximum(NO_HOLD * law.most, law.noise), -rtol * law.most)
    lost = agreed(coarse.comm, (law.most > 0.0) & ((back < sure) | (ahead > -sure)))
    if not lost.any():
        return None
    return Lost(csr_array(N[:, np.flatnonzero(lost)]), law.most[lost] / max(law.load, TINY))


class _Sliding:
    """Load and friction along motions, shape ``(motions,)``, on all ranks. Creation is collective.

    Attributes:
        most: The most that friction can bear, Σ‖ψ_i T_i y‖.
        load: The most that the largest load on a body could do.
        noise: Rounding of the work of the load.
    """

    def __init__(
        self,
        coarse: CoarseSpace,
        constraints: Constraints,
        slips: Array,
        lam: Array,
        N: csr_array,
    ) -> None:
        rows, size = constraints.sets.tangents, constraints.tangent_scale[:, None]
        by_law = constraints.coefficients * lam[constraints.pressed_by][:, None]
        pressed = (constraints.pressed_by >= 0)[:, None]
        limits = np.where(pressed, by_law, constraints.limits) * size
        J = csr_array(diags_array(coarse.row_size) @ coarse.J @ N)
        along = [csr_array(J[own]) for own in rows.T]
        i, self._motion = sum((abs(A) for A in along), csr_array(along[0].shape)).nonzero()
        entries = [np.asarray(A[i, self._motion]).ravel() for A in along]
        self._v = np.stack(entries, axis=1) / size[i]
        self._q, self._limits = (slips[rows] / size)[i], limits[i]
        self._comm, self._count = coarse.comm, N.shape[1]
        self.most = self._summed(np.linalg.norm(self._limits * self._v, axis=1))
        self._work = N.T @ (coarse.motions.T @ coarse.e)
        bodies = coarse.bodies
        largest = bodies.loads * np.sqrt(bodies.nodes)
        self.load = float(largest.max(initial=0.0))
        self.noise = ROUNDING * _largest(N, np.repeat(largest, bodies.k))

    def left(self, t: Array) -> Array:
        """ρ of each motion, t of it farther. Collective."""
        z = self._limits * (self._q + t[self._motion][:, None] * self._v)
        length = np.maximum(np.linalg.norm(z, axis=1), TINY)
        return self._work - self._summed(np.sum(self._limits * z * self._v, axis=1) / length)

    def _summed(self, values: Array) -> Array:
        own = sum_rows(self._motion, values, self._count)
        self._comm.Allreduce(MPI.IN_PLACE, own, op=MPI.SUM)
        return own


def _allowed(coarse: CoarseSpace, u: Array, rtol: float) -> Array:
    """How far each body may be off, shape ``(bodies,)``."""
    size = coarse.subdomains.body_maxima([coarse.subdomains.sizes(u)])[0]
    return np.asarray(FAR * rtol * size + NOISE * size.max(initial=0.0))


def _held_by_nothing_else(
    coarse: CoarseSpace, constraints: Constraints, slips: Array, allowed: Array
) -> csr_array:
    """Orthonormal motions that normals which may be closed do not resist, on all ranks."""
    row, column = coarse.J.tocoo().coords
    near = np.zeros(len(slips))
    np.maximum.at(near, row, allowed[column // coarse.bodies.k])
    closed, normals = np.zeros(len(slips), dtype=bool), constraints.sets.normals
    closed[normals] = -slips[normals] <= near[normals] * constraints.scale
    motions = coarse.unresisted(closed)
    return agreed(coarse.comm, orthonormal(motions, coarse.bodies.k)[0])


def _largest(N: csr_array, values: Array) -> Array:
    """Of each column the largest value where it has entries."""
    entries = N.tocoo()
    row, column = entries.coords
    largest = np.zeros(N.shape[1])
    np.maximum.at(largest, column, np.where(entries.data != 0.0, values[row], 0.0))
    return largest
