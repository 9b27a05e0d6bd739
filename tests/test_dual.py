"""Exact identities of F, G, P, Q, homogenisation and recovery."""

import numpy as np
import pytest
from scenes import curved_obstacle, decomposed, problem

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.feti.operator import check_operator


@pytest.fixture(scope="module")
def solved():
    d = decomposed("hexahedron", 4, subdomains=6)
    obstacle = tfeti.Obstacle("bottom", curved_obstacle(3))
    p = problem(d, contacts=[obstacle], tfeti_rtol=1e-10)
    p.solve()
    yield p
    p.destroy()


@pytest.fixture(scope="module")
def dual(solved):
    return solved.dual


def random_vec(dual, seed=0):
    vec = dual.d.duplicate()
    rng = np.random.default_rng(seed + dual.coarse.comm.rank)
    vec.array[:] = rng.standard_normal(vec.getLocalSize())
    return vec


def test_F_is_symmetric_and_positive(dual):
    check_operator(dual.F, dual.d)


def test_preconditioners_are_symmetric_and_positive(dual):
    from tfeti_dolfinx.feti.operator import PRECONDITIONERS, ScaledRows

    scaled = ScaledRows(dual.constraints.B, dual.constraints.weights)
    for make in PRECONDITIONERS.values():
        check_operator(make(scaled, dual.subdomains), dual.d)


def test_projectors(dual):
    x, Qx = random_vec(dual), dual.d.duplicate()
    coarse = dual.coarse
    coarse.apply_Q(x, Qx)
    assert coarse.norm_Q(x) == pytest.approx(Qx.norm(), rel=1e-10)
    assert np.allclose(coarse.G(x.array_r), coarse.G(Qx.array_r), atol=1e-11 * x.norm())
    Px = x.copy()
    coarse.project(Px)
    assert np.abs(coarse.G(Px.array_r)).max() <= 1e-11 * x.norm()
    assert abs(Px.dot(Qx)) <= 1e-11 * x.norm() ** 2
    PPx = Px.copy()
    coarse.project(PPx)
    PPx.axpy(-1.0, Px)
    assert PPx.norm() <= 1e-11 * x.norm()


def test_P_annihilates_the_range_of_Gt(dual):
    coarse = dual.coarse
    y = dual.d.duplicate()
    coarse.combine(np.arange(1.0, coarse.dimension + 1), y)
    size = y.norm()
    assert np.allclose(coarse.coordinates(y), np.arange(1.0, coarse.dimension + 1), rtol=1e-8)
    coarse.project(y)
    assert y.norm() <= 1e-11 * size


def test_the_particular_solution_solves_G_lam_e(dual):
    lam = dual.d.duplicate()
    dual.coarse.particular(lam)
    assert np.allclose(dual.coarse.G(lam.array_r), dual.coarse.e, atol=1e-12)


def test_gram_is_G_Gt(dual):
    coarse = dual.coarse
    y = np.random.default_rng(0).standard_normal(coarse.dimension)
    assert np.allclose(coarse.grams.whole @ y, coarse.G(coarse.Gt @ y), atol=1e-11)


def test_recovered_displacement_meets_the_rows(solved):
    """B_E u = c_E and B_N u ≤ c_N, with equality where there is a force."""
    constraints, solution = solved.dual.constraints, solved.solution
    u, Bu = constraints.B.createVecRight(), constraints.c.duplicate()
    u.array[:] = solved.dofs.to_primal(solved.u.x.array)[constraints.trace]
    constraints.B.mult(u, Bu)
    size = solved.u.x.petsc_vec.norm()
    residual = Bu.array_r - constraints.c.array_r
    sets, lam = constraints.sets, solution.lam
    bounded = sets.normals
    assert np.all(np.abs(residual[sets.equalities]) <= 1e-8 * size)
    assert np.all(residual[bounded] <= 1e-8 * size)
    closed = lam[bounded] > 0.0
    assert solved.decomposition.comm.allreduce(int(np.sum(closed))) > 0
    assert np.all(np.abs(residual[bounded][closed]) <= 1e-8 * size)


def test_recovered_displacement_is_in_equilibrium(solved):
    """K u = f − Bᵀλ in every subdomain."""
    constraints = solved.dual.constraints
    lam, force = constraints.c.duplicate(), constraints.B.createVecRight()
    lam.array[:] = solved.solution.lam
    constraints.B.multTranspose(lam, force)
    dofs = solved.dofs
    forms = solved._system.forms
    left = dofs.to_primal(forms.stiffness() @ solved.u.x.array - forms.load())
    left[constraints.trace] += force.array_r
    assert np.all(np.abs(left) <= 1e-9 * force.norm())


def test_counters_charge_who_asked(dual):
    x, y = random_vec(dual), dual.d.duplicate()
    before = dual.F.count["someone"], dual.F.count["solver"]
    with dual.F.charged_to("someone"):
        dual.F.mult(x, y)
    dual.F.mult(x, y)
    assert (dual.F.count["someone"], dual.F.count["solver"]) == (before[0] + 1, before[1] + 1)
