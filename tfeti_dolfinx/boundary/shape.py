"""A subdomain whose surface has boundary elements, in an order of nodes of its own."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import block_array, csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.boundary.material import law_of
from tfeti_dolfinx.boundary.panels import Panels
from tfeti_dolfinx.boundary.steklov import Steklov, steklov
from tfeti_dolfinx.boundary.surface import Surface
from tfeti_dolfinx.errors import FactorError, TfetiError
from tfeti_dolfinx.subdomains.factor import CholeskyFactor
from tfeti_dolfinx.subdomains.kernel import candidate_modes
from tfeti_dolfinx.subdomains.kplus import Making
from tfeti_dolfinx.subdomains.stiffness import Stiffness

TOGETHER = 256  # right sides that are solved for at once


class Shape:
    """K of finite elements, its Schur complement on the surface replaced by S.

    K_S = [S + K_oi K_ii⁻¹ K_io, K_oi; K_io, K_ii], o on the surface, i inside. So S alone acts on
    the surface, and the displacement goes on inside as finite elements carry it there.

    Args:
        name: Name for messages.
        surface: The surface; its points are those of all nodes, those on the surface first.
        K: Stiffness of finite elements, scipy CSR, shape ``(n, n)``.
        how: How inverses are made.

    Attributes:
        x: Points of the nodes.
        surface: The surface.
        K_fem: Stiffness of finite elements.
        outer: Number of nodes on the surface.
        bodies: S for each way to cut the surface in panels.
        S: Their mean.

    Raises:
        InputError: K is not that of a homogeneous, isotropic body.
        FactorError: S could not be made.
    """

    def __init__(self, name: str, surface: Surface, K: Any, how: Making) -> None:
        self.name, self.x, self.surface = name, surface.panels.x, surface
        self.K_fem, self._how = K, how
        self.outer = int(surface.panels.nodes.max()) + 1
        self._cut = self.outer * surface.panels.dim
        law, x = law_of(K, surface, name), self.x[: self.outer]
        try:
            self.bodies = [steklov(Panels(x, cut.nodes), law) for cut in surface.cuts]
        except TfetiError as error:
            raise type(error)(f"{name}: {error}") from error
        self.S = np.mean([body.S for body in self.bodies], axis=0)
        self._stiffness: Stiffness | None = None
        self._unit_loads: Array | None = None
        self.K = self._replaced()

    @property
    def stiffness(self) -> Stiffness:
        """K_S with its factors, made when it is first asked for, and again once nobody had it."""
        if self._stiffness is None or self._stiffness.users == 0:
            self._stiffness = Stiffness(self.name, self.x, self.K, self._how)
        return self._stiffness

    def body_force_load(self, hats: Array, b: Array) -> Array:
        """Load on all unknowns of a force b per volume, shape ``(n,)``.

        On the surface that of a particular solution u_p of div σ = −b, S u_p − ∫t_p φ; inside
        that of finite elements, whose part in K_oi K_ii⁻¹ f_i the surface has, too.

        Args:
            hats: Integrals of the hats over the volume, shape ``(n / d,)``.
            b: Shape ``(d,)``.
        """
        if self._unit_loads is None:
            inside = np.kron(hats[self.outer :, None], np.eye(len(b)))
            on_surface = np.mean([_particular_loads(body) for body in self.bodies], axis=0)
            self._unit_loads = np.concatenate((on_surface + self._carried(inside), inside))
        return np.asarray(self._unit_loads @ b)

    def _replaced(self) -> csr_array:
        """K_S."""
        cut, K = self._cut, self.K_fem
        K_io = K[cut:, :cut]
        corner = self.S + self._condensed() if K_io.shape[0] else self.S.copy()
        modes = candidate_modes(self.x, self.x.shape[1], self.x.mean(axis=0), 1.0)
        R, triangle = np.linalg.qr(modes[:cut])
        inside = modes[cut:] @ np.linalg.inv(triangle)
        # what rounding of K_ii⁻¹ leaves of rigid motions
        left = corner @ R + K_io.T @ inside
        left -= 0.5 * R @ (R.T @ left)
        corner -= left @ R.T + R @ left.T
        corner = 0.5 * (corner + corner.T)
        whole = block_array([[csr_array(corner), K_io.T], [K_io, K[cut:, cut:]]]).tocsr()
        whole.sort_indices()
        return csr_array(whole)

    def _condensed(self) -> Array:
        """K_oi K_ii⁻¹ K_io."""
        cut, K = self._cut, self.K_fem
        K_io, factor = K[cut:, :cut].tocsc(), self._inner_factor()
        columns = [slice(k, k + TOGETHER) for k in range(0, cut, TOGETHER)]
        parts = [K_io.T @ factor.solve(K_io[:, some].toarray()) for some in columns]
        factor.destroy()
        return np.hstack(parts)

    def _carried(self, inside: Array) -> Array:
        """K_oi K_ii⁻¹ f_i, shapes ``(·, q)``."""
        if len(inside) == 0:
            return np.zeros((self._cut, inside.shape[1]))
        factor = self._inner_factor()
        carried = self.K_fem[: self._cut, self._cut :] @ factor.solve(inside)
        factor.destroy()
        return np.asarray(carried)

    def _inner_factor(self) -> CholeskyFactor:
        cut, counters = self._cut, self._how.counters
        counters.factorizations += 1
        counters.analyses += 1
        try:
            return CholeskyFactor(self.K_fem[cut:, cut:].tocsr(), self._how.prefix)
        except FactorError as error:
            raise FactorError(
                f"{self.name}: the stiffness inside boundary elements: {error}"
            ) from error


def _particular_loads(body: Steklov) -> Array:
    """S u_p − ∫t_p φ for unit forces per volume, shape ``(n, d)``."""
    law, panels, d = body.law, body.panels, body.panels.dim
    stiff, middle = law.lmbda + 2.0 * law.mu, panels.x.mean(axis=0)
    u = np.einsum("ij,nj->nij", np.eye(d), -((panels.x - middle) ** 2) / (2.0 * stiff))
    # the gradient of u_p is linear, so that ∫ of it times a hat is a mean over corners
    corners = panels.corners - middle
    mean = (corners.sum(axis=1, keepdims=True) + corners) / (d * (d + 1))
    # for the force e_l alone ∂_l u_l is not 0
    one = np.zeros((d, d, d))
    one[np.arange(d), np.arange(d), np.arange(d)] = -1.0 / stiff
    stress = law.stress(one[None, None] * mean[:, :, :, None, None])
    tractions = np.einsum("pklij,pj->pkil", stress, panels.directed)
    f = (body.S @ u.reshape(-1, d)).reshape(-1, d, d)
    np.subtract.at(f, panels.nodes, tractions)
    return f.reshape(-1, d)
