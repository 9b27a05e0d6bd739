"""Patch tests: uniform pressure between bodies with meshes that do not match."""

import numpy as np
import pytest
from bodies import held, jagged, pressed, stacked, two_body_problem
from mpi4py import MPI

import tfeti_dolfinx as tfeti

PRESSURE = 0.1
CELLS = ["triangle", "quadrilateral", "tetrahedron", "hexahedron"]


def sides_of(cell):
    flat = cell in ("triangle", "quadrilateral")
    sides = ["lower bottom", "lower left", "upper left"]
    return sides if flat else [*sides, "lower front", "upper front"]


def linear_displacement(x, gdim, E=1.0, nu=0.3):
    """Uniaxial compression, exact for both boxes (plane strain in 2D)."""
    if gdim == 2:
        vertical, lateral = -(1 - nu**2) / E, nu * (1 + nu) / E
    else:
        vertical, lateral = -1 / E, nu / E
    u = PRESSURE * lateral * x[:, :gdim]
    u[:, -1] = PRESSURE * vertical * (x[:, gdim - 1] + 1.0)
    return u


def error_of_displacement(problem):
    V = problem.u.function_space
    gdim = V.mesh.geometry.dim
    x = V.tabulate_dof_coordinates()
    u = problem.u.x.array.reshape(-1, gdim)[: len(x)]
    exact = linear_displacement(x, gdim)
    return V.mesh.comm.allreduce(np.abs(u - exact).max(initial=0.0), op=MPI.MAX)


def pressures(problem):
    data = problem.solution.contact()
    return np.concatenate(MPI.COMM_WORLD.allgather(data.pressure))


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("order", [("upper bottom", "lower top"), ("lower top", "upper bottom")])
@pytest.mark.parametrize("subdomains", [4, jagged], ids=["bisected", "jagged"])
@pytest.mark.parametrize("cell", CELLS)
def test_uniform_pressure_and_linear_displacement(cell, subdomains, order, degree):
    d = stacked(cell, 3, 4, subdomains)
    problem = two_body_problem(
        d,
        pressed(d, PRESSURE),
        held(d, *sides_of(cell)),
        [tfeti.Contact(*order)],
        degree,
        rtol=1e-12,
    )
    problem.solve()
    assert np.allclose(pressures(problem), PRESSURE, rtol=0, atol=1e-9)
    assert error_of_displacement(problem) < 1e-9
