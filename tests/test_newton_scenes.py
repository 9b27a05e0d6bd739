"""Block Newton on scenes: it finds what SMALSE-M finds, and contact costs little."""

import pytest
from bodies import held, pressed, stacked, stiffer_above, two_body_problem
from scenes import apart, curved_obstacle, decomposed, displacement, problem
from test_faces import in_a_corner, on_a_block

import tfeti_dolfinx as tfeti

RTOL = 1e-8


def on_an_obstacle(cell, reach=0.2):
    d = decomposed(cell, 4, 6)
    obstacle = tfeti.Obstacle("bottom", curved_obstacle(d.mesh.geometry.dim), reach=reach)
    return lambda **options: problem(d, contacts=[obstacle], **options)


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
    "triangles on an obstacle": on_an_obstacle("triangle"),
    "late rows": on_an_obstacle("hexahedron", 0.035),
    "in a corner": in_a_corner,
    "on a block": on_a_block,
    "equal blocks": blocks(1.0),
    "a soft block": blocks(1e-4),
    "two equal obstacles": between_parallel_planes(0.0),
    "two parallel obstacles": between_parallel_planes(1e-3),
}


@pytest.mark.parametrize("name", list(SCENES))
def test_it_finds_what_smalse_finds(name):
    newton, smalse = (SCENES[name](rtol=RTOL, qp_type=kind) for kind in ("newton", "smalse"))
    newton.solve()
    smalse.solve()
    assert apart(displacement(newton)[1], displacement(smalse)[1]) <= 100 * RTOL
    assert newton.report.active_contacts > 0
    assert newton.report.newton_faces > 0 == smalse.report.newton_faces
    assert newton.report.power_method_multiplications == 0
    assert newton.report.F_multiplications < smalse.report.F_multiplications
