"""Series of load steps: slips count from step to step, steps are halved, killed series go on."""

import csv
import json
import shutil
import sys

import numpy as np
import pytest
from bodies import gathered
from scenes import largest
from sheared import BOUND, Driven, Sheared, tops
from steps_script import TIMES
from test_ranks import run as run_script
from test_repeated import Repeated

import tfeti_dolfinx as tfeti

PATH = [0.02, 0.06, 0.06, 0.02, -0.06, -0.08, 0.06, -0.01]


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_a_block_pushed_and_pulled_back_slips_as_in_closed_form(cell):
    """Shear, slip and dissipation of each step; u is linear, so that the mesh does not matter."""
    scene = Sheared(cell, 3)
    comm = scene.problem.decomposition.comm
    for n, top in enumerate(PATH):
        scene.top.value = top
        scene.problem.solve()
        data = scene.problem.solution.contact(0)
        lost = comm.allreduce(float(np.sum(scene.problem.solution.dissipation)))
        shear, step, _ = tops(PATH)[n]
        traction, slip = gathered(data.tangential_traction), gathered(data.slip)
        assert np.allclose(traction[:, 0], -shear, rtol=0, atol=1e-7)
        assert np.allclose(slip[:, 0], step, rtol=0, atol=1e-7)
        assert np.allclose(traction[:, 1:], 0.0, rtol=0, atol=1e-7)
        assert lost == pytest.approx(BOUND * abs(step), abs=1e-8)
        scene.problem.accept()
    assert np.ptp([shear for shear, _, _ in tops(PATH)]) == pytest.approx(2 * BOUND)


def test_forces_over_load_steps_are_a_table(shared_tmp):
    """Pushed to and fro: no step dissipates less than nothing; forces and supports balance."""
    scene = Driven(rtol=1e-10)
    path = np.array([0.0, 1.0, 0.0, -1.0])

    def apply(problem, t):
        scene.load.value[:] = (0.06 * path[round(t) % 4], -0.03)

    steps = tfeti.LoadSteps(scene.problem, apply, range(9), begin=-1.0)
    records = steps.run()
    assert all(r.dissipation >= -1e-10 for r in records)
    steps.write_csv(shared_tmp / "pushed.csv")
    with (shared_tmp / "pushed.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [float(row["time"]) for row in table] == list(range(9))
    name = scene.problem.contacts[0].name
    forces = np.array([[float(row[f"{name} {axis}"]) for axis in "xy"] for row in table])
    last = scene.problem.solution.contact().resultant.force
    assert np.allclose(forces[-1], last, rtol=1e-12, atol=0)
    assert np.allclose(forces, [r.contact_forces[0] for r in records], rtol=1e-12, atol=0)
    held = scene.problem.solution.reaction("left").force  # beside the load of the last step
    assert np.allclose(forces[-1] + held, (0.0, 0.03), rtol=0, atol=1e-6)
    with pytest.raises(tfeti.InputError, match="csv"):
        steps.write_csv(shared_tmp / "pushed.txt")


def test_halved_steps_begin_at_the_last_accepted_one():
    """As if the times had been the halved ones from the beginning."""
    halved, plain = Driven(rtol=1e-10), Driven(rtol=1e-10)
    solve, reached, asked = halved.problem.solve, [0.0], []

    def apply(problem, t):
        asked.append(t)
        halved.apply(problem, t)

    def fails_on_long_steps():
        solve()
        if asked[-1] - reached[-1] > 0.3:
            raise tfeti.ConvergenceError("too long")
        reached.append(asked[-1])
        return halved.problem.u

    halved.problem.solve = fails_on_long_steps
    records = tfeti.LoadSteps(halved.problem, apply, [1.0, 1.25]).run()
    assert asked == [1.0, 0.5, 0.25, 0.5, 1.0, 0.75, 1.0, 1.25]
    assert [r.time for r in records] == [0.25, 0.5, 0.75, 1.0, 1.25]
    assert [r.number for r in records] == [0, 0, 0, 0, 1]
    others = tfeti.LoadSteps(plain.problem, plain.apply, [r.time for r in records]).run()
    assert np.allclose(halved.problem.u.x.array, plain.problem.u.x.array, rtol=0, atol=1e-9)
    for one, other in zip(records, others, strict=True):
        assert one.dissipation == pytest.approx(other.dissipation, rel=1e-5, abs=1e-9)


@pytest.mark.parametrize("raises", [True, False])
def test_what_does_not_converge_is_named_with_its_time(raises):
    driven = Driven(max_it=1, error_if_not_converged=raises)
    steps = tfeti.LoadSteps(driven.problem, driven.apply, [1.0, 2.0], max_halvings=2)
    says = r"load step 0, from t = 0 to 0.25, does not converge, halved 2 times \(max_halvings=2\)"
    with pytest.raises(tfeti.ConvergenceError, match=says):
        steps.run()
    assert steps.records == []


def test_going_back():
    scene = Repeated("triangle")
    for call, what in ((scene.problem.accept, "solution"), (scene.problem.state, "state")):
        with pytest.raises(tfeti.InputError, match=f"there is no {what} yet"):
            call()
    first = scene.solve()
    scene.problem.accept()
    scene.solve(load=-0.08)
    scene.problem.go_back()
    assert scene.problem.solution is first
    assert np.array_equal(scene.problem.u.x.array, first.displacement.x.array)
    scene.solve()
    assert scene.problem.report.F_multiplications <= 2


def number_of_steps(file):
    """BP4's index has 64 bytes, and 64 for each step."""
    return (file / "md.idx").stat().st_size // 64 - 1


def test_files_of_a_series(shared_tmp):
    driven = Driven()
    path, folder = shared_tmp / "a" / "series.bp", shared_tmp / "checkpoint"
    steps = tfeti.LoadSteps(driven.problem, driven.apply, TIMES[:3], path=path, checkpoint=folder)
    steps.run()
    assert number_of_steps(path) == 3
    assert {f.name for f in path.parent.iterdir()} == {"series.bp", "series_cells.bp"}
    size = driven.problem.decomposition.comm.size
    expected = {"checkpoint.json", "records.jsonl", *(f"state_3_{r}.npz" for r in range(size))}
    expected |= {f"fields_{n}_{rank}.npz" for n in (1, 2, 3) for rank in range(size)}
    assert {f.name for f in folder.iterdir()} == expected
    lines = (folder / "records.jsonl").read_text().splitlines()
    assert [json.loads(line)["time"] for line in lines] == TIMES[:3]
    # the series goes on to times that it did not have, in the same process too
    more = Driven()
    steps = tfeti.LoadSteps(more.problem, more.apply, TIMES[:4], path=path, checkpoint=folder)
    assert [r.time for r in steps.run(resume=True)] == TIMES[:4]
    assert number_of_steps(path) == 4


def test_a_series_for_pyvista_goes_on(comm, shared_tmp):
    """Its times, and the last displacement, in one file; earlier steps come from the checkpoint."""
    pyvista = pytest.importorskip("pyvista")
    path, folder = shared_tmp / "series.pvd", shared_tmp / "checkpoint"
    for number in (2, 3):
        driven = Driven(n=3)
        given = driven.problem, driven.apply, TIMES[:number]
        tfeti.LoadSteps(*given, path=path, checkpoint=folder).run(resume=True)
    comm.barrier()
    reader = pyvista.get_reader(path)
    assert reader.time_values == TIMES[:3]
    reader.set_active_time_value(TIMES[2])
    found = reader.read()[0]["displacement"]
    assert np.isclose(np.abs(found).max(), largest(driven.problem.u.x.array), rtol=1e-12)
    parts = [f.name for f in shared_tmp.iterdir() if f.suffix in (".vtu", ".pvtu")]
    assert len(parts) == 3 * (comm.size + 1)


def run(ranks, *words):
    """Series of the scenes that folders are named after, in one process a rank."""
    return run_script(ranks, "steps_script.py", *words)


def run_to_the_end(*given):
    result = run(*given)
    assert result.returncode == 0, result.stderr


# what is solved on so many ranks; they start once, in the first test that asks
SERIES = {
    1: ["smooth", "stabilised", "tool"],
    2: ["rough", "coulomb", "plastic", "thrown", "apart"],
}


@pytest.fixture(scope="module")
def series(tmp_path_factory):
    """The folder of series that nobody stops, ``whole``, and that are ``begun``."""
    known = {}

    def of(ranks, scene):
        if (ranks, scene) not in known:
            top = tmp_path_factory.mktemp("series")
            scenes = SERIES[ranks] if scene in SERIES[ranks] else [scene]
            both = [(how, *(top / how / name for name in scenes)) for how in ("whole", "begun")]
            run_to_the_end(ranks, *both[0], *both[1])
            known.update({(ranks, name): top for name in scenes})
        return known[ranks, scene]

    return of


@pytest.mark.parametrize(
    ("ranks", "scene", "how"),
    [
        (1, "smooth", "committed"),
        (2, "rough", "between"),
        (2, "coulomb", "committed"),
        (1, "stabilised", "committing"),
        pytest.param(2, "rough", "writing", marks=pytest.mark.slow),
        pytest.param(2, "thrown", "committing", marks=pytest.mark.slow),
    ],
)
def test_a_killed_series_goes_on_to_its_answer(serial_only, tmp_path, series, ranks, scene, how):
    folder = tmp_path / scene
    assert run(ranks, how, folder).returncode != 0
    assert not (folder / "found.npz").exists()
    assert not (folder / "series.bp").exists()
    done = {"between": 3, "writing": 2, "committing": 2, "committed": 3}[how]
    index = json.loads((folder / "checkpoint" / "checkpoint.json").read_text())
    assert index["number"] == done
    run_to_the_end(ranks, "resume", folder)
    found = np.load(folder / "found.npz")
    expected = np.load(series(ranks, scene) / "whole" / scene / "found.npz")
    assert set(found) == set(expected)
    for name in expected:
        values, scale = found[name], np.abs(expected[name]).max(initial=0.0)
        assert np.allclose(values, expected[name], rtol=0, atol=1e-12 * scale), name
    assert number_of_steps(folder / "series.bp") == len(TIMES)
    left = {f.name for f in folder.iterdir()}
    assert left == {"checkpoint", "found.npz", "series.bp", "series_cells.bp"}
    if scene == "smooth":
        assert expected["late"].sum() > 0


@pytest.mark.parametrize(
    ("before", "scenes"),
    [
        # one of the four has no subdomain, and one of the two has no rows
        (2, {4: ["coulomb", "plastic"], 1: ["thrown", "apart"]}),
        (1, {2: ["tool"]}),
        pytest.param(2, {1: ["coulomb", "plastic"]}, marks=pytest.mark.slow),
        pytest.param(1, {2: ["coulomb", "stabilised"]}, marks=pytest.mark.slow),
    ],
)
def test_a_checkpoint_of_other_ranks(serial_only, tmp_path, series, before, scenes):
    folders = {tmp_path / name: after for after in scenes for name in scenes[after]}
    for folder in folders:
        shutil.copytree(series(before, folder.name) / "begun" / folder.name, folder)
    for after in scenes:
        run_to_the_end(after, "resume", *(tmp_path / name for name in scenes[after]))
    for folder, after in folders.items():
        found = np.load(folder / "found.npz")
        expected = np.load(series(before, folder.name) / "whole" / folder.name / "found.npz")
        for name in ("x", "u", "figures"):
            scale = np.abs(expected[name]).max()
            assert np.allclose(found[name], expected[name], rtol=0, atol=1e-10 * scale), name
        assert number_of_steps(folder / "series.bp") == len(TIMES)
        index = json.loads((folder / "checkpoint" / "checkpoint.json").read_text())
        assert len(index["states"]) == after
        states = {f.name for f in (folder / "checkpoint").glob("state_*")}
        assert states == {f"state_{len(TIMES)}_{rank}.npz" for rank in range(after)}
    run_to_the_end(before, "resume", *folders)  # all is done, and read again


def test_mistakes(shared_tmp):
    driven = Driven(n=3)
    problem, apply = driven.problem, driven.apply
    file = shared_tmp / "thesis.tex"
    file.touch()
    wrong = {
        "problem is None; expected a tfeti_dolfinx.ContactProblem": {"problem": None},
        "apply is 5; expected a function of the problem and a time": {"apply": 5},
        "apply: expected a function of the problem and a time: ": {"apply": lambda t: None},
        "times is 1.0; expected a list of increasing numbers": {"times": 1.0},
        "times is empty; expected at least one time": {"times": []},
        r"times\[1\]=1 is not after 2; expected increasing": {"times": [2.0, 1.0]},
        "max_halvings=-1: expected an integer, 0 to 30": {"max_halvings": -1},
        r"series.vtk: expected a name that ends with .bp": {"path": "series.vtk"},
        "is a file; expected the name of a folder": {"checkpoint": file},
        r"interior=True: expected LoadSteps\(..., path=\) too": {"interior": True},
    }
    usual = {"problem": problem, "apply": apply, "times": [1.0]}
    for says, given in wrong.items():
        with pytest.raises(tfeti.InputError, match=says):
            tfeti.LoadSteps(**{**usual, **given})
    with pytest.raises(tfeti.InputError, match="resume=True: expected LoadSteps"):
        tfeti.LoadSteps(problem, apply, [1.0]).run(resume=True)


def test_a_series_goes_on_with_its_own_problem_only(shared_tmp):
    """Another ``apply`` is named, and its problem is as it was.

    The same goes on, also where the times that were reached are rounded in another way.
    """
    times, folder = [0.3, 0.5, 1.0], shared_tmp / "own"

    def series(share, times):
        driven = Driven(n=4, subdomains=2)

        def apply(problem, t):
            driven.apply(problem, t)
            driven.load.value[:] *= share

        return tfeti.LoadSteps(driven.problem, apply, times, checkpoint=folder)

    series(1.0, times[:2]).run()
    other = series(1.1, times)
    with pytest.raises(tfeti.InputError, match=r"L: constants\[0\]\[0\] is .*, and was .*apply"):
        other.run(resume=True)
    assert other.records == []
    assert not np.any(other._problem.u.x.array)
    with pytest.raises(tfeti.InputError, match=r"0.5001 instead of 0.5"):
        series(1.0, [0.3, 0.5001, 1.0]).run(resume=True)
    rounded = [0.1 + 0.2, 0.5, 1.0]
    assert rounded != times
    assert len(series(1.0, rounded).run(resume=True)) == 3


def test_a_series_that_runs_again_after_an_error_writes_its_own_steps(shared_tmp):
    driven, wrong = Driven(n=3), [True]

    def apply(problem, t):
        driven.apply(problem, t)
        if t == 1.0 and wrong.pop():
            raise ZeroDivisionError("mine")

    steps = tfeti.LoadSteps(driven.problem, apply, [0.5, 1.0], path=shared_tmp / "again.bp")
    with pytest.raises(ZeroDivisionError):
        steps.run()
    assert number_of_steps(shared_tmp / "again.bp") == 1  # the one before
    wrong.append(False)
    steps.run()
    assert number_of_steps(shared_tmp / "again.bp") == 2
    assert not list(shared_tmp.glob(".*"))


@pytest.mark.parametrize("rich", [True, False])
def test_progress_is_shown_where_wanted(capfd, comm, monkeypatch, rich):
    if not rich:
        monkeypatch.setitem(sys.modules, "rich.progress", None)
    driven = Driven(n=3)
    for wanted in (None, False, True):
        tfeti.LoadSteps(driven.problem, driven.apply, [1.0], progress=wanted).run()
        said = "".join(capfd.readouterr())
        assert ("load steps" in said) == (wanted is True and comm.rank == 0)
