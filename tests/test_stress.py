"""The stress harness judges rightly, and a few of its scenes are right (``benchmarks.stress``)."""

import json

import numpy as np
import pytest

from benchmarks.stability_scenes import floor, two_bodies
from benchmarks.stress import judge, meshes, nonlinear
from benchmarks.stress.__main__ import main
from benchmarks.stress.package import solve_scene
from benchmarks.stress.random_scenes import random_scene
from benchmarks.stress.reference import Untorn
from benchmarks.stress.scene import Body, Load, Scene

SEEDS = [*range(1, 6), 131, 820070]  # that rests on an edge which is held on one side
SEEDS += [900406, 900508]  # of which nothing holds a body
SEEDS += [pytest.param(seed, marks=pytest.mark.slow) for seed in range(6, 40)]
SHEETS = (30, 39)


@pytest.mark.parametrize("seed", SEEDS)
def test_random_scenes_are_right_or_named(seed, comm):
    """Classes in capitals: wrong answers and verdicts, errors that are not the package's."""
    row = judge.run_scene(random_scene(seed), comm)
    if comm.rank == 0:
        assert row["class"].islower(), row
        assert row["class"] != "not converged" or seed in SHEETS, row


@pytest.mark.parametrize("seed", [1, 5, 8, 11])
def test_random_nonlinear_scenes_are_right(seed, serial_only):
    row = nonlinear.run_scene(nonlinear.random_scene(seed))
    assert row["class"] == "right", row


@pytest.mark.parametrize("kind", ["press", "pair"])
def test_wrong_nonlinear_steps_are_found(kind, serial_only):
    """A displacement that is a little off, and one without contact."""
    seeds = (nonlinear.random_scene(seed) for seed in range(100))
    scene = next(s for s in seeds if s.kind == kind and s.law == "neo-Hooke" and s.gdim == 2)
    made = nonlinear.blocks(scene)
    (problem, move), none = nonlinear.posed(scene, *made), np.zeros(2)
    move(0.2 * scene.path[-1])
    problem.solve()
    u = problem.decomposition.to_original(problem.u)
    assert nonlinear.Check(scene, *made).step(u, none, None) == []
    u.x.array[:] *= 1.0 + 1e-3 * np.arange(len(u.x.array)) / len(u.x.array)
    assert nonlinear.Check(scene, *made).step(u, none, None)


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


def test_a_wrong_answer_is_called_wrong(comm):
    scene = two_bodies("quadrilateral", 1.0, 1.0)
    g = meshes.grid(scene)
    outcome = solve_scene(scene, g, comm)
    if comm.rank == 0:
        outcome.u = outcome.u * (1 + 3e-4)
        assert judge.judged(scene, g, outcome)["class"] == "WRONG"


def test_the_harness_writes_a_row_for_each_scene(comm, shared_tmp):
    rows = main(["--only", "0", "1", "--output", str(shared_tmp)])
    if comm.rank == 0:
        assert [row["scene"] for row in rows] == [0, 1]
        assert json.loads((shared_tmp / "stress.json").read_text())[1]["class"] == rows[1]["class"]
