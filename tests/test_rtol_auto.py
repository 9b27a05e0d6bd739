"""-tfeti_rtol auto: as exact as the mesh is worth, for less."""

import pytest
from bodies import held, pressed, two_body_problem
from scenes import clamp, curved_obstacle, decomposed, forms, hooke, problem, solved
from true_errors import AGAINST_FINER, error_against, stress_of_cells

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.feti.stopping import StoppingTolerances


def work(p):
    """Multiplications by F and S, and what as much is done for looks."""
    r = p.report
    looks = r.recoveries + r.estimates.get("lifting_multiplications", 0)
    return r.F_multiplications + r.preconditioner_multiplications + looks


def is_reached(p):
    found = p.report.estimates
    allowed = StoppingTolerances().target * max(found["discretisation"], 1e-5 * found["energy"])
    return 0.0 < found["algebraic"] <= allowed * (1 + 1e-12)


@pytest.mark.parametrize(("scene", "sizes", "finest"), AGAINST_FINER)
def test_it_saves_a_third_and_spoils_nothing(serial_only, scene, sizes, finest):
    reference = stress_of_cells(solved(scene(finest, rtol=1e-7)))
    for size in sizes:
        auto, exact = scene(size, rtol="auto"), scene(size, rtol=1e-8)
        auto.solve()
        exact.solve()
        assert is_reached(auto)
        assert error_against(auto, reference)[0] <= 1.01 * error_against(exact, reference)[0]
        assert auto.report.F_multiplications <= exact.report.F_multiplications * 2 / 3
        assert work(auto) <= work(exact) * 2 / 3


LAWS = {"no friction": None, "bound": tfeti.Tresca(5e-3), "Coulomb": tfeti.Coulomb(0.3)}


@pytest.mark.parametrize(
    ("cell", "qp_type", "law"),
    [
        ("triangle", "newton", "Coulomb"),
        ("triangle", "smalse", "bound"),
        ("hexahedron", "newton", "bound"),
        ("hexahedron", "smalse", "no friction"),
        ("tetrahedron", "pcpg", "no friction"),
    ],
)
def test_all_solvers_reach_it(cell, qp_type, law):
    gdim = 2 if cell == "triangle" else 3
    d = decomposed(cell, 5, 6)
    obstacle = tfeti.Obstacle("bottom", curved_obstacle(gdim), reach=0.2, friction=LAWS[law])
    force, costs = (0.01,) + (0.0,) * (gdim - 2) + (-0.05,), []
    for rtol in ("auto", 1e-8):
        contacts = [obstacle] * (qp_type != "pcpg")
        p = solved(problem(d, force, contacts, qp_type=qp_type, rtol=rtol))
        costs.append(p.report.F_multiplications)
        assert bool(p.report.estimates) == (rtol == "auto")
        if rtol == "auto":
            assert is_reached(p)
            before = dict(p.report.estimates)
            after = p.estimate()
            assert after.algebraic == pytest.approx(before["algebraic"], rel=1e-3)
            assert after.discretisation == pytest.approx(before["discretisation"], rel=1e-9)
            assert after.energy == pytest.approx(before["energy"])
    assert costs[0] < costs[1] * (2 / 3 if qp_type == "pcpg" else 1)


def test_where_the_mesh_makes_no_error_it_ends():
    """A uniform stress: the algebraic error is compared with ‖u‖_K then."""
    d = decomposed("quadrilateral", 4, 4)
    bcs, stress = held(d, "bottom", "left"), hooke(1.0, 0.0)
    p = solved(two_body_problem(d, pressed(d, 0.01, "top"), bcs, [], stress=stress, rtol="auto"))
    assert is_reached(p)
    assert p.report.estimates["discretisation"] <= 1e-5 * p.report.estimates["energy"]
    lifted = held(d, "left", ("top", 0.02))
    for rtol in (1e-8, "auto"):  # ‖u‖_K is rounding
        p = two_body_problem(d, pressed(d, 0.0, "top"), lifted, [], stress=stress, rtol=rtol)
        p.solve()
        assert 0.0 < p.estimate().algebraic <= p.report.estimates["rounding"] < 1e-11
        assert not p.report.warnings


def test_it_needs_a_stress():
    d = decomposed("triangle", 2, 2)
    V, a, L = forms(d.mesh, d.facet_tags, (0.0, -0.01), d.surface("top"))
    bcs = [clamp(V, d.facets("left"))]
    with pytest.raises(tfeti.InputError, match=r"-tfeti_rtol auto: .*expected .*stress=sigma"):
        tfeti.ContactProblem(a, L, bcs, [], d, petsc_options={"tfeti_rtol": "auto"})
