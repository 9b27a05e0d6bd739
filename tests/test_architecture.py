"""One direction of flow: a module imports only from rooms that come before its own."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "tfeti_dolfinx"

# the rooms in their order; those of one line may not import from each other
ROOMS = [
    ["errors", "arrays", "citations", "version"],
    ["checks", "compat", "parallel", "timing"],
    ["mesh"],
    ["mortar"],
    ["contact"],
    ["gluing"],
    ["qp"],
    ["subdomains"],
    ["dual"],
    ["form_checks", "options", "report"],
    ["assembly", "elasticity"],
    ["fields"],
    ["solution"],
    ["report_filling", "solver"],
    ["problem"],
    ["draw"],
    ["output", "plot"],
]
PLACE = {room: place for place, rooms in enumerate(ROOMS) for room in rooms}
# the QP solvers know nothing of meshes and rows, the Blocks nothing of rows
APART = {(own, room) for own in ("qp", "subdomains") for room in ("mortar", "contact", "gluing")}
APART.add(("qp", "mesh"))


def modules():
    return sorted(p for p in PACKAGE.rglob("*.py") if p.parent != PACKAGE or p.stem != "__init__")


def room_of(path):
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_rooms(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tfeti_dolfinx."):
            yield node.module.split(".")[1]


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_one_way(path):
    own = room_of(path)
    for room in imported_rooms(path):
        assert room == own or PLACE[room] < PLACE[own], f"{own} imports {room}"
        assert (own, room) not in APART, f"{own} must not know {room}"


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_files_stay_small(path):
    assert len(path.read_text().splitlines()) <= 283


def test_only_compat_knows_versions():
    for path in modules():
        if path.stem != "compat":
            text = path.read_text()
            assert "dolfinx.__version__" not in text
            assert "gmshio" not in text


def test_only_plot_knows_pyvista():
    for path in modules():
        if path.stem not in ("plot", "draw"):
            assert "pyvista" not in path.read_text()
