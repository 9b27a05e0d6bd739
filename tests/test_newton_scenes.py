"""Block Newton on scenes: it finds what SMALSE-M finds, and contact costs little."""

import numpy as np
import pytest
from bodies import held, pressed, stacked, stiffer_above, two_body_problem
from scenes import curved_obstacle, decomposed, displacement, problem
from test_faces import in_a_corner, on_a_block

import tfeti_dolfinx as tfeti

RTOL = 1e-8


def on_an_obstacle(cell):
    d = decomposed(cell, 4, 6)
    obstacle = tfeti.Obstacle("bottom", curved_obstacle(d.mesh.geometry.dim), reach=0.2)
    return lambda **options: problem(d, contacts=[obstacle], **options)


def with_late_rows(**options):
    d = decomposed("hexahedron", 4, 6)
    obstacle = tfeti.Obstacle("bottom", curved_obstacle(3), reach=0.035)
    return problem(d, contacts=[obstacle], **options)


def between_parallel_planes(gap):
    """The rows of two obstacles on the same nodes are the same rows, with other gaps."""

    def made(**options):
        d = decomposed("hexahedron", 3, 4)
        planes = [tfeti.Plane((0, 0, -0.002 - z), (0, 0, 1)) for z in (0.0, gap)]
        contacts = [tfeti.Obstacle("bottom", plane, reach=0.2) for plane in planes]
        return problem(d, contacts=contacts, **options)

    return made


def blocks(ratio):
    """A block on a block that does not match it, one of them stiffer."""

    def made(**options):
        d = stacked("hexahedron", 3, 4, 4)
        stress = stiffer_above(d, ratio)
        clamped = held(d, "lower bottom", "upper left", "upper front")
        contact = tfeti.Contact("lower top", "upper bottom", secondary="lower top")
        return two_body_problem(d, pressed(d, 1e-2), clamped, [contact], stress=stress, **options)

    return made


SCENES = {
    "hexahedra on an obstacle": on_an_obstacle("hexahedron"),
    "triangles on an obstacle": on_an_obstacle("triangle"),
    "late rows": with_late_rows,
    "in a corner": in_a_corner,
    "on a block": on_a_block,
    "equal blocks": blocks(1.0),
    "a soft block": blocks(1e-4),
    "two equal obstacles": between_parallel_planes(0.0),
    "two parallel obstacles": between_parallel_planes(1e-3),
}


def solved(scene, **options):
    p = scene(tfeti_rtol=RTOL, **options)
    p.solve()
    return p


def apart(p, q):
    """Largest difference of two displacements over the largest displacement."""
    a, b = displacement(p)[1], displacement(q)[1]
    return np.abs(a - b).max() / np.abs(b).max()


@pytest.mark.parametrize("name", list(SCENES))
def test_it_finds_what_smalse_finds(name):
    newton = solved(SCENES[name], tfeti_qp_type="newton")
    smalse = solved(SCENES[name], tfeti_qp_type="smalse")
    assert apart(newton, smalse) <= 100 * RTOL
    assert newton.report.active_contacts > 0
    assert newton.report.newton_faces > 0 == smalse.report.newton_faces
    assert newton.report.power_method_multiplications == 0
    assert newton.report.F_multiplications < smalse.report.F_multiplications
    newton.destroy()
    smalse.destroy()


@pytest.mark.parametrize("pc_type", ["none", "lumped", "dirichlet"])
def test_preconditioners_do_not_change_the_answer(pc_type):
    scene = SCENES["a soft block"]
    p = solved(scene, tfeti_qp_type="newton", tfeti_pc_type=pc_type)
    q = solved(scene, tfeti_qp_type="newton")
    assert apart(p, q) <= 100 * RTOL
    multiplied = p.report.preconditioner_multiplications
    assert (multiplied == 0) == (pc_type == "none")
    p.destroy()
    q.destroy()


@pytest.mark.parametrize("name", ["equal blocks", "in a corner"])
def test_a_second_solve_costs_next_to_nothing(name):
    """At most 2 multiplications, and no factor but those of faces."""
    p = solved(SCENES[name], tfeti_qp_type="newton")
    before = displacement(p)[1]
    p.solve()
    assert p.report.F_multiplications <= 2
    assert p.report.factorizations == p.report.coarse_factorizations == 0
    assert np.allclose(displacement(p)[1], before, rtol=0, atol=100 * RTOL * np.abs(before).max())
    p.destroy()
