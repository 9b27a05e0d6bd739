"""Scenes without contact: PCPG against direct solves on the untorn mesh."""

import pytest
from reference.untorn import untorn_box
from scenes import decomposed, displacement, problem, relative, solved


def traction_of(cell):
    return (0.01, -0.05) if cell in ("triangle", "quadrilateral") else (0.01, 0.02, -0.05)


def exact(cell, n, traction, degree=1):
    scene = untorn_box(cell, n, traction, degree=degree)
    return scene.by_point(scene.linear())


@pytest.mark.parametrize(
    ("cell", "degree"),
    [("triangle", 2), ("quadrilateral", 1), ("tetrahedron", 1), ("hexahedron", 2)],
)
def test_agrees_with_a_direct_solver(cell, degree):
    n = 6 if degree == 1 else 3
    p = solved(problem(decomposed(cell, n, 5), traction_of(cell), degree=degree, tfeti_rtol=1e-11))
    _, u = displacement(p)
    assert relative(u, exact(cell, n, traction_of(cell), degree)) <= 1e-9
    assert p.report.residuals["gluing_jump"] <= p.report.tolerances["gluing_jump"]


@pytest.mark.parametrize(
    ("qp_type", "pc_type", "scaling"),
    [
        ("pcpg", "none", "stiffness"),
        ("pcpg", "lumped", "multiplicity"),
        ("pcpg", "dirichlet", "multiplicity"),
        ("smalse", "none", "stiffness"),
    ],
)
def test_every_solver_gives_the_same(pc_type, scaling, qp_type):
    options = dict(tfeti_pc_type=pc_type, tfeti_scaling=scaling, tfeti_qp_type=qp_type)
    traction, options["tfeti_rtol"] = traction_of("hexahedron"), 1e-10
    p = solved(problem(decomposed("hexahedron", 4, 8), traction, **options))
    assert relative(displacement(p)[1], exact("hexahedron", 4, traction)) <= 1e-8
