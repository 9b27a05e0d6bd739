"""Checkpoints: their folder is their own, and nothing that is damaged goes on."""

import json
import shutil

import numpy as np
import pytest
from full_disk import clear, fill, full, left_in
from sheared import Driven

import tfeti_dolfinx as tfeti

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


def rewritten(change):
    """Write a valid file of other contents."""

    def do(file):
        if file.suffix == ".npz":
            with np.load(file) as found:
                arrays = dict(found)
            np.savez(file, **{name: change(values) for name, values in arrays.items()})
        else:
            lines = file.read_text().replace("0.5", "0.25").replace("1", "2")
            file.write_text(lines)

    return do


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
    "zeros": lambda file: file.write_bytes(bytes(file.stat().st_size)),
    "a bit at the begin": flipped(0.0),
    "a bit on the way": flipped(0.1),
    "a bit in the middle": flipped(0.5),
    "a bit close to the end": flipped(0.98),
    "missing": lambda file: file.unlink(),
    "a folder instead": folder_instead,
    "another file": swapped,
    "other numbers": rewritten(lambda values: 1.01 * values),
    "other shapes": rewritten(lambda values: np.concatenate([np.ravel(values), [0.0]])),
    "another type": rewritten(lambda values: values.astype(np.float32)),
    "[]": lambda file: file.write_text("[]"),
    '{"version": 4}': lambda file: file.write_text('{"version": 4}'),
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


def test_a_scaled_displacement_in_a_valid_file_is_named(scene):
    def scale():
        file = scene.copy / "state_2_0.npz"
        with np.load(file) as found:
            arrays = dict(found)
        np.savez(file, **{**arrays, "u": 2 * arrays["u"]})

    scene.begin()
    scene.on_one_rank(scale)
    with pytest.raises(tfeti.InputError, match=r"state_2_0\.npz is damaged.*by the checksum"):
        scene.resume()


def test_an_older_state_in_the_place_of_a_newer_one_is_named(scene):
    """Both are whole: of the same program, on the same mesh."""
    scene.begin()
    scene.series(scene.copy, LATER).run(resume=True)
    last = scene.copy / f"state_3_{scene.comm.rank}.npz"
    shutil.copy(scene.kept / f"state_2_{scene.comm.rank}.npz", last)
    with pytest.raises(tfeti.InputError, match=r"state_3_\d\.npz is damaged"):
        scene.series(scene.copy, [*LATER, 2.0]).run(resume=True)


def test_files_that_are_not_the_checkpoint_s_stay(scene, shared_tmp):
    """Also those whose names begin as its own."""
    for name in (
        "state_of_my_thesis.txt",
        "fields_2024.csv",
        "checkpoint.json.old",
        "state_1_0.npz",
    ):
        folder = shared_tmp / name.replace(".", "_")
        scene.on_one_rank(folder.mkdir)
        scene.on_one_rank(lambda folder=folder, name=name: (folder / name).write_text("mine"))
        for resume in (False, True):
            with pytest.raises(tfeti.InputError, match=f"{folder.name} is a folder .* '{name}'"):
                scene.series(folder, TIMES).run(resume=resume)
        assert (folder / name).read_text() == "mine"
        assert len(list(folder.iterdir())) == 1


@pytest.mark.parametrize("name", ["state_of_my_thesis.txt", "fields_2024.csv", "fields_9_0.npz"])
def test_files_put_into_a_checkpoint_s_folder_stay(scene, name):
    scene.begin()
    early = scene.series(scene.copy, LATER)
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
    left = ["state_3_0.npz", "fields_3_0.npz.partial", "checkpoint.json.partial", "state_1_0.npz"]
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


def test_a_series_that_begins_anew_on_a_full_disk_leaves_what_is_there(scene):
    scene.begin()
    before = left_in(scene.copy, scene.comm)
    with full(0), pytest.raises(tfeti.InputError, match="copy: OSError: .*too large"):
        scene.series(scene.copy, TIMES).run()
    assert left_in(scene.copy, scene.comm) == before


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
