"""The Steklov–Poincaré operator of a volume, its material and shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from weakref import ref

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import block_array, csr_array

from tfeti_dolfinx.bem.integrals import Layers, layers_2d, layers_3d
from tfeti_dolfinx.bem.panels import Panels, Surface
from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.errors import FactorError, InputError, TfetiError
from tfeti_dolfinx.subdomains.block import candidate_modes
from tfeti_dolfinx.subdomains.factor import CholeskyFactor
from tfeti_dolfinx.subdomains.kplus import InverseFactory
from tfeti_dolfinx.subdomains.sparse_block import Stiffness

# --- Galerkin approximation of the Steklov–Poincaré operator ----------------------------------


@dataclass(frozen=True)
class StiffnessTolerances:
    """Tolerances of boundary elements.

    Attributes:
        wrong: Of the largest nodal force of constant stresses: how wrong quadrature on long thin
            triangles may make them.
        same: Of the largest entry of a stiffness: what rounding and quadrature of a constant
            stress leave.
        rest: The same of forces of translations, which no elasticity has: what rounding leaves.
        constant: Of the largest entry of a load: what quadrature leaves of a constant force per
            volume.
        together: Right sides that are solved for at once.
    """

    wrong: float = 1e-2
    same: float = 1e-7
    rest: float = 1e-12
    constant: float = 1e-7
    together: int = 256


TOLERANCES = StiffnessTolerances()


@dataclass(frozen=True)
class IsotropicLaw:
    """Isotropic elasticity; in 2D plane strain.

    Attributes:
        mu: Shear modulus μ, a force per area.
        nu: Poisson's ratio ν.
    """

    mu: float
    nu: float

    @property
    def lmbda(self) -> float:
        """Lamé's λ."""
        return 2.0 * self.mu * self.nu / (1.0 - 2.0 * self.nu)

    @property
    def single(self) -> float:
        """k = 1/(4μ(1−ν)), of Kelvin's solution."""
        return 1.0 / (4.0 * self.mu * (1.0 - self.nu))

    def stress(self, gradient: Array) -> Array:
        """σ without σ_zz for displacement gradients ∂_j u_i, shapes ``(..., d, d)``."""
        strain = 0.5 * (gradient + np.swapaxes(gradient, -1, -2))
        trace = np.trace(strain, axis1=-2, axis2=-1)[..., None, None]
        return np.asarray(2.0 * self.mu * strain + self.lmbda * trace * np.eye(strain.shape[-1]))


@dataclass(frozen=True)
class Steklov:
    """The operator of a body on its panels; unknowns are ordered node by node.

    Attributes:
        panels: The panels.
        law: The law.
        S: From displacements to nodal forces, symmetric, shape ``(d np, d np)``; its kernel is
            that of the rigid motions, exactly.
        tractions: V⁻¹(½M + K), from displacements to tractions on panels, shape
            ``(d ne, d np)``.
        defect: max|SR| / max|S| before the rigid motions R were taken out of S: what quadrature
            and rounding make of them.
    """

    panels: Panels
    law: IsotropicLaw
    S: Array
    tractions: Array
    defect: float


def steklov(panels: Panels, law: IsotropicLaw) -> Steklov:
    """S = D + HᵀV⁻¹H, H = ½M + K, of the layers by Han's reduction to three integrals.

    Steinbach, Numerical Approximation Methods for Elliptic Boundary Value Problems (2008),
    chapters 6 and 10; Of, Steinbach, Wendland, IMA J. Numer. Anal. 26 (2006).

    Raises:
        FactorError: V is not positive definite.
        InputError: Triangles are too long and thin for the quadrature.
    """
    layers = layers_2d(panels) if panels.dim == 2 else layers_3d(panels)
    V = single_layer(layers, law)
    D, H = hypersingular(layers, law, V), half_mass_and_double(layers, law, V)
    try:
        tractions = cho_solve(cho_factor(V, lower=True, overwrite_a=True, check_finite=False), H)
    except LinAlgError as error:
        raise FactorError(
            "the single layer operator of the boundary elements is not positive definite; expected "
            "a closed surface of panels that do not meet but at their edges"
        ) from error
    S = D + H.T @ tractions
    by_node = _by_nodes(len(panels.x), panels.dim)
    S = S[np.ix_(by_node, by_node)]
    S = 0.5 * (S + S.T)
    rows, R = _by_nodes(len(panels.nodes), panels.dim), rigid_motions(panels.x)
    SR = S @ R
    defect = float(np.abs(SR).max() / np.abs(S).max())
    # (I − RRᵀ) S (I − RRᵀ)
    half = SR - 0.5 * R @ (R.T @ SR)
    S = S - half @ R.T - R @ half.T
    S = 0.5 * (S + S.T)
    if (wrong := wrong_forces(panels, law, S)) > TOLERANCES.wrong:
        raise InputError(
            f"boundary elements on triangles whose longest edge squared is up to "
            f"{2.0 * panels.distortion.max():.0f} times their area make forces of constant "
            f"stresses {wrong:.1%} wrong; expected shorter edges, at most 20 times, say"
        )
    return Steklov(panels, law, S, tractions[np.ix_(rows, by_node)], defect)


def wrong_forces(panels: Panels, law: IsotropicLaw, S: Array) -> float:
    """Return the largest error of nodal forces of constant stresses, over the largest of these."""
    d, y = panels.dim, panels.x - panels.x.mean(axis=0)
    gradients = np.eye(d * d).reshape(d * d, d, d)
    u = np.einsum("kij,nj->nik", gradients, y).reshape(-1, d * d)
    t = np.einsum("kij,pj->pik", law.stress(gradients), panels.directed) / d
    exact = np.zeros((len(y), d, d * d))
    np.add.at(exact, panels.nodes, t[:, None])
    exact = exact.reshape(u.shape)
    return float(np.abs(S @ u - exact).max() / np.abs(exact).max())


def single_layer(layers: Layers, law: IsotropicLaw) -> Array:
    """V of elasticity, component after component, shape ``(d ne, d ne)``."""
    d, ne = layers.panels.dim, len(layers.single)
    V = np.empty((d, ne, d, ne))
    for a in range(d):
        for b in range(d):
            V[a, :, b] = law.single * layers.tensor[a, b]
        V[a, :, a] += law.single * (3.0 - 4.0 * law.nu) * layers.single
    return V.reshape(d * ne, d * ne)


def half_mass_and_double(layers: Layers, law: IsotropicLaw, V: Array) -> Array:
    """H = ½M + K, K = I⊗K_Δ − (I⊗V_Δ)𝓜 + 2μV𝓜, shape ``(d ne, d np)``."""
    G, d = gunter(layers.panels), layers.panels.dim
    H = np.asarray(2.0 * law.mu * (G.T @ V).T)
    one = 0.5 * layers.panels.mass.toarray() + layers.double
    ne, np_ = one.shape
    for a in range(d):
        own = slice(a * ne, (a + 1) * ne)
        H[own, a * np_ : (a + 1) * np_] += one
        H[own] -= (G[own].T @ layers.single).T
    return H


def hypersingular(layers: Layers, law: IsotropicLaw, V: Array) -> Array:
    """D, shape ``(d np, d np)``, from the layers of surface curls."""
    curls, d = layers.panels.curls, layers.panels.dim
    if d == 2:
        (C,) = curls
        factor = law.mu / (1.0 - law.nu)
        blocks = [
            [
                factor * _sandwich(C, C, layers.tensor[a, b] + (a == b) * layers.single)
                for b in range(2)
            ]
            for a in range(2)
        ]
        return np.block(blocks)
    G, size = gunter(layers.panels), len(layers.panels.x)
    D = np.asarray(-4.0 * law.mu**2 * (G.T @ (G.T @ V).T))
    L = [[_sandwich(a, b, layers.single) for b in curls] for a in curls]
    trace = L[0][0] + L[1][1] + L[2][2]
    for i in range(3):
        for j in range(3):
            # the three terms with V_Δ, since 𝓜_ab = −ε_abc C_c
            block = 4.0 * (i == j) * trace - 2.0 * L[j][i] - L[i][j]
            D[i * size : (i + 1) * size, j * size : (j + 1) * size] += law.mu * block
    return D


def gunter(panels: Panels) -> csr_array:
    """𝓜 with entries n_j ∂_i − n_i ∂_j of the hats, shape ``(d ne, d np)``."""
    if panels.dim == 2:
        (C,) = panels.curls
        return csr_array(block_array([[None, -C], [C, None]]))
    X, Y, Z = panels.curls
    return csr_array(block_array([[None, -Z, Y], [Z, None, -X], [-Y, X, None]]))


def rigid_motions(x: Array) -> Array:
    """Return orthonormal modes, shape ``(d np, 3 or 6)``, unknowns ordered node by node."""
    n, d = x.shape
    y = (x - x.mean(axis=0)) / np.abs(x - x.mean(axis=0)).max()
    modes = [np.tile(axis, n) for axis in np.eye(d)]
    for i in range(d):
        for j in range(i):
            turn = np.zeros((n, d))
            turn[:, j], turn[:, i] = -y[:, i], y[:, j]
            modes.append(turn.ravel())
    return np.linalg.qr(np.stack(modes, axis=1))[0]


def _sandwich(left: csr_array, right: csr_array, V: Array) -> Array:
    """leftᵀ V right, V symmetric."""
    return np.asarray(left.T @ (right.T @ V).T)


def _by_nodes(count: int, d: int) -> Array:
    """Return the places of the unknowns, ordered by nodes, in the order by components."""
    return np.arange(d * count).reshape(d, count).T.ravel()


# --- Elastic moduli read from a finite element stiffness --------------------------------------


def law_of(K: Any, surface: Surface, name: str) -> IsotropicLaw:
    """μ and ν of the constant stress σ that linear displacements have.

    Where a body has them and nothing else, its nodes get the forces of σn on the surface alone.

    Args:
        K: Stiffness of finite elements, shape ``(d n, d n)``.
        surface: The surface of the body, its points those of all n nodes.
        name: Name for messages.

    Raises:
        InputError: K is not that of such a body.
    """
    x = surface.panels.x
    d = x.shape[1]
    if not np.all(np.isfinite(K.data)) or K.diagonal().min() <= 0.0:
        raise InputError(
            f"{name}: boundary elements take the law of a body from the bilinear form, which has "
            "no elasticity there; expected it on all bodies"
        )
    y = x - x.mean(axis=0)
    # u_i = y_j for all i and j, and translations
    linear = np.einsum("ki,nj->nkij", np.eye(d), y).reshape(d * len(x), d * d)
    moved = np.hstack((linear, np.tile(np.eye(d), (len(x), 1)) * np.abs(y).max()))
    forces = K @ moved
    C = (linear.T @ forces[:, : d * d] / surface.panels.volume).reshape(d, d, d, d)
    mu, lmbda = float(C[0, 1, 0, 1]), float(C[0, 0, 1, 1])
    law = IsotropicLaw(mu, lmbda / (2.0 * (lmbda + mu)) if lmbda + mu > 0.0 else np.nan)
    expected = np.zeros_like(forces)
    stress = law.stress(np.eye(d * d).reshape(d * d, d, d))
    expected[:, : d * d] = np.einsum("lki,ni->nkl", stress, surface.normals).reshape(-1, d * d)
    most = np.repeat((TOLERANCES.same, TOLERANCES.rest), (d * d, d))  # of strains, of translations
    most *= np.max(abs(K) @ np.abs(moved))
    right = np.all(np.abs(forces - expected) <= most)
    if not (law.mu > 0.0 and -1.0 < law.nu < 0.5 and right):
        raise InputError(
            f"{name}: boundary elements need one homogeneous, isotropic law, without "
            "springs or masses; the bilinear form has something else there. Expected "
            "constant moduli, or finite elements for this volume"
        )
    return law


# --- A subdomain with its surface nodes in boundary element order -----------------------------


class SurfaceStiffness:
    """K of finite elements, its Schur complement on the surface replaced by S.

    K_S = [S + K_oi K_ii⁻¹ K_io, K_oi; K_io, K_ii], o on the surface, i inside. So S alone acts on
    the surface, and the displacement goes on inside as finite elements carry it there.

    Args:
        name: Name for messages.
        surface: The surface; its points are those of all nodes, those on the surface first.
        K: Stiffness of finite elements, scipy CSR, shape ``(n, n)``.
        factory: Makes inverses.

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

    def __init__(self, name: str, surface: Surface, K: Any, factory: InverseFactory) -> None:
        self.name, self.x, self.surface = name, surface.panels.x, surface
        self.K_fem, self._factory = K, factory
        self.outer = int(surface.panels.nodes.max()) + 1
        self._cut = self.outer * surface.panels.dim
        law, x = law_of(K, surface, name), self.x[: self.outer]
        try:
            self.bodies = [steklov(Panels(x, cut.nodes), law) for cut in surface.cuts]
        except TfetiError as error:
            raise type(error)(f"{name}: {error}") from error
        self.S = np.mean([body.S for body in self.bodies], axis=0)
        self._stiffness: ref[Stiffness] | None = None
        self._unit_loads: Array | None = None
        self.K = self._replaced()

    @property
    def stiffness(self) -> Stiffness:
        """K_S with its factors, made when it is first asked for, and again once nobody has it."""
        found = None if self._stiffness is None else self._stiffness()
        if found is None:
            found = Stiffness(self.name, self.x, self.K, self._factory)
            self._stiffness = ref(found)
        return found

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
        columns = [slice(k, k + TOLERANCES.together) for k in range(0, cut, TOLERANCES.together)]
        parts = [K_io.T @ factor.solve(K_io[:, some].toarray()) for some in columns]
        return np.hstack(parts)

    def _carried(self, inside: Array) -> Array:
        """K_oi K_ii⁻¹ f_i, shapes ``(·, q)``."""
        if len(inside) == 0:
            return np.zeros((self._cut, inside.shape[1]))
        factor = self._inner_factor()
        carried = self.K_fem[: self._cut, self._cut :] @ factor.solve(inside)
        return np.asarray(carried)

    def _inner_factor(self) -> CholeskyFactor:
        cut = self._cut
        self._factory.factorizations += 1
        try:
            return CholeskyFactor(self.K_fem[cut:, cut:].tocsr(), self._factory.prefix)
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
