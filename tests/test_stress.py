"""The stress harness judges rightly, and a few of its scenes are right (``benchmarks.stress``)."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.stability_scenes import floor, two_bodies
from benchmarks.stress import judge, meshes
from benchmarks.stress.__main__ import main
from benchmarks.stress.package import Outcome, solve_scene
from benchmarks.stress.random_scenes import random_scene
from benchmarks.stress.reference import Untorn
from benchmarks.stress.scene import Body, Held, Load, Pair, Scene, Wall
from tfeti_dolfinx.errors import TfetiError

SEEDS = [*range(1, 8)]
SEEDS += [pytest.param(seed, marks=pytest.mark.slow) for seed in range(8, 40)]


@pytest.mark.parametrize("seed", SEEDS)
def test_random_scenes_are_right_or_named(seed, comm):
    """Classes in capitals: wrong answers and verdicts, errors that are not the package's."""
    row = judge.run_scene(random_scene(seed), comm)
    if comm.rank == 0:
        assert row["class"].islower(), row


@pytest.mark.parametrize(("component", "friction"), [(0, ("coulomb", 0.5)), (1, ("tresca", 1e-3))])
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


@pytest.mark.parametrize("subdomains", [1, 6])
def test_a_rung_is_right_on_ranks_without_subdomains(subdomains, comm):
    scene = two_bodies("triangle", 1.0, 1e4)
    row = judge.run_scene(replace(scene, subdomains=subdomains), comm)
    if comm.rank == 0:
        assert row["class"] == "right", row
        assert row["noise"] < 1e-9


def answer(scene):
    g = meshes.grid(scene)
    none = np.zeros(len(g.cells), dtype=int)
    return Untorn(scene, g, *meshes.materials(scene, g, none)).answer()


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


@pytest.mark.parametrize("traction", [(0.0, 0.1), (1e-6, -0.1), (0.0, 0.0, 0.1)])
def test_the_reference_knows_what_has_no_solution(traction):
    cell = "triangle" if len(traction) == 2 else "hexahedron"
    assert answer(on_the_floor(cell, traction)).verdict == "no_solution"


def test_the_two_references_of_the_tests_agree():
    """The lever of ``test_mortar``'s reference, by the harness's own mortar and solver."""
    from reference.mortar import TwoBoxes

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


def test_scenes_of_a_seed_are_the_same():
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
