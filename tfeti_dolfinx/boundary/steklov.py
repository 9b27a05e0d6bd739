"""S, the Galerkin approximation of the Steklov–Poincaré operator of a Lamé body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import block_array, csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.boundary.integrals2d import layers_2d
from tfeti_dolfinx.boundary.integrals3d import layers_3d
from tfeti_dolfinx.boundary.layers import Layers
from tfeti_dolfinx.boundary.panels import Panels
from tfeti_dolfinx.errors import FactorError, InputError

# Of the largest nodal force of constant stresses: how wrong quadrature on long thin triangles may
# make them
WRONG = 1e-2


@dataclass(frozen=True)
class Law:
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
    law: Law
    S: Array
    tractions: Array
    defect: float


def steklov(panels: Panels, law: Law) -> Steklov:
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
    if (wrong := wrong_forces(panels, law, S)) > WRONG:
        raise InputError(
            f"boundary elements on triangles whose longest edge squared is up to "
            f"{2.0 * panels.distortion.max():.0f} times their area make forces of constant "
            f"stresses {wrong:.1%} wrong; expected shorter edges, at most 20 times, say"
        )
    return Steklov(panels, law, S, tractions[np.ix_(rows, by_node)], defect)


def wrong_forces(panels: Panels, law: Law, S: Array) -> float:
    """The largest error of nodal forces of constant stresses, over the largest of these."""
    d, y = panels.dim, panels.x - panels.x.mean(axis=0)
    gradients = np.eye(d * d).reshape(d * d, d, d)
    u = np.einsum("kij,nj->nik", gradients, y).reshape(-1, d * d)
    t = np.einsum("kij,pj->pik", law.stress(gradients), panels.directed) / d
    exact = np.zeros((len(y), d, d * d))
    np.add.at(exact, panels.nodes, t[:, None])
    exact = exact.reshape(u.shape)
    return float(np.abs(S @ u - exact).max() / np.abs(exact).max())


def single_layer(layers: Layers, law: Law) -> Array:
    """V of elasticity, component after component, shape ``(d ne, d ne)``."""
    d, ne = layers.panels.dim, len(layers.single)
    V = np.empty((d, ne, d, ne))
    for a in range(d):
        for b in range(d):
            V[a, :, b] = law.single * layers.tensor[a, b]
        V[a, :, a] += law.single * (3.0 - 4.0 * law.nu) * layers.single
    return V.reshape(d * ne, d * ne)


def half_mass_and_double(layers: Layers, law: Law, V: Array) -> Array:
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


def hypersingular(layers: Layers, law: Law, V: Array) -> Array:
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
    """Orthonormal, shape ``(d np, 3 or 6)``, unknowns ordered node by node."""
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
    """Where the unknowns of nodes stand in the order of components."""
    return np.arange(d * count).reshape(d, count).T.ravel()
