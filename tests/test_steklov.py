"""The Steklov–Poincaré operator of boundary elements: exact identities and Kelvin's solution."""

import numpy as np
import pytest
from panels import PLANE, SPACE, box, kelvin, kelvin_energy, moved

from tfeti_dolfinx.bem.inside import Inside, share
from tfeti_dolfinx.bem.integrals import apart_rule, touching_rule
from tfeti_dolfinx.bem.panels import Panels
from tfeti_dolfinx.bem.steklov import IsotropicLaw, rigid_motions, steklov, wrong_forces
from tfeti_dolfinx.errors import FactorError, InputError

LAW = IsotropicLaw(mu=0.4, nu=0.3)
SHAPES = {**PLANE, **SPACE}
GRADIENT = np.array([[1.0, 0.2, 0.3], [0.1, -0.5, 0.2], [0.4, 0.1, 0.3]])


@pytest.mark.parametrize("name", SHAPES)
def test_rigid_motions_and_constant_stresses(name):
    panels = SHAPES[name]()
    made = steklov(panels, LAW)
    largest = np.abs(made.S).max()
    assert np.abs(made.S @ rigid_motions(panels.x)).max() < 1e-13 * largest
    assert np.array_equal(made.S, made.S.T)
    assert made.defect < (1e-12 if panels.dim == 2 else 2e-6)
    G = GRADIENT[: panels.dim, : panels.dim]
    u, stress = (panels.x @ G.T).ravel(), LAW.stress(G)
    exact = panels.normal @ stress
    tractions = (made.tractions @ u).reshape(exact.shape)
    bound = 1e-11 if panels.dim == 2 else 1e-4
    assert np.abs(tractions - exact).max() < bound * np.abs(exact).max()
    work = np.sum(stress * G) * panels.volume
    assert abs(u @ made.S @ u / work - 1) < (1e-12 if panels.dim == 2 else 2e-5)
    values = np.linalg.eigvalsh(made.S)
    kernel = {2: 3, 3: 6}[panels.dim]
    assert np.abs(values[:kernel]).max() < 1e-13 * values[-1] < 1e-9 * values[kernel]


@pytest.mark.parametrize("dim", [2, 3])
def test_size_and_place_and_direction_do_not_matter(dim):
    panels = (PLANE["hook"] if dim == 2 else SPACE["bar"])(2)
    Q = np.linalg.qr(GRADIENT[:dim, :dim])[0]
    Q *= np.sign(np.linalg.det(Q)) ** np.eye(dim)[0]
    other = moved(panels, lambda x: 7.0 * x @ Q.T + 3.0)
    turn = np.kron(np.eye(len(panels.x)), Q)
    S = turn @ steklov(panels, LAW).S @ turn.T
    bound = 1e-12 * np.abs(S).max()
    assert np.abs(steklov(other, LAW).S * 7.0 ** (2 - dim) - S).max() < bound
    harder = steklov(panels, IsotropicLaw(1e5 * LAW.mu, LAW.nu)).S
    assert np.abs(turn @ harder @ turn.T / 1e5 - S).max() < bound


@pytest.mark.parametrize("shared", [0, 1, 2, 3])
def test_rules_integrate_polynomials(shared):
    rule = apart_rule(4) if shared == 0 else touching_rule(shared, 4)
    assert rule.weights.sum() == pytest.approx(1.0)
    assert np.allclose([rule.x.sum(axis=1), rule.y.sum(axis=1)], 1.0)
    # the mean of λ_i λ_j over a triangle is 1/6 or 1/12
    for at in (rule.x, rule.y):
        second = (at * rule.weights[:, None]).T @ at
        assert np.allclose(second, (1 + np.eye(3)) / 12)
    assert np.allclose((rule.x * rule.weights[:, None]).T @ rule.y, 1 / 9)


def test_surfaces_that_do_not_do_are_refused():
    twice = box(1)
    twice = Panels(twice.x, np.concatenate((twice.nodes, twice.nodes)))
    with pytest.raises(FactorError, match="closed surface"):
        steklov(twice, LAW)
    with pytest.raises(InputError, match=r"longest edge squared is up to 60 times their area"):
        steklov(box(2, (1.0, 1.0, 1 / 30)), LAW)
    # shorter ones keep the forces of constant stresses
    panels = box(2, (1.0, 1.0, 0.1))
    assert wrong_forces(panels, LAW, steklov(panels, LAW).S) < 2e-4


INSIDE = {
    2: np.array([(0.25, 0.25), (0.3, 0.1), (0.45, 0.45), (0.25, 0.499)]),
    3: np.array([(0.5, 0.5, 0.5), (0.7, 0.3, 0.2), (0.9, 0.9, 0.9), (0.5, 0.5, 0.99)]),
}


@pytest.mark.parametrize("dim", [2, 3])
def test_inside_constant_stresses_and_forces_per_volume_are_exact(dim):
    panels, points = PLANE["square"]() if dim == 2 else SPACE["cube"](), INSIDE[dim]
    made, b = steklov(panels, LAW), np.arange(1.0, dim + 1)
    G, middle = GRADIENT[:dim, :dim], panels.x.mean(axis=0)

    def exact(x):  # and div σ = −b
        return x @ G.T - b * (x - middle) ** 2 / (2 * (LAW.lmbda + 2 * LAW.mu))

    inside = Inside(made, exact(panels.x), b)
    bound = 1e-12 if dim == 2 else 1e-6
    assert np.abs(inside.displacement(points) - exact(points)).max() < bound
    slope = np.einsum("ki,ij->kij", -b * (points - middle), np.eye(dim))
    stress = LAW.stress(G + slope / (LAW.lmbda + 2 * LAW.mu))
    assert np.abs(inside.stress(points) - stress).max() < (1e-9 if dim == 2 else 1e-5)


@pytest.mark.parametrize(
    ("dim", "source", "sizes", "bound"),
    [(2, (0.6, 0.45), (8, 16, 32), 1e-3), (3, (2.0, 0.8, 0.6), (3, 6), 2e-2)],
)
def test_kelvin_converges_with_the_square_of_h(dim, source, sizes, bound):
    """Its energy, from below, and what is inside."""
    errors, points = [], INSIDE[dim]
    u, gradient = kelvin(points, np.array(source), LAW)
    exact = u, LAW.stress(gradient)
    for m in sizes:
        panels = (PLANE["square"] if dim == 2 else SPACE["cube"])(m)
        made, surface = steklov(panels, LAW), kelvin(panels.x, np.array(source), LAW)[0]
        energy = kelvin_energy(panels, np.array(source), LAW, halvings=6 if dim == 2 else 4)
        of_m = [1 - surface.ravel() @ made.S @ surface.ravel() / energy]
        within = Inside(made, surface, np.zeros(dim))
        found = within.displacement(points), within.stress(points)
        off = [np.linalg.norm(a - b) / np.linalg.norm(b) for a, b in zip(found, exact, strict=True)]
        errors.append([*of_m, *off])
    errors = np.array(errors)
    assert errors.min() > 0.0
    assert np.all(np.log2(errors[-2] / errors[-1]) > 1.8), errors
    assert errors[-1, 1] < bound


@pytest.mark.parametrize("name", SHAPES)
def test_what_is_inside_is_found(name):
    panels = SHAPES[name]()
    middle, size = panels.midpoints, panels.size.min()
    for sign in (-1.0, 1.0):
        points = middle + sign * 1e-2 * size * panels.normal
        assert np.abs(share(panels, points) - (sign < 0)).max() < 1e-6
    assert np.abs(share(panels, middle) - 0.5).max() < 1e-6
