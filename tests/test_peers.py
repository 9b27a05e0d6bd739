"""What other programs are given and how they are judged; none of them has to be there."""

import importlib
import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.error_scenes import SCENES
from benchmarks.peers import meshes, tables

PEERS = Path(__file__).resolve().parents[1] / "benchmarks" / "peers"


@pytest.fixture
def calculix(monkeypatch):
    monkeypatch.syspath_prepend(str(PEERS))
    return importlib.import_module("calculix_hertz")


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(("scene", "size"), [("half cylinder", 4), ("half ball", 2)])
def test_meshes_and_decks_are_those_of_the_scene(
    serial_only, tmp_path, calculix, scene, size, order
):
    file = tmp_path / "mesh.npz"
    meshes.main([scene, str(size), str(order), str(file)])
    data = np.load(file)
    x, cells, contact = data["points"], data["cells"], data["contact"]
    centre = np.append(np.zeros(x.shape[1] - 1), 1.0)
    assert np.allclose(np.linalg.norm(x[contact] - centre, axis=2), 1.0, atol=1e-9)
    assert np.allclose(x[data["top"], -1], 1.0)
    for name in ("contact", "top"):
        cell, opposite = data[f"{name} cells"].T
        corners = np.sort(cells[cell, : x.shape[1] + 1], axis=1)
        facets = np.column_stack((data[name][:, : x.shape[1]], cells[cell, opposite]))
        assert np.array_equal(np.sort(facets, axis=1), corners)
    deck = calculix.deck(data, "SURFACE TO SURFACE", 1e3)
    loads = [line.split(",") for line in deck.split("*DLOAD\n")[1].splitlines() if ", P" in line]
    total = len(loads) * float(loads[0][2]) * calculix.area(x, data["top"]) / len(data["top"])
    assert total == pytest.approx(float(data["load"]))
    assert deck.count("\n*ELEMENT") == 2


def test_pressures_are_judged_at_equal_errors(tmp_path):
    """A program with the closed form's pressure, another with a tenth more of it on fine meshes."""
    scene, folder = SCENES["half cylinder"](), tmp_path / "peers"
    folder.mkdir()
    x = np.linspace(-0.06, 0.06, 4001)[:, None]
    made = {"unknowns": 1, "F": 1, "steps": 1, "MB": 1.0}

    def write(name, content):
        (folder / f"half_cylinder_{name}.json").write_text(json.dumps({**made, **content}))

    def ours(seconds, factor):
        row = {**made, "seconds": seconds, "profile": (factor * scene.exact).tolist()}
        return {"rows": [row]}

    write("reference", ours(1.0, 1.0))
    exact = np.interp(x[:, 0], scene.samples.points[:, 0], scene.exact)
    for size, error in ((6, 0.08), (12, 0.001)):
        write(f"1_{size}_ours", ours(size / 6, 1.0 + error))
        peer = {"program": "Peer", "seconds": 5.0 * size / 6, "points": x.tolist()}
        write(f"1_{size}_peer", {**peer, "values": (exact * (1.0 + error)).tolist()})
    write("2_6_peer", {"failed": "no convergence"})
    found = tables.main([str(folder)])
    rows, equal = found["half cylinder"], found["half cylinder, equal errors"]
    assert [row["program"] for row in rows] == ["tfeti_dolfinx"] * 2 + ["Peer"] * 2
    assert [row["pressure"] for row in rows] == pytest.approx([0.08, 0.001] * 2, rel=0.02)
    assert equal[1]["over ours, 1.0%"] == pytest.approx(5.0, rel=0.01)
    assert (tmp_path / "peers.png").read_bytes().startswith(b"\x89PNG")
