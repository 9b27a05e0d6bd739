"""One direction of flow: a module imports only from rooms that come before its own."""

import ast
import statistics
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "tfeti_dolfinx"

# the rooms in their order; those of one line may not import from each other
ROOMS = [
    ["errors", "arrays", "citations", "version"],
    ["checks", "compat", "parallel", "stages", "states", "timing"],
    ["described"],
    ["mesh"],
    ["mortar"],
    ["contact"],
    ["gluing"],
    ["qp"],
    ["subdomains"],
    ["boundary"],
    ["dual"],
    ["form_checks", "options", "report"],
    ["assembly", "elasticity", "option_parsing"],
    ["fields", "inertia"],
    ["contact_state", "discretisation", "friction_bounds", "interior", "point_values"],
    ["solution"],
    ["saved_state", "work"],
    ["refinement"],
    ["solver"],
    ["dilation"],
    ["newton_coulomb", "pressures"],
    ["coulomb"],
    ["report_filling", "doubts"],
    ["extensions"],
    ["boundary_elements"],
    ["system", "predictor"],
    ["estimates", "rounds", "stepping"],
    ["problem"],
    ["draw", "dynamics"],
    ["output", "plot"],
    ["checkpoint", "halving", "progress", "series"],
    ["load_steps"],
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
    assert len(path.read_text().splitlines()) <= 280


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


def functions(path):
    """Functions with a body of their own: name, lines of the body, arguments but for self."""
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.FunctionDef):
            continue
        body = node.body[1:] if ast.get_docstring(node) is not None else node.body
        if not body or isinstance(getattr(body[0], "value", None), ast.Constant):
            continue  # a protocol's
        arguments = [
            a.arg for a in [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        ]
        lines = body[-1].end_lineno - body[0].lineno + 1
        yield node.name, lines, len([a for a in arguments if a not in ("self", "cls")])


# what a user calls may have as many arguments as the user needs
DOORS = {"dynamics.py", "load_steps.py", "plot.py", "problem.py"}


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_functions_stay_small(path):
    for name, lines, arguments in functions(path):
        assert lines <= 60, name
        assert arguments <= 7 or path.name in DOORS, name


def test_most_functions_are_very_small():
    lines = [lines for path in modules() for _, lines, _ in functions(path)]
    assert statistics.median(lines) <= 7


def test_nothing_stands_twice():
    """No ten lines of code that follow each other, imports apart."""
    seen = {}
    for path in modules():
        lines = [line.strip() for line in path.read_text().splitlines()]
        code = [s for s in lines if s and not s.startswith(("import ", "from ", "#"))]
        for k in range(len(code) - 9):
            block = tuple(code[k : k + 10])
            assert block not in seen, f"{path.name} and {seen[block]}: {block[0]}"
            seen[block] = path.name


def test_imports_have_no_circle():
    names = {".".join(p.relative_to(PACKAGE.parent).with_suffix("").parts): p for p in modules()}
    imports = {
        name: {
            node.module
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.ImportFrom) and node.module in names
        }
        for name, path in names.items()
    }
    assert list(TopologicalSorter(imports).static_order())
