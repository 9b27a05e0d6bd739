"""A subdomain of sparse finite elements."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import null_space

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import FactorError, InputError
from tfeti_dolfinx.subdomains.factor import NotPositiveDefiniteError
from tfeti_dolfinx.subdomains.indefinite import why_indefinite
from tfeti_dolfinx.subdomains.kernel import candidate_modes, fixing_nodes, kernel_of
from tfeti_dolfinx.subdomains.kplus import KPLUS_TYPES, GeneralisedInverse, regularised

SYMMETRY = 1e-8


@dataclass
class Counters:
    """What the Blocks of a rank have cost."""

    factorizations: int = 0


class SparseBlock:
    """Block of a sparse stiffness: factors of K_ρ and, when asked for, of K_ii.

    Args:
        name: Name for messages.
        K: Stiffness, scipy CSR, shape ``(n, n)``.
        f: Load, shape ``(n,)``.
        x: Points of the nodes, shape ``(n / bs, gdim)``.
        trace_dofs: Trace unknowns, ascending, shape ``(t,)``.
        body_frame: Centre and length of the whole body, for its candidate modes.
        counters: Counts factorisations.
        kplus_type: Kind of the generalised inverse.
        prefix: Prefix of the factors' PETSc options.
        shares: 1 / number of torn copies of each node, shape ``(n / bs,)``; default 1.

    Raises:
        InputError: K is not symmetric, not finite or not positive semidefinite, or the load is
            not finite.
        FactorError: A factor could not be made.
    """

    def __init__(
        self,
        name: str,
        K: Any,
        f: Array,
        x: Array,
        trace_dofs: Array,
        body_frame: tuple[Array, float],
        counters: Counters,
        kplus_type: str = "regularized",
        prefix: str = "tfeti_sub_",
        shares: Array | None = None,
    ) -> None:
        self._name, self._x, self._frame = name, x, body_frame
        self._shares = np.ones(len(x)) if shares is None else shares
        self._counters, self._kplus_type, self._prefix = counters, kplus_type, prefix
        self.trace_dofs = trace_dofs
        self.update(K=K, f=f)

    def update(self, K: Any = None, f: Array | None = None) -> None:
        """Replace the stiffness or the load; a new load leaves the factors alone."""
        if K is not None:
            self.destroy()
            _check_stiffness(self._name, K)
            self._K = K
        if f is not None:
            _check_load(self._name, f)
            self._f = f
        self._forget("kernel_load", "_pinv_load")
        self._pinv  # noqa: B018  factored now, so that an error is raised where all ranks agree

    def retrace(self, trace_dofs: Array) -> None:
        """Replace the trace; the factor of K_ii goes with it, that of K stays."""
        if not np.array_equal(trace_dofs, self.trace_dofs):
            self.trace_dofs = trace_dofs
            self._forget("_inner", "_blocks", "kernel", "diagonal")

    def destroy(self) -> None:
        """Free the factors."""
        self._forget("_pinv", "_inner", "_blocks", "_R", "kernel", "diagonal")

    def _forget(self, *names: str) -> None:
        """Drop cached values, and free those that are factors."""
        for name in names:
            value = self.__dict__.pop(name, None)
            if hasattr(value, "destroy"):
                value.destroy()

    @property
    def size(self) -> int:
        """Number of unknowns n."""
        return self._K.shape[0]

    @cached_property
    def kernel(self) -> Array:
        """Trace rows of R, shape ``(t, r)``."""
        return self._R[self.trace_dofs]

    @cached_property
    def kernel_load(self) -> Array:
        """e = Rᵀ f, shape ``(r,)``."""
        return self._R.T @ self._f

    @property
    def load_norm(self) -> float:
        """‖f‖."""
        return float(np.linalg.norm(self._f))

    @property
    def body_modes(self) -> tuple[Array, Array]:
        """Rᵀ C and Cᵀ(I − R Rᵀ)C for the candidate modes C of the body."""
        modes = self.modes
        inside = self._R.T @ modes
        rest = modes - self._R @ inside
        return inside, rest.T @ rest

    @property
    def modes(self) -> Array:
        """C, the candidate modes of the whole body on all unknowns, shape ``(n, k)``."""
        return self._modes(*self._frame)

    @cached_property
    def diagonal(self) -> Array:
        """Diagonal of K on the trace, shape ``(t,)``."""
        return self._K.diagonal()[self.trace_dofs]

    def energy(self, u: Array) -> float:
        """uᵀKu."""
        return float(u @ (self._K @ u))

    @property
    def body_metric(self) -> Array:
        """Cᵀ W C, shape ``(k, k)``, W the share in each node."""
        return self.modes.T @ (np.repeat(self._shares, self._bs)[:, None] * self.modes)

    def body_moments(self, u: Array) -> Array:
        """Cᵀ W u of a displacement on all unknowns, shape ``(k,)``."""
        return self.modes.T @ (np.repeat(self._shares, self._bs) * u)

    @property
    def condensed_load(self) -> Array:
        """K⁺ f on the trace, shape ``(t,)``."""
        return self._pinv_load[self.trace_dofs]

    def apply_pinv(self, w: Array) -> Array:
        """K⁺ w on the trace, shapes ``(t,)``."""
        return self._pinv.solve(self._extend(w))[self.trace_dofs]

    def apply_stiffness(self, w: Array) -> Array:
        """K_bb w, shapes ``(t,)``."""
        return self._blocks[0] @ w

    def apply_schur(self, w: Array) -> Array:
        """S w = K_bb w − K_bi K_ii⁻¹ K_ib w, shapes ``(t,)``; K_ii is factored once."""
        K_bb, K_ib, _ = self._blocks
        if K_ib.shape[0] == 0:
            return K_bb @ w
        return K_bb @ w - K_ib.T @ self._inner.solve(K_ib @ w)

    def prepare(self, operator: str) -> None:
        """Factor K_ii for ``"schur"``; what the other operators need is there."""
        if operator == "schur" and len(self._inner_dofs):
            self._inner  # noqa: B018

    def recover(self, w: Array) -> Array:
        """K⁺(f − w), shape ``(n,)``."""
        return self._pinv_load - self._pinv.solve(self._extend(w))

    def kernel_motion(self, alpha: Array) -> Array:
        """R α, shape ``(n,)``."""
        return self._R @ alpha

    @cached_property
    def _R(self) -> Array:
        centre = self._x.mean(axis=0)
        length = np.linalg.norm(self._x - centre, axis=1).max()
        return kernel_of(self._K, self._modes(centre, length))

    @cached_property
    def _pinv(self) -> GeneralisedInverse:
        dofs = self._fixing(np.arange(self.size) // self._bs)
        self._counters.factorizations += 1
        try:
            return KPLUS_TYPES[self._kplus_type](self._K, self._R, dofs, self._prefix)
        except NotPositiveDefiniteError as error:
            why = why_indefinite(self._K, self._R, dofs, self._x, self._prefix)
            raise InputError(f"{self._name}: {why}") from error
        except FactorError as error:
            raise FactorError(f"{self._name}: {error}") from error

    @cached_property
    def _inner(self) -> GeneralisedInverse:
        """K_ii⁺; K_ii is singular where the trace leaves a motion free, say normal rows only."""
        inner = self._inner_dofs
        R_inner = self._R[inner] @ null_space(self.kernel, rcond=1e-10)
        self._counters.factorizations += 1
        fixing = self._fixing(inner // self._bs)
        try:
            return regularised(self._blocks[2], R_inner, fixing, self._prefix)
        except FactorError as error:
            raise FactorError(
                f"{self._name}: the stiffness of the unknowns that no row touches, for the "
                f"dirichlet preconditioner: {error}"
            ) from error

    @property
    def _inner_dofs(self) -> Array:
        return np.setdiff1d(np.arange(self.size), self.trace_dofs, assume_unique=True)

    @property
    def _bs(self) -> int:
        return self.size // len(self._x)

    def _fixing(self, node_of_dof: Array) -> Array:
        """Positions of the unknowns at well-spread nodes, given the node of each unknown."""
        nodes = np.unique(node_of_dof)
        chosen = nodes[fixing_nodes(self._x[nodes], 2 ** self._x.shape[1])]
        return np.flatnonzero(np.isin(node_of_dof, chosen))

    @cached_property
    def _blocks(self) -> tuple[Any, Any, Any]:
        """K_bb, K_ib, K_ii."""
        inner = self._inner_dofs
        K_i = self._K[inner]
        return (
            self._K[self.trace_dofs][:, self.trace_dofs],
            K_i[:, self.trace_dofs],
            K_i[:, inner],
        )

    @cached_property
    def _pinv_load(self) -> Array:
        return self._pinv.solve(self._f)

    def _modes(self, centre: Array, length: float) -> Array:
        return candidate_modes(self._x, self._bs, centre, max(length, 1e-300))

    def _extend(self, w: Array) -> Array:
        full = np.zeros(self.size)
        full[self.trace_dofs] = w
        return full


def _check_stiffness(name: str, K: Any) -> None:
    if not np.all(np.isfinite(K.data)):
        raise InputError(f"{name}: the stiffness has entries that are not finite")
    scale = np.abs(K.data).max(initial=0.0)
    skew = np.abs((K - K.T).data).max(initial=0.0)
    if skew > SYMMETRY * scale:
        raise InputError(
            f"{name}: the stiffness is not symmetric (|K − Kᵀ| = {skew:.3g}, |K| = {scale:.3g}); "
            "expected a linear elastic form"
        )
    if K.shape[0] and K.diagonal().min() <= 0.0:
        raise InputError(
            f"{name}: the stiffness has a diagonal entry {K.diagonal().min():.3g}; "
            "expected a linear elastic form, positive on all unknowns"
        )


def _check_load(name: str, f: Array) -> None:
    if not np.all(np.isfinite(f)):
        raise InputError(f"{name}: the load has {np.sum(~np.isfinite(f))} entries not finite")
