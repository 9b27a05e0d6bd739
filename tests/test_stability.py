"""Each row of the stability benchmark is right, warned of or named; warnings say what they must."""

from dataclasses import replace

import numpy as np
import pytest
import ufl
from bodies import clamped, no_load, torn_boxes, two_body_problem
from dolfinx import fem
from mpi4py import MPI
from scenes import box, decomposed, problem, solved

import tfeti_dolfinx as tfeti
from benchmarks import stability
from benchmarks.stability_scenes import LADDERS, label
from benchmarks.stress.judge import run_scene
from tfeti_dolfinx.accuracy import flatness

QUICK = ("stiff on soft", "loose stack", "cells", "P1", "layers at contact", "strips", "hinge")
QUICK += ("two obstacles", "grazing", "frictionless", "Tresca, moduli", "Coulomb, nu")
QUICK += ("far obstacle", "beam", "subdomains of a body")


def rungs():
    for ladder in LADDERS:
        for cell in ladder.cells:
            for value in ladder.values:
                quick = ladder.name in QUICK and cell == "triangle"
                marks = [] if quick else [pytest.mark.slow]
                name = f"{ladder.group}, {ladder.name}, {cell} {label(ladder, value)}"
                right = quick and ladder.name != "hinge"
                yield pytest.param(ladder, cell, value, right, id=name, marks=marks)


@pytest.mark.parametrize(("ladder", "cell", "value", "right"), list(rungs()))
def test_a_row_is_right_or_warned_of_or_named(ladder, cell, value, right, comm):
    scene = ladder.rung(cell, value)
    row = run_scene(scene, comm)
    if comm.rank == 0:
        found = stability.verdict(scene, row)
        assert found.islower(), row
        assert found in ("right", "not judged") or not right, row
        assert found in ("right", "warned", "not judged") or stability.said(row)


def rung(name, cell, value):
    """A rung of the ladder of this name."""
    return next(ladder for ladder in LADDERS if ladder.name == name).rung(cell, value)


@pytest.mark.parametrize(
    ("name", "cell", "friendly", "hard", "times"),
    [
        ("Coulomb, moduli", "hexahedron", 1.0, 1e4, 3.0),
        ("Coulomb, nu", "hexahedron", 0.3, 0.499, 4.0),
        ("pairs of a node", "hexahedron", 2, 3, 12.0),
        ("pairs of a node", "tetrahedron", 2, 3, 12.0),
    ],
)
def test_a_hard_rung_costs_few_times_the_friendly_one(
    name, cell, friendly, hard, times, serial_only
):
    rows = [run_scene(rung(name, cell, value), MPI.COMM_WORLD) for value in (friendly, hard)]
    assert [row["class"] for row in rows] == ["right", "right"]
    few, many = (row["F"] for row in rows)
    assert many <= times * few


def warnings_of(words, found):
    return [warning for warning in found if words in warning]


@pytest.mark.parametrize(("aspect", "low"), [(1.0, 0.999), (2000.0, 600.0)])
def test_flatness_knows_boxes_and_simplices(aspect, low):
    for cell in ("quadrilateral", "triangle", "hexahedron", "tetrahedron"):
        mesh, _, _ = box(cell, 2)
        mesh.geometry.x[:, 1] /= aspect
        found = flatness(mesh)
        assert np.all(found >= 0.999)
        assert np.all((found >= low) & (found <= 3.0 * aspect))
        if aspect == 1.0 and cell in ("quadrilateral", "hexahedron"):
            assert found == pytest.approx(1.0)


@pytest.mark.parametrize("case", [(0.3, 1, 0), (0.49, 1, 0), (0.49, 2, 0), (0.49, 1, 1)])
def test_degree_1_is_warned_of_where_a_material_keeps_its_volume(case, caplog):
    """In the log once, however many solves there are, but not of a law that is selective."""
    d, (nu, degree, selective) = decomposed("quadrilateral", 3, 4), case
    V = fem.functionspace(d.mesh, ("Lagrange", degree, (2,)))
    u, rubber = fem.Function(V), tfeti.Elasticity(d, E=2.0, nu=nu, model="axisymmetric")
    F = tfeti.NeoHooke(rubber, u, selective=bool(selective)).residual(ufl.TestFunction(V))
    bcs = clamped(d, "bottom", ("top", np.array((0.0, -0.2))))(V)
    p = solved(tfeti.NonlinearContactProblem(F, u, bcs, [], d, finite=True))
    found = warnings_of("Poisson's ratio of its stiffness is about 0.48", p.report.warnings)
    assert len(found) == (case == (0.49, 1, 0)), p.report.warnings
    p.solve()
    assert len(warnings_of("Poisson", caplog.messages)) == (len(found) if d.comm.rank == 0 else 0)
    assert ("  warnings  1 logged; " in str(p.report)) == bool(found)


def test_warnings_can_be_switched_off():
    """Of a part that turns, of motions that a floor leaves free, and none of a small load."""
    small = solved(problem(decomposed("quadrilateral", 4, 4), traction=(0.0, -0.02)))
    assert small.report.warnings == []
    floor = tfeti.Obstacle("bottom", tfeti.Plane((0, 0), (0, 1)))
    scenes = [{"traction": (0.0, -0.5)}, {"contacts": [floor], "clamped": ()}]
    for found, scene in zip(("warnings", "nearly_free"), scenes, strict=True):
        p, q = (
            problem(decomposed("quadrilateral", 4, 4), **scene, warnings=switch)
            for switch in ("on", "off")
        )
        p.solve()
        q.solve()
        assert getattr(p.report, found)
        assert q.report.warnings == q.report.nearly_free == []
        assert np.array_equal(p.u.x.array, q.u.x.array)


def test_a_body_that_turns_is_named_and_one_that_moves_is_not():
    """Rigid motions that are prescribed: a rotation by 0.2, a translation by 5."""
    parts = [("a", (0.0, 0.0), (1.0, 1.0), (2, 2)), ("b", (3.0, 0.0), (4.0, 1.0), (2, 2))]
    d = torn_boxes("quadrilateral", parts, 4)
    turn = fem.Function(fem.functionspace(d.mesh, ("Lagrange", 1, (2,))))
    turn.interpolate(lambda x: np.stack((-0.2 * x[1], 0.2 * x[0])))
    bcs = clamped(d, ("a left", turn), ("b left", 5.0))
    p = solved(two_body_problem(d, no_load, bcs, []))
    (found,) = warnings_of("radians", p.report.warnings)
    assert found.startswith(f"{d.body_names[0]}: parts turn by up to 0.2 radians")


def test_motions_that_nothing_holds_are_warned_of(comm):
    row = run_scene(rung("loose stack", "triangle", 1.0), comm)
    if comm.rank == 0:
        (note,) = warnings_of("3 rigid motions are free", row["warnings"])
        assert "body 1: " in note


@pytest.mark.parametrize("slenderness", [100.0, 1e4])
def test_beams_that_rounding_bends_are_warned_of(slenderness, comm):
    row = run_scene(rung("beam", "quadrilateral", slenderness), comm)
    if comm.rank == 0:
        far = slenderness > 1e3
        assert bool(warnings_of("rounding of the stiffness", row["warnings"])) == far
        assert bool(warnings_of("the flattest", row["warnings"])) == far
        assert (row["u"] > 1e-6) == far


@pytest.mark.parametrize(
    ("name", "cell", "rtol"), [("flat block", "hexahedron", None), ("beam", "triangle", 1e-15)]
)
def test_what_rounding_ends_is_called_so_with_all_warnings(name, cell, rtol, comm):
    """Nodes of the block are on one floor: no rows depend on each other, however flat it is.

    Whether its rounding is seen before the iterations have run out depends on the processor.
    """
    scene = rung(name, cell, 1e4)
    row = run_scene(replace(scene, options={"tfeti_rtol": rtol}) if rtol else scene, comm)
    if comm.rank == 0:
        assert row["error"].startswith("ConvergenceError: the dual solver stopped: DIVERGED_")
        known = "DIVERGED_ROUNDING" in row["error"] and "rounding does not let" in row["error"]
        assert known or (name == "flat block" and "DIVERGED_ITS" in row["error"])
        assert warnings_of("the flattest", row["warnings"])
        assert name != "beam" or all(text in row["error"] for text in row["warnings"])


def test_bodies_that_a_mesh_joins_in_nodes_alone_are_named(comm):
    for joined in (0.0, 1.0):
        row = run_scene(rung("hinge", "triangle", joined), comm)
        if comm.rank == 0:
            found = warnings_of("in nodes alone (1)", row["warnings"])
            assert len(found) == joined
            assert all(warning.startswith("body 0, body 1: ") for warning in found)


def test_atol_is_a_length():
    p = solved(problem(decomposed("quadrilateral", 6, 4), tfeti_rtol=1e-14, tfeti_atol=1e-5))
    assert p.report.converged_reason == "CONVERGED_ATOL"
    assert p.report.residuals["gluing_jump"] <= 2e-5


def test_rtol_0_asks_for_all_digits(comm):
    """Whether rounding is said to have ended it or not, it has them."""
    options = {"tfeti_rtol": 0.0, "tfeti_error_if_not_converged": False}
    row = run_scene(replace(rung("cells", "triangle", 1e4), options=options), comm)
    if comm.rank == 0:
        assert row["reason"] in ("CONVERGED_RTOL", "DIVERGED_ROUNDING")
        assert row["u"] <= 1e-10
