"""Each row of the stability benchmark is right, warned of or named; warnings say what they must."""

import numpy as np
import pytest
from bodies import boxes
from dolfinx import fem
from mpi4py import MPI
from scenes import box, clamp, decomposed, forms, hooke, problem

import tfeti_dolfinx as tfeti
from benchmarks import stability
from benchmarks.stability_scenes import LADDERS
from benchmarks.stress.judge import run_scene
from benchmarks.stress.meshes import grid
from benchmarks.stress.package import solve_scene
from tfeti_dolfinx.mesh.diagnostics import flatness

FEW = ("triangle", "hexahedron")


def rungs():
    for ladder in LADDERS:
        for cell in ladder.cells:
            for k, value in enumerate(ladder.values):
                quick = cell == "triangle" and k == len(ladder.values) - 1
                marks = [] if quick else [pytest.mark.slow]
                name = f"{ladder.group}, {ladder.name}, {cell} {stability.label(ladder, value)}"
                yield pytest.param(ladder, cell, value, id=name, marks=marks)


@pytest.mark.parametrize(("ladder", "cell", "value"), list(rungs()))
def test_a_row_is_right_or_warned_of_or_named(ladder, cell, value, comm):
    scene = ladder.rung(cell, value)
    row = run_scene(scene, comm)
    if comm.rank == 0:
        found = stability.verdict(scene, row)
        assert found.islower(), row
        assert found in ("right", "warned", "not judged") or stability.said(row)


def warnings_of(words, found):
    return [warning for warning in found if words in warning]


def test_a_friendly_scene_has_no_warnings():
    p = problem(decomposed("hexahedron", 3, 4), traction=(0.0, 0.0, -1e-3))
    p.solve()
    assert p.report.warnings == []


@pytest.mark.parametrize("gdim", [2, 3])
@pytest.mark.parametrize(("aspect", "low"), [(1.0, 0.999), (2000.0, 600.0)])
def test_flatness_knows_boxes_and_simplices(gdim, aspect, low):
    for cell in ("quadrilateral", "triangle") if gdim == 2 else ("hexahedron", "tetrahedron"):
        mesh, _, _ = box(cell, 2)
        mesh.geometry.x[:, 1] /= aspect
        found = flatness(mesh)
        assert np.all(found >= 0.999)
        assert np.all((found >= low) & (found <= 3.0 * aspect))
        if aspect == 1.0 and cell in ("quadrilateral", "hexahedron"):
            assert found == pytest.approx(1.0)


def test_a_regular_simplex_has_flatness_one():
    for cell in ("triangle", "tetrahedron"):
        mesh, _, _ = box(cell, 1)
        regular = flatness(mesh)
        scaled = mesh.geometry.x.copy()
        mesh.geometry.x[:] = 1e-9 * scaled
        assert flatness(mesh) == pytest.approx(regular)


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("nu", [0.3, 0.495])
def test_displacements_of_degree_1_are_warned_of_where_a_material_keeps_its_volume(nu, degree):
    d = decomposed("triangle", 3, 4)
    V, a, L = forms(d.mesh, d.facet_tags, (0, -0.01), d.surface("top"), degree, hooke(2.0, nu))
    bcs = [clamp(V, d.facets("left"))]
    p = tfeti.ContactProblem(a, L, bcs, [], d)
    p.solve()
    found = warnings_of("Poisson's ratio is about 0.495 ", p.report.warnings)
    assert len(found) == (1 if nu == 0.495 and degree == 1 else 0), p.report.warnings


@pytest.mark.parametrize("size", [0.02, 0.5])
def test_rotations_beyond_linear_kinematics_are_warned_of(size):
    p = problem(decomposed("quadrilateral", 4, 4), traction=(0.0, -size))
    p.solve()
    found = warnings_of("radians", p.report.warnings)
    assert bool(found) == (size == 0.5), p.report.warnings


def test_a_body_that_turns_is_named_and_one_that_moves_is_not():
    """Rigid motions that are prescribed: a rotation by 0.2, a translation by 5."""
    parts = [("a", (0.0, 0.0), (1.0, 1.0), (2, 2)), ("b", (3.0, 0.0), (4.0, 1.0), (2, 2))]
    mesh, tags, names = boxes("quadrilateral", parts)
    d = tfeti.decompose(mesh, 4, facet_tags=tags, surfaces=names)
    V, a, L = forms(d.mesh, d.facet_tags, (0.0, 0.0), d.surface("a top"))
    bcs = []
    for name, motion in (("a", lambda x: np.stack((-0.2 * x[1], 0.2 * x[0]))), ("b", None)):
        u = fem.Function(V)
        u.interpolate(motion or (lambda x: np.full((2, x.shape[1]), 5.0)))
        dofs = fem.locate_dofs_topological(V, 1, d.facets(f"{name} left"))
        bcs.append(fem.dirichletbc(u, dofs))
    p = tfeti.ContactProblem(a, L, bcs, [], d)
    p.solve()
    (found,) = warnings_of("radians", p.report.warnings)
    assert found.startswith(f"{d.body_names[0]}: parts turn by up to 0.2 radians")


def test_motions_that_nothing_holds_are_warned_of(comm):
    ladder = next(ladder for ladder in LADDERS if ladder.name == "loose stack")
    row = run_scene(ladder.rung("triangle", 1.0), comm)
    if comm.rank == 0:
        assert warnings_of("3 rigid motions are free", row["warnings"])
        assert warnings_of("body 1: contacts with a force do not hold", row["warnings"])


@pytest.mark.parametrize("slenderness", [100.0, 1e4])
def test_beams_that_rounding_bends_are_warned_of(slenderness, comm):
    ladder = next(ladder for ladder in LADDERS if ladder.name == "beam")
    row = run_scene(ladder.rung("quadrilateral", slenderness), comm)
    if comm.rank == 0:
        far = slenderness > 1e3
        assert bool(warnings_of("rounding of the stiffness", row["warnings"])) == far
        assert bool(warnings_of("the flattest", row["warnings"])) == far
        assert (row["u"] > 1e-6) == far


def test_what_rounding_ends_is_not_called_a_contradiction(comm):
    """Nodes on one floor: no rows depend on each other, however little F is definite."""
    ladder = next(ladder for ladder in LADDERS if ladder.name == "flat block")
    row = run_scene(ladder.rung("hexahedron", 1e4), comm)
    if comm.rank == 0:
        assert row["error"].startswith("ConvergenceError")
        assert "DIVERGED_ROUNDING" in row["error"]
        assert warnings_of("the flattest", row["warnings"])


def test_bodies_that_a_mesh_joins_in_nodes_alone_are_named(comm):
    ladder = next(ladder for ladder in LADDERS if ladder.name == "hinge")
    for joined in (0.0, 1.0):
        row = run_scene(ladder.rung("triangle", joined), comm)
        if comm.rank == 0:
            found = warnings_of("in nodes alone (1)", row["warnings"])
            assert len(found) == joined
            assert all(warning.startswith("body 0, body 1: ") for warning in found)


# ladder, value, multiplications over those of the first value: a fifth more than measured, and one
TIMES = [
    ("soft on stiff", 1e6, 1.29),
    ("stiff on soft", 1e6, 1.0),
    ("loose stack", 1e6, 1.0),
    ("subdomains of a body", 1e6, 1.43),
    ("subdomains of a pair", 1e6, 1.25),
    ("cells", 1e6, 1.33),
    ("slivers", 1e3, 1.86),
    ("layers at contact", 1e2, 2.86),
    ("layers at contact", 1e3, 3.29),
    ("flat block", 10.0, 3.54),
    ("flat block", 1e2, 4.62),
    ("plate", 1e2, 1.64),
    ("plate", 1e3, 1.55),
    ("arch", 1e3, 3.71),
    ("strips", 1e3, 9.86),
    ("hang at corners", 1.0, 0.71),
    ("random", 3.0, 1.12),
    ("two obstacles", 1e-6, 1.23),
    ("two obstacles", 1e-3, 1.14),
    ("pairs of a node", 2.0, 4.78),
    ("pairs of a node", 3.0, 6.9),
    ("grazing", -1e-6, 0.89),
    ("all or nothing", 1.0, 1.3),
    ("P1", 0.499, 3.4),
    ("P1, loose", 0.499, 2.11),
    ("P2", 0.499, 2.89),
    ("Coulomb, nu", 0.499, 4.06),
]


def ratios():
    for name, value, times in TIMES:
        ladder = next(ladder for ladder in LADDERS if ladder.name == name)
        for cell in ladder.cells:
            marks = [] if name in QUICK and cell in QUICK[name] else [pytest.mark.slow]
            arguments = (ladder, cell, value, times)
            yield pytest.param(*arguments, id=f"{name} {value:g} {cell}", marks=marks)


QUICK = {"pairs of a node": ("hexahedron", "tetrahedron"), "strips": ("hexahedron",)}


@pytest.mark.parametrize(("ladder", "cell", "value", "times"), list(ratios()))
def test_hard_scenes_cost_what_the_table_says(ladder, cell, value, times, serial_only):
    """Nodes of three pairs took 319 times as much where all that leaves a face left at once."""
    found = []
    for rung in (ladder.values[0], value):
        scene = ladder.rung(cell, rung)
        outcome = solve_scene(scene, grid(scene), MPI.COMM_SELF)
        assert not outcome.error
        found.append(outcome.report["F"])
    assert found[1] <= 1.2 * times * found[0] + 1, found


# P1 and P2 tetrahedra: a tenth more than measured
COUNTS = [("P1", 0.3, 10), ("P1", 0.499, 34), ("P2", 0.3, 26), ("P2", 0.499, 48)]


@pytest.mark.parametrize(
    ("name", "nu", "most"),
    [pytest.param(*row, marks=[] if row[0] == "P1" else [pytest.mark.slow]) for row in COUNTS],
)
def test_tetrahedra_that_keep_their_volumes(name, nu, most, serial_only):
    ladder = next(ladder for ladder in LADDERS if (ladder.group, ladder.name) == ("nu", name))
    scene = ladder.rung("tetrahedron", nu)
    outcome = solve_scene(scene, grid(scene), MPI.COMM_SELF)
    assert outcome.report["F"] <= 1.1 * most, outcome
