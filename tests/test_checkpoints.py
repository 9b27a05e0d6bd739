"""Checkpoints: their folder is their own, and nothing that is damaged goes on."""

import json
import shutil

import numpy as np
import pytest
import ufl
from bodies import held, stacked
from dolfinx import fem
from full_disk import clear, fill, left_in
from scenes import largest, unknowns
from sheared import Driven

import tfeti_dolfinx as tfeti
from benchmarks.stress.laws import neo_hooke

TIMES = [0.5, 1.0]
LATER = [*TIMES, 1.5]


class Scene:
    """A problem, a series that has been kept, and a copy of its folder to be damaged."""

    def __init__(self, folder):
        self.driven = Driven(n=3, subdomains=2)
        self.comm = self.driven.problem.decomposition.comm
        self.kept, self.copy, self.path = folder / "kept", folder / "copy", folder / "series.bp"
        self.series(self.kept, TIMES).run()
        self.files = sorted(left_in(self.kept, self.comm))
        self.begin()
        self.expected = self.resume()

    def series(self, folder, times, path=True):
        path = self.path if path else None
        return tfeti.LoadSteps(
            self.driven.problem, self.driven.apply, times, path=path, checkpoint=folder
        )

    def begin(self):
        """Let the copy be whole."""
        self.on_one_rank(lambda: shutil.rmtree(self.copy, ignore_errors=True))
        self.on_one_rank(lambda: shutil.copytree(self.kept, self.copy))

    def on_one_rank(self, do):
        self.comm.barrier()
        if self.comm.rank == 0:
            do()
        self.comm.barrier()

    def resume(self):
        """Go on in the copy; times and displacement."""
        records = self.series(self.copy, LATER).run(resume=True)
        return [r.time for r in records], self.driven.problem.u.x.array.copy()

    def check(self, where):
        """Go on to the right answer, or not, and say why; on all ranks."""
        try:
            (times, u), said = self.resume(), ""
        except tfeti.InputError as error:
            said = str(error)
        assert len(set(self.comm.allgather(bool(said)))) == 1
        if said:
            assert where in said
        else:
            assert times == self.expected[0]
            assert np.array_equal(u, self.expected[1])
        return said


@pytest.fixture(scope="module")
def scene(tmp_path_factory, comm):
    return Scene(comm.bcast(tmp_path_factory.mktemp("checkpoints"), root=0))


def flipped(place):
    """Turn a bit of the byte at a share of the file."""

    def do(file):
        content = bytearray(file.read_bytes())
        content[int(place * (len(content) - 1))] ^= 4
        file.write_bytes(content)

    return do


def changed(file):
    """Write a valid file of other numbers."""
    if file.suffix == ".npz":
        with np.load(file) as found:
            np.savez(file, **{name: 1.01 * values for name, values in dict(found).items()})
    else:
        file.write_text(file.read_text().replace("0.5", "0.25").replace("1", "2"))


def folder_instead(file):
    file.unlink()
    file.mkdir()


def swapped(file):
    """What another file of the folder has."""
    others = sorted(f for f in file.parent.iterdir() if f.suffix == file.suffix and f != file)
    file.write_bytes(others[0].read_bytes() if others else b"{}")


WAYS = {
    "cut in half": lambda file: file.write_bytes(file.read_bytes()[: file.stat().st_size // 2]),
    "emptied": lambda file: file.write_bytes(b""),
    "a bit at the begin": flipped(0.0),
    "a bit in the middle": flipped(0.5),
    "missing": lambda file: file.unlink(),
    "a folder instead": folder_instead,
    "another file": swapped,
    "other numbers": changed,
    "more at the end": lambda file: file.write_bytes(file.read_bytes() + b"\nmore"),
}


@pytest.mark.parametrize("way", WAYS)
def test_what_is_damaged_is_named(scene, way):
    for name in scene.files:
        scene.begin()
        scene.on_one_rank(lambda name=name: WAYS[way](scene.copy / name))
        gone = name == "checkpoint.json" and way == "missing"
        said = scene.check("is a folder with other files" if gone else name)
        # of lines more are torn ones, and the end of the index is a line's
        assert said or (way, name) == ("more at the end", "records.jsonl")


def test_files_that_are_not_the_checkpoint_s_stay(scene, shared_tmp):
    """Also those whose names begin as its own."""
    for name in ("checkpoint.json.old", "state_1_0.npz"):
        folder = shared_tmp / name.replace(".", "_")
        scene.on_one_rank(folder.mkdir)
        scene.on_one_rank(lambda folder=folder, name=name: (folder / name).write_text("mine"))
        for resume in (False, True):
            with pytest.raises(tfeti.InputError, match=f"{folder.name} is a folder .* '{name}'"):
                scene.series(folder, TIMES).run(resume=resume)
        assert (folder / name).read_text() == "mine"
        assert len(list(folder.iterdir())) == 1


def test_files_put_into_a_checkpoint_s_folder_stay(scene):
    scene.begin()
    early, name = scene.series(scene.copy, LATER), "fields_9_0.npz"
    scene.on_one_rank(lambda: (scene.copy / name).write_text("mine"))
    before = left_in(scene.copy, scene.comm)
    with pytest.raises(tfeti.InputError, match=f"copy is a folder .* '{name}'"):
        scene.series(scene.copy, LATER)
    for resume in (False, True):
        with pytest.raises(tfeti.InputError, match=f"copy is a folder .* '{name}'"):
            early.run(resume=resume)
    assert left_in(scene.copy, scene.comm) == before


def test_a_series_that_begins_anew_replaces_what_is_there(scene):
    """All of it, of any number of steps."""
    scene.begin()
    scene.resume()
    scene.series(scene.copy, [0.25], path=False).run()
    names = set(left_in(scene.copy, scene.comm))
    states = {f"state_1_{rank}.npz" for rank in range(scene.comm.size)}
    assert names == {"checkpoint.json", "records.jsonl"} | states
    with pytest.raises(tfeti.InputError, match=r"no fields of step 1; expected path="):
        scene.series(scene.copy, [0.25, 0.5]).run(resume=True)
    assert set(left_in(scene.copy, scene.comm)) == names
    assert not list(scene.path.parent.glob(".*"))


def test_what_a_killed_run_has_left_goes(scene):
    """Names of the next step, and those that files have before they are whole."""
    scene.begin()
    left = ["state_3_0.npz", ".partial-fields_3_0.npz", ".partial-checkpoint.json", "state_1_0.npz"]
    for name in left:
        scene.on_one_rank(lambda name=name: (scene.copy / name).write_text("half"))
    assert not scene.check("")
    names = {name.replace("state_2", "state_3") for name in scene.files}
    names |= {f"fields_3_{rank}.npz" for rank in range(scene.comm.size)}
    assert set(left_in(scene.copy, scene.comm)) == names


def test_a_checkpoint_of_an_earlier_version_is_named(scene):
    def write():
        text = {"version": 3, "ranks": scene.comm.size, "number": 2, "records_length": 7}
        (scene.copy / "checkpoint.json").write_text(json.dumps(text))

    scene.begin()
    scene.on_one_rank(write)
    before = left_in(scene.copy, scene.comm)
    with pytest.raises(tfeti.InputError, match="copy is of an earlier version of the package"):
        scene.series(scene.copy, LATER)
    assert left_in(scene.copy, scene.comm) == before


def test_a_folder_that_another_run_has_is_refused(scene):
    """Two runs would take each other's files."""

    def apply(problem, t):
        scene.driven.apply(problem, t)
        scene.series(scene.copy, TIMES).run(resume=True)

    scene.begin()
    outer = tfeti.LoadSteps(scene.driven.problem, apply, LATER, checkpoint=scene.copy)
    with pytest.raises(tfeti.InputError, match="copy is in use by another run"):
        outer.run()
    scene.begin()
    assert not scene.check("")


@pytest.mark.parametrize("kept", [True, False])
def test_a_series_on_a_full_disk(scene, shared_tmp, kept):
    """What was there stays, what was done can be taken up."""
    driven, comm, folder = scene.driven, scene.comm, shared_tmp / "c" if kept else None
    path = shared_tmp / "series.bp"

    def apply(problem, t):
        driven.apply(problem, t)
        if t == 1.0 and full:
            fill(4000)

    def series(times):
        return tfeti.LoadSteps(driven.problem, apply, times, path=path, checkpoint=folder)

    full = False
    series([0.1]).run()
    before = left_in(path, comm)
    full = True
    try:
        with pytest.raises(tfeti.InputError, match="cannot write .*OSError: .*too large") as caught:
            series(TIMES).run()
    finally:
        clear()
    assert left_in(path, comm) == before or kept
    notes = " ".join(getattr(caught.value, "__notes__", []))
    if not kept:
        assert "the 1 steps before are in " in notes
        assert (path.parent / ".series.bp.partial" / "md.idx").stat().st_size == 128
        return
    full = False
    assert [r.time for r in series(LATER).run(resume=True)] == LATER
    assert np.allclose(driven.problem.u.x.array, scene.expected[1], rtol=0, atol=1e-6)


class Squeezed:
    """A block on another one in finite strain, whose equal meshes become unequal."""

    def __init__(self):
        d = stacked("triangle", 4, 4, 2)
        V, u, v, _ = unknowns(d)
        F = ufl.derivative(neo_hooke(u, 1.0, 0.0) * ufl.dx(degree=2), u, v)
        self.down, self.aside = fem.Constant(d.mesh, 0.0), fem.Constant(d.mesh, 0.0)
        moved = ("upper top", self.down), ("upper right", self.aside)
        bcs = held(d, *moved, "lower bottom", "lower left", "upper left")(V)
        contact = tfeti.Contact("upper bottom", "lower top", friction=tfeti.Coulomb(0.1))
        options = {"finite": True, "petsc_options": {"rtol": 1e-9}}
        self.problem = tfeti.NonlinearContactProblem(F, u, bcs, [contact], d, **options)

    def apply(self, problem, t):
        self.down.value, self.aside.value = -0.1 * t, -0.25 * t

    def series(self, times, folder, resume=False):
        steps = tfeti.LoadSteps(self.problem, self.apply, times, checkpoint=folder)
        steps.run(resume=resume)
        return self.problem


def test_sides_of_a_pair_are_kept_in_finite_strain(shared_tmp, comm):
    """Those of the bodies as they were: in a series, and where it goes on, as fast."""
    whole = Squeezed().series([0.5, 1.0, 1.5], shared_tmp / "whole")
    Squeezed().series([0.5, 1.0], shared_tmp / "parts")
    resumed = Squeezed().series([0.5, 1.0, 1.5], shared_tmp / "parts", resume=True)
    for problem in (whole, resumed):
        assert problem.solution.contacts[0].surfaces == ("upper bottom", "lower top")
    assert resumed.report.newton_steps == whole.report.newton_steps
    assert largest(resumed.u.x.array - whole.u.x.array) < 1e-8
