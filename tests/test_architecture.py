"""One direction of flow: a module imports only from rooms that come before its own."""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("serial_only")

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "tfeti_dolfinx"

# the rooms in their order; those of one line may not import from each other
ROOMS = [
    ["errors"],
    ["common"],
    ["mesh"],
    ["forms"],
    ["mortar"],
    ["contact"],
    ["qp"],
    ["constraints"],
    ["subdomains"],
    ["feti"],
    ["options", "testing"],
    ["solve"],
    ["extensions"],
    ["solution"],
    ["report", "saved_state"],
    ["settings"],
    ["system", "io"],
    ["accuracy"],
    ["problem"],
    ["nonlinear"],
    ["steps"],
    # optional: nothing imports them but by their names in extensions.PLUGINS
    ["bem", "clusters"],
]
PLACE = {room: place for place, rooms in enumerate(ROOMS) for room in rooms}
# the QP solvers know nothing of meshes and rows, the Blocks nothing of rows
APART = {(a, b) for a in ("qp", "subdomains") for b in ("mortar", "contact", "constraints")}
APART.add(("qp", "mesh"))
# words that a single module may use: what differs between versions, and a heavy library
ALONE = {
    "dolfinx.__version__": {"compat"},
    "gmshio": {"compat"},
    "import pyvista": {"plot", "draw"},
}
# what DOLFINx 0.11 warns of: programs of ours use compat's functions, too
OLD = ("geometry.dofmap", ".cmap")
# docstrings open with an imperative, or with a noun that names the concept
ODD = {"What", "Whether", "Where", "Which", "How", "Why", "Of", "As", "That", "Who", "When"}
PROGRAMS = ("benchmarks", "demos", "meshes", "tests")


def modules():
    return sorted(p for p in PACKAGE.rglob("*.py") if p.parent != PACKAGE or p.stem != "__init__")


def imported_rooms(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tfeti_dolfinx."):
            yield node.module.split(".")[1]


def test_imports_go_one_way():
    wrong = []
    for path in modules():
        own = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        for room in imported_rooms(path):
            if room != own and (PLACE[room] >= PLACE[own] or (own, room) in APART):
                wrong.append(f"{path.relative_to(PACKAGE)} imports {room}")
    assert not wrong
    names = {".".join(p.relative_to(PACKAGE.parent).with_suffix("").parts): p for p in modules()}
    imports = {
        name: {
            node.module
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.ImportFrom) and node.module in names
        }
        for name, path in names.items()
    }
    assert list(TopologicalSorter(imports).static_order())  # raises where there is a circle


def test_what_one_module_alone_may_know():
    texts = {path: path.read_text() for path in modules()}
    wrong = [
        f"{path.relative_to(PACKAGE)} knows {word}"
        for word, rooms in ALONE.items()
        for path, text in texts.items()
        if word in text and path.stem not in rooms
    ]
    programs = [path for folder in PROGRAMS for path in (ROOT / folder).rglob("*.py")]
    others = [p for p in [*modules(), *programs] if p.stem not in ("compat", Path(__file__).stem)]
    wrong += [f"{p.name} uses {word}" for p in others for word in OLD if word in p.read_text()]
    assert not wrong


def test_nothing_stands_twice():
    """No ten lines of code that follow each other, imports apart."""
    seen = {}
    for path in modules():
        text = re.sub(r"^from \S+ import \([^)]*\)$", "", path.read_text(), flags=re.MULTILINE)
        lines = [line.strip() for line in text.splitlines()]
        code = [s for s in lines if s and not s.startswith(("import ", "from ", "#"))]
        for k in range(len(code) - 9):
            block = tuple(code[k : k + 10])
            assert block not in seen, f"{path.name} and {seen[block]}: {block[0]}"
            seen[block] = path.name


def test_no_docstring_opens_with_a_relative_clause():
    odd = [
        f"{path.relative_to(PACKAGE)}: {text.splitlines()[0]}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        if (text := ast.get_docstring(node)) and text.split(maxsplit=1)[0] in ODD
    ]
    assert not odd


def test_class_names_are_unique():
    names = [
        node.name
        for path in modules()
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef)
    ]
    assert len(names) == len(set(names))
