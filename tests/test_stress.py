"""The stress harness judges rightly, and a few of its scenes are right (``benchmarks.stress``)."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.stability_scenes import with_friction
from benchmarks.stress import judge, meshes, reference
from benchmarks.stress.__main__ import main
from benchmarks.stress.equilibrium import has_none
from benchmarks.stress.ladders import floor, ladder_scenes, two_bodies
from benchmarks.stress.package import Outcome, solve_scene
from benchmarks.stress.qp import UnsettledError
from benchmarks.stress.random_scenes import random_scene
from benchmarks.stress.reference import Untorn
from benchmarks.stress.scene import Body, Held, Load, Pair, Scene, Wall
from tfeti_dolfinx.errors import TfetiError

# 237: no load; 314: a far row is kept, however uncertain its normal; 608: rows of a stiff side on a
# few soft nodes; 798: u is rounding of points; 913: rows that are rounding of normals of tiny
# facets; 981: rounding of a motion along rows is no hold; 1110: a part whose load is rounding;
# 6054: a linear program that HiGHS' presolving spoils
SEEDS = [*range(1, 8), 237, 314, 608, 798, 913, 981, 1110, 6054]
SEEDS += [pytest.param(seed, marks=pytest.mark.slow) for seed in range(8, 20)]


@pytest.mark.parametrize("seed", SEEDS)
def test_random_scenes_are_right_or_named(seed, comm):
    """Classes in capitals: wrong answers and verdicts, errors that are not the package's."""
    row = judge.run_scene(random_scene(seed), comm)
    if comm.rank == 0:
        assert row["class"].islower(), row


# 63: a body that nothing loads, with gaps that are rounding of 0, beside others that move by 1e-6
# of their size; 68, 2106: forces that are rounding of 0; 163: gaps 1e12 times as large as the error
# allowed; 2186: bodies 220 and 600 times as long as thick; 5033: normals of a side at 2e5 of its
# length; 6044: a kernel of flat triangles; 6114: u is 1e-4 of that of the first look
@pytest.mark.parametrize("qp_type", ["newton", "smalse"])
@pytest.mark.parametrize("seed", [63, 68, 163, 2106, 2186, 5033, 6044, 6114])
def test_scenes_near_to_rounding_are_right_with_both_solvers(seed, qp_type, comm):
    scene = random_scene(seed)
    scene = replace(scene, options={**scene.options, "tfeti_qp_type": qp_type})
    row = judge.run_scene(scene, comm)
    if comm.rank == 0:
        assert row["class"] == "right", row


def test_conjugate_gradients_begin_anew_where_rounding_ends_them(comm):
    """39: a strip 2500 times as long as thick; the first look finds 130 times its displacement."""
    scene = replace(random_scene(39), options={"tfeti_rtol": 1e-4})
    row = judge.run_scene(scene, comm)
    if comm.rank == 0:
        assert row["class"] == "right", row


def test_the_reference_keeps_the_law(comm):
    """81: a set that leaves a motion free gave a normal force that pulls, and changed no more."""
    scene = with_friction(random_scene(81), "coulomb", 0.2)
    row = judge.run_scene(replace(scene, options={"tfeti_rtol": 1e-8}), comm)
    if comm.rank == 0:
        assert row["class"] == "right", row


@pytest.mark.parametrize("friction", [("coulomb", 0.5), ("tresca", 1e-3)])
@pytest.mark.parametrize("component", [0, 1])
def test_friction_where_values_are_prescribed(component, friction, comm):
    """Of nodes that slip by what is prescribed, and of those whose normal displacement is."""
    low = Body((0.0, 0.0), (1.0, 1.0), (4, 4))
    high = Body((0.0, 1.0), (1.0, 2.0), (3, 3))
    ends = Held((0, 1, 0), (0, 1)), Held((1, 0, 0), (component,), value=-1e-3)
    pair = Pair((1, 1, 0), (0, 1, 1), friction)
    wall = Wall((1, 0, 0), "plane", ((-1e-3, 0.0), (1.0, 0.0)), ("tresca", 1e-3))
    walls = (wall,) if component == 0 else ()
    held = ends if component == 0 else (*ends, Held((1, 1, 1), (0,)))
    load = Load((1, 1, 1), (0.0, -1e-2))
    scene = Scene("triangle", (low, high), held, (load,), walls, (pair,), subdomains=4)
    row = judge.run_scene(replace(scene, options={"tfeti_rtol": 1e-8}), comm)
    if comm.rank == 0:
        assert row["class"] == "right", row
        assert row["u"] <= 1e-6


@pytest.mark.parametrize(("seed", "mu", "most"), [(3, 0.4, 130), (42, 0.3, 110)])
def test_a_way_to_the_law_that_rounding_has_lost_is_left(seed, mu, most, comm):
    """A face that is nearly singular makes forces of 1e27: 176 and 163 by F when that went on."""
    scene = with_friction(random_scene(seed), "coulomb", mu)
    row = judge.run_scene(replace(scene, options={"tfeti_rtol": 1e-4}), comm)
    if comm.rank == 0:
        assert row["class"] == "right", row
        assert row["F"] <= most


def test_soft_rows_hold_with_friction_beside_stiff_ones_that_are_open(comm):
    """54: moduli of subdomains are as 3e6 : 1; bounds that hold the load were taken for none."""
    scene = with_friction(random_scene(54), "coulomb", 0.5)
    row = judge.run_scene(replace(scene, options={"tfeti_rtol": 1e-4}), comm)
    if comm.rank == 0:
        assert row["class"] == "right", row


def test_forces_after_a_far_fall_are_known(comm):
    """124: u is the fall, 2e5 lengths, and right to rounding long before the forces are.

    u = 497 is right to 1e-13, and a row of K times that is up to 1e-3 of the forces, 1.5e-12.
    """
    row = judge.run_scene(random_scene(124), comm)
    if comm.rank == 0:
        assert row["class"] in ("right", "WRONG FORCE"), row
        assert row["force"] <= 1e-3


@pytest.mark.parametrize(
    "rung",
    [
        "far obstacle quadrilateral 0.001",
        "far obstacle hexahedron 1e+06",
        "far beside touching triangle 1",
        "far, held by contact tetrahedron 100",
        "far pair quadrilateral 0.001",
        "checkerboard, open tetrahedron 1e+08",
        "subdomains hexahedron 1e+08",
        "flat block hexahedron 100",
    ],
)
def test_rungs_that_were_wrong_are_right(rung, comm):
    row = judge.run_scene(ladder_scenes()[rung], comm)
    if comm.rank == 0:
        assert row["class"] == "right", row


def test_forces_that_rounding_of_the_stiffness_changes_are_not_called_wrong(comm):
    row = judge.run_scene(ladder_scenes()["strips triangle 10000"], comm)
    if comm.rank == 0:
        assert row["class"] in ("right but for rounding", "not converged"), row


@pytest.mark.parametrize("subdomains", [1, 6])
def test_a_rung_is_right_on_ranks_without_subdomains(subdomains, comm):
    scene = two_bodies("triangle", 1.0, 1e4)
    row = judge.run_scene(replace(scene, subdomains=subdomains), comm)
    if comm.rank == 0:
        assert row["class"] == "right", row
        assert row["noise"] < 1e-9


def untorn(scene):
    g = meshes.grid(scene)
    return Untorn(scene, g, *meshes.materials(scene, g, np.zeros(len(g.cells), dtype=int)))


def answer(scene):
    return untorn(scene).answer()


# what presses a square that is 1e-2 wider than the room between walls: σ = E 1e-2, on both sides
# μσ, so a load of 2μσ = 1e-2 with μ = 0.5
@pytest.mark.parametrize(
    ("gap", "load", "none"), [(0.01, 1e-3, True), (-0.005, 8e-3, False), (-0.005, 1.2e-2, True)]
)
def test_a_mixed_integer_program_says_where_friction_cannot_hold(gap, load, none):
    law = ("coulomb", 0.5)
    left = Wall((0, 0, 0), "plane", ((-gap, 0.0), (1.0, 0.0)), law)
    right = Wall((0, 0, 1), "plane", ((1.0 + gap, 0.0), (-1.0, 0.0)), law)
    body = Body((0.0, 0.0), (1.0, 1.0), (4, 4), nu=0.0)
    down = Load((0, 1, 1), (0.0, -load))
    scene = Scene("quadrilateral", (body,), loads=(down,), walls=(left, right))
    assert has_none(untorn(scene)) == none


def test_the_reference_keeps_rows_that_are_nearly_dependent():
    """A fine side 1e7 times as stiff as the nodes that its rows act on besides."""
    found = answer(random_scene(608))
    missed = found.rows @ found.u.ravel() - found.gap
    assert missed.max() <= 1e-9 * np.abs(found.u).max()


def on_the_floor(cell, traction):
    """A unit box on a floor, its top drawn by a traction."""
    gdim = len(traction)
    box = Body((0.0,) * gdim, (1.0,) * gdim, (2,) * gdim, E=2.0, nu=0.0)
    return Scene(cell, (box,), loads=(Load((0, gdim - 1, 1), traction),), walls=(floor(cell),))


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_the_reference_knows_a_uniform_pressure(cell):
    gdim = 2 if cell == "quadrilateral" else 3
    found = answer(on_the_floor(cell, (0.0,) * (gdim - 1) + (-0.1,)))
    assert found.verdict == "solvable"
    exact = -0.05 * found.x[:, gdim - 1]
    assert np.allclose(found.u[:, gdim - 1], exact, rtol=0, atol=1e-12)
    assert found.free.shape[1] == (1 if gdim == 2 else 3)
    assert found.forces.sum(axis=0)[-1] == pytest.approx(0.1, rel=1e-10)


@pytest.mark.parametrize(
    ("cell", "traction"),
    [
        ("quadrilateral", (0.012, -0.1)),
        ("quadrilateral", (0.029, -0.1)),
        ("hexahedron", (0.02, 0.01, -0.1)),
    ],
)
def test_friction_in_decimal_digits_is_what_it_is_in_double_precision(cell, traction, monkeypatch):
    scene = with_friction(on_the_floor(cell, traction), "coulomb", 0.3)
    found = answer(scene)

    def unsettled(*_):
        raise UnsettledError("as where digits are too few")

    monkeypatch.setattr(reference, "solve_sliding", unsettled)
    again = answer(scene)
    assert np.abs(found.u).max() > 0.01
    assert np.allclose(again.u, found.u, rtol=0, atol=1e-12)
    assert np.allclose(again.forces, found.forces, rtol=0, atol=1e-12)
    assert 0 < again.noise.max() < 1e-12


@pytest.mark.parametrize("traction", [(0.0, 0.1), (1e-6, -0.1), (0.0, 0.0, 0.1)])
def test_the_reference_knows_what_has_no_solution(traction):
    cell = "triangle" if len(traction) == 2 else "hexahedron"
    assert answer(on_the_floor(cell, traction)).verdict == "no_solution"


def test_the_two_references_of_the_tests_agree():
    """The lever of ``test_mortar``'s reference, by the harness's own mortar and solver."""
    from mortar_reference import TwoBoxes

    from benchmarks.stress.scene import Held, Pair

    lower = Body((0.0, -1.0), (1.0, 0.0), (3, 3))
    upper = Body((0.0, 0.0), (1.0, 1.0), (4, 4))
    held = (Held((0, 1, 0), (0, 1)), Held((1, 0, 0), (0, 1)))
    loads = (Load((1, 1, 1), (0.0, -0.1)),)
    scene = Scene("quadrilateral", (lower, upper), held, loads, (), (Pair((1, 1, 0), (0, 1, 1)),))
    found = answer(scene)
    x, u, _, force = TwoBoxes("quadrilateral", 3, 4, push=0.1, pull=-0.1).solve()
    order = np.lexsort(np.rint(found.x.T * 1e7))
    for k in (0, 1):  # nodes that coincide may be in another order
        assert np.sort(found.u[order, k]) == pytest.approx(np.sort(u[:, k]), abs=1e-12)
    on_upper = found.forces[found.body == 1].sum(axis=0)[1]
    assert on_upper == pytest.approx(force.sum(), rel=1e-9)


def test_a_wrong_answer_is_called_wrong(comm):
    scene = two_bodies("quadrilateral", 1.0, 1.0)
    g = meshes.grid(scene)
    outcome = solve_scene(scene, g, comm)
    if comm.rank == 0:
        outcome.u = outcome.u * (1 + 3e-4)
        assert judge.judged(scene, g, outcome)["class"] == "WRONG"


def test_ladders_have_names_of_their_own_and_scenes_of_a_seed_are_the_same():
    assert len(ladder_scenes()) > 300
    assert random_scene(5) == random_scene(5)


def test_a_process_that_dies_is_a_row(serial_only, tmp_path):
    rows = main(["--only", "0", "no such scene", "1", "--output", str(tmp_path), "--limit", "100"])
    assert [row["scene"] for row in rows] == ["0", "no such scene", "1"]
    assert rows[1]["class"] == "DEATH"
    assert "ValueError" in rows[1]["error"]
    assert (tmp_path / "stress.md").read_text().startswith("| class | scenes |")


def test_every_error_of_the_package_is_a_named_one():
    """Not those of its conformance checks, which no solve makes."""
    own = {kind.__name__ for kind in TfetiError.__subclasses__()} - {"ConformanceError"}
    assert own | {"TfetiError"} == set(judge.NAMED)


@pytest.mark.parametrize("kind", ["FactorError", "ConvergenceError"])
def test_a_named_error_is_no_crash(kind):
    scene = two_bodies("triangle", 1.0, 1.0)
    g = meshes.grid(scene)
    mu, lmbda = meshes.materials(scene, g, np.zeros(len(g.cells), dtype=int))
    found = judge.judged(scene, g, Outcome(error=f"{kind}: why", mu=mu, lmbda=lmbda))
    assert found["class"] == "not converged"
    assert judge.judged(scene, g, Outcome(error=f"{kind}: why"))["class"] == "refused"
    assert judge.judged(scene, g, Outcome(error="IndexError: why"))["class"] == "CRASH"
