"""Exact identities of F, preconditioners, homogenisation and recovery; of P and Q: test_faces."""

import numpy as np
import pytest
from scenes import curved_obstacle, decomposed, problem

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.common.parallel import dot_over, norm_over
from tfeti_dolfinx.feti.operator import PRECONDITIONERS, scaled_rows


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


def check_operator(F, comm, size):
    """It is symmetric and positive semidefinite on random vectors."""
    rng = np.random.default_rng(comm.rank)
    for _ in range(3):
        x, y = rng.standard_normal((2, size))
        Fx, Fy = F(x), F(y)
        energy, one, other = dot_over(comm, (x, Fx), (y, Fx), (x, Fy))
        assert energy >= 0.0
        assert abs(one - other) <= 1e-10 * norm_over(comm, Fx) * norm_over(comm, y)


def test_F_and_its_preconditioners_are_symmetric_and_positive(dual):
    check_operator(dual.F, dual.coarse.comm, len(dual.d))
    scaled = scaled_rows(dual.constraints.B, dual.constraints.weights)
    for make in PRECONDITIONERS.values():
        check_operator(make(scaled, dual.subdomains), dual.coarse.comm, len(dual.d))


def test_recovered_displacement_meets_the_rows(solved):
    """B_E u = c_E and B_N u ≤ c_N, with equality where there is a force."""
    constraints, solution = solved.dual.constraints, solved.solution
    u = solved.dofs.to_primal(solved.u.x.array)[constraints.trace]
    size = solved.u.x.petsc_vec.norm()
    residual = constraints.jumps(u) - constraints.c
    sets, lam = constraints.sets, solution.lam
    bounded = sets.normals
    assert np.all(np.abs(residual[sets.equalities]) <= 1e-8 * size)
    assert np.all(residual[bounded] <= 1e-8 * size)
    closed = lam[bounded] > 0.0
    assert solved.decomposition.comm.allreduce(int(np.sum(closed))) > 0
    assert np.all(np.abs(residual[bounded][closed]) <= 1e-8 * size)
