"""The side that carries the multipliers: the coarser, else the softer one, or that named."""

import numpy as np
import pytest
from bodies import held, pressed, sided, sides_of, stacked, stiffer_above, two_body_problem
from mpi4py import MPI
from scenes import solved

import tfeti_dolfinx as tfeti

UPPER, LOWER = "upper bottom", "lower top"


def scene(
    contact, n=(4, 4), stiffness=1.0, cell="quadrilateral", degree=1, subdomains=4, **options
):
    """A box on a box, n = (cells of the lower, of the upper); the upper one is stiffer."""
    d = stacked(cell, *n, subdomains)
    stress, bcs = stiffer_above(d, stiffness), held(d, *sides_of(cell))
    p = solved(two_body_problem(d, pressed(d), bcs, [contact], degree, stress=stress, **options))
    return p


@pytest.mark.parametrize("sides", [(UPPER, LOWER), (LOWER, UPPER)])
@pytest.mark.parametrize(
    ("n", "stiffness", "secondary"),
    [((3, 6), 0.1, LOWER), ((6, 3), 5.0, UPPER), ((16, 15), 5.0, LOWER), ((4, 4), 1.0, None)],
)
def test_the_coarser_side_is_taken_and_of_equal_meshes_the_softer_one(
    n, stiffness, secondary, sides
):
    p = scene(tfeti.Contact(*sides), n, stiffness)
    expected = secondary or sides[0]  # of two equal ones the first
    assert p.solution.contacts[0].surfaces[0] == expected
    _, dof = p.dofs.scalar
    height = p.u.function_space.tabulate_dof_coordinates()[p.dofs.dolfinx_node, 1]
    pressure = p.solution.pressure.x.array[dof]
    assert np.allclose(pressure[pressure > 0.0], 0.1, atol=1e-5)
    assert np.allclose(height[pressure > 0.0], 0.0)


@pytest.mark.parametrize(
    ("cell", "degree", "subdomains"), [("triangle", 2, 5), ("tetrahedron", 1, 2)]
)
def test_the_side_is_the_same_for_all_elements_and_subdomains(cell, degree, subdomains):
    p = scene(tfeti.Contact(UPPER, LOWER), (2, 3), 1.0, cell, degree, subdomains)
    assert p.solution.contacts[0].surfaces == (LOWER, UPPER)


def test_a_mesh_that_is_fine_only_where_bodies_meet_is_judged_there():
    """The lower surface is coarse on the whole, and finer than the upper one where that stands."""
    d = stacked("quadrilateral", 16, 2, 4, upper=(0.0, 0.25))
    x = d.mesh.geometry.x
    lower = x[:, 1] < 1e-9
    x[lower, 0] = np.where(x[lower, 0] > 0.25, 0.25 + 40 * (x[lower, 0] - 0.25), x[lower, 0])
    bcs = held(d, "lower bottom", "lower left", "upper left")
    p = solved(two_body_problem(d, pressed(d), bcs, [tfeti.Contact(LOWER, UPPER)]))
    assert p.solution.contacts[0].surfaces == (UPPER, LOWER)


@pytest.mark.parametrize("by_tag", [False, True])
def test_a_side_can_be_named(by_tag):
    d = stacked("quadrilateral", 4, 4, 4)
    p = scene(tfeti.Contact(LOWER, UPPER, secondary=d.surface(UPPER) if by_tag else UPPER), (4, 6))
    assert p.solution.contacts[0].surfaces == (UPPER, LOWER)


def test_a_choice_that_is_much_the_worse_one_is_warned_of(caplog):
    scene(sided(UPPER, LOWER), (6, 4), 100.0)
    assert "times as stiff" not in caplog.text  # it is the coarser one
    scene(sided(UPPER, LOWER), (4, 5), 3.0)
    warned = "'upper bottom' is 3.75 times as stiff per area as 'lower top'" in caplog.text
    assert warned == (MPI.COMM_WORLD.rank == 0)
