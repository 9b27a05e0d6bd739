"""What other programs are given and how they are judged; none of them has to be there."""

import importlib
import json

import numpy as np
import pytest

from benchmarks.error_scenes import SCENES
from benchmarks.peers import compare


@pytest.mark.parametrize("order", [1, 2])
def test_meshes_and_decks_are_those_of_the_scene(serial_only, tmp_path, monkeypatch, order):
    monkeypatch.syspath_prepend(str(compare.HERE))
    calculix = importlib.import_module("calculix_hertz")
    importlib.import_module("half_cylinder").mesh(4, order, tmp_path / "mesh.npz")
    data = np.load(tmp_path / "mesh.npz")
    x, cells = data["points"], data["cells"]
    assert np.allclose(np.linalg.norm(x[data["contact"]] - [0.0, 1.0], axis=2), 1.0, atol=1e-9)
    assert np.allclose(np.r_[x[data["top"], 1].ravel() - 1.0, x[data["axis"], 0].ravel()], 0.0)
    assert np.linalg.det(np.diff(x[cells[:, :3]], axis=1)).min() > 0.0  # counterclockwise
    for name in ("contact", "top"):
        cell, opposite = data[f"{name} cells"].T
        facets = np.column_stack((data[name][:, :2], cells[cell, opposite]))
        assert np.array_equal(np.sort(facets, axis=1), np.sort(cells[cell, :3], axis=1))
    deck = calculix.deck(data)
    loads = [line.split(",") for line in deck.split("*DLOAD\n")[1].splitlines() if ", P" in line]
    assert len(loads) == len(data["top"])
    ends = x[data["top"][:, :2]]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum()
    assert float(loads[0][2]) * length == pytest.approx(float(data["load"]))
    assert deck.count("\n*ELEMENT") == 2


def test_pressures_are_judged_at_equal_errors(serial_only, tmp_path, monkeypatch):
    """A program with the closed form's pressure, another with a tenth more of it on fine meshes."""
    monkeypatch.syspath_prepend(str(compare.HERE))
    scene, folder = SCENES["half cylinder"](), tmp_path / "peers"
    folder.mkdir()
    x = np.linspace(-0.06, 0.06, 4001)
    made = {"unknowns": 1, "F": 1, "steps": 1, "MB": 1.0}

    def put(name, content):
        (folder / f"{name}.json").write_text(json.dumps({**made, **content}))

    def ours(seconds, factor):
        return {"rows": [{**made, "seconds": seconds, "profile": (factor * scene.exact).tolist()}]}

    put("reference", ours(1.0, 1.0))
    exact = np.interp(x, scene.samples.points[:, 0], scene.exact)
    for size, error in ((6, 0.08), (12, 0.001)):
        put(f"1_{size}_{compare.NAME}", ours(size / 6, 1.0 + error))
        peer = {"program": "Peer", "seconds": 5.0 * size / 6, "points": x.tolist()}
        put(f"1_{size}_peer", {**peer, "values": (exact * (1.0 + error)).tolist()})
    put("2_6_peer", {"failed": "no convergence"})
    half_cylinder = importlib.import_module("half_cylinder").SCENE
    rows, equal = compare.write(half_cylinder, folder).values()
    assert [row["program"] for row in rows] == [compare.NAME] * 2 + ["Peer"] * 2
    assert [row["pressure"] for row in rows] == pytest.approx([0.08, 0.001] * 2, rel=0.02)
    assert equal[1]["1.0%"] == pytest.approx(5.0 * equal[0]["1.0%"], rel=0.01)
    assert (tmp_path / "peers.png").read_bytes().startswith(b"\x89PNG")


PRESSED = ("pressed_disc", 8, 4.0 * np.sin(np.pi / 16.0), 0.2527)
INDENTED = ("indentation", 4, 4.0, 3.445e-4)


@pytest.mark.parametrize(("name", "n", "area", "finest"), [PRESSED, INDENTED])
def test_a_peer_is_judged_by_its_force(serial_only, monkeypatch, tmp_path, name, n, area, finest):
    """A coarse mesh presses as hard as the finest of the page, but for 2 %."""
    monkeypatch.syspath_prepend(str(compare.HERE))
    scene, folder = importlib.import_module(name).SCENE, tmp_path / "peers"
    points, cells = scene.mesh(n)
    areas = np.linalg.det(np.diff(points[cells], axis=1)) / 2
    assert areas.min() > 0.0
    assert areas.sum() == pytest.approx(area)
    found = scene.prepare(compare.NAME, n, None)()
    assert found["force"] == pytest.approx(finest, rel=0.02)
    folder.mkdir()
    for program, off in zip((compare.NAME, "GetFEM"), (-1e-5, 1e-5), strict=True):
        made = {"program": program, **found, "seconds": len(program), "MB": 1.0}
        finer = {"seconds": 9 * len(program), "force": finest * (1.0 + off)}
        for size, row in ((n, made), (2 * n, {**made, **finer})):
            (folder / f"{name}_{size}_{program}.json").write_text(json.dumps(row))
    rows, table = compare.write(scene, folder).values()
    assert [row["error"] for row in rows[2:]] == pytest.approx([1e-5, 1e-5], rel=1e-3)
    seconds = [row["0.1%"] for row in table]
    assert seconds[0] / seconds[1] == pytest.approx(len(compare.NAME) / len("GetFEM"))
