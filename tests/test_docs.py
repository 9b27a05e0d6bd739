"""Documents: every program and every command in them runs, and nothing they name is missing."""

import ast
import dataclasses
import inspect
import os
import pydoc
import re
import shlex
import shutil
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from quick_demos import alone, process

import tfeti_dolfinx as tfeti

ROOT = Path(__file__).resolve().parents[1]
MADE = ("examples", "api")  # folders that Sphinx fills
PAGES_OF_DOCS = [p for p in sorted((ROOT / "docs").rglob("*.md")) if p.parent.name not in MADE]
DOCUMENTS = [ROOT / "README.md", *PAGES_OF_DOCS]
FOR_DEVELOPERS = ("developers/", "theory", "notation", "validation", "api")


def for_users(path):
    """Whether a page is read by users; API and theory are counted apart."""
    return not str(path.relative_to(ROOT)).removeprefix("docs/").startswith(FOR_DEVELOPERS)


USER_PAGES = [path for path in DOCUMENTS if for_users(path)]


def blocks(path, language):
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text(), re.DOTALL | re.MULTILINE)


def commands():
    """Commands of the README, without ./run: the tests are inside already."""
    return re.findall(r"^\./run (?!.*pytest)(.*)$", "".join(blocks(ROOT / "README.md", "sh")), re.M)


def run_elsewhere(command, folder):
    """Outside of the tree, so that nothing is written into it; its program stands there alone."""
    kind, name = re.search(r"(demos|meshes)/(\w+)\.py", command).groups()
    _, environment = alone(name, folder / kind, kind)
    process(shlex.split(command), folder, environment, 500)


@pytest.mark.parametrize("command", [line for line in commands() if "--plot" not in line])
def test_commands_of_the_readme(serial_only, command, tmp_path):
    run_elsewhere(command, tmp_path)
    assert "results" not in command or list((tmp_path / "results").iterdir())


def test_the_main_job_leaves_pictures(serial_only, tmp_path):
    (command,) = (line for line in commands() if "--plot" in line)
    run_elsewhere(command, tmp_path)
    names = {p.name for p in (tmp_path / "results").iterdir()}
    assert names == {"hertz_2d.png", "hertz_2d_contact.png", "hertz_2d_pressure.png"}


PAGES = ("tutorial", "two_bodies", "rigid_tools", "load_steps", "dynamics", "nonlinear")
PROGRAMS = ["README.md", *(f"docs/{name}.md" for name in PAGES)]
ON_TWO = ("README.md", "docs/load_steps.md")


@pytest.fixture(scope="module")
def half_cylinder(serial_only, tmp_path_factory):
    path = tmp_path_factory.mktemp("mesh") / "half_cylinder.msh"
    process([sys.executable, ROOT / "meshes/half_cylinder.py", path], path.parent)
    return path


@pytest.mark.parametrize(("document", "ranks"), [(name, 1 + (name in ON_TWO)) for name in PROGRAMS])
def test_programs_of_documents(half_cylinder, document, ranks, tmp_path):
    program = tmp_path / "program.py"
    program.write_text("\n".join(blocks(ROOT / document, "python")))
    (tmp_path / "results").mkdir()
    shutil.copy(half_cylinder, tmp_path / "results")
    said = process(["mpirun", "-n", ranks, sys.executable, program], tmp_path)
    assert "unknowns" in said
    assert "CONVERGED_RTOL" in said


def with_programs():
    """User pages with a program that starts a solve, but for those that need processes."""
    for path in USER_PAGES:
        name = str(path.relative_to(ROOT))
        if name not in PROGRAMS and blocks(path, "python"):
            yield name


def run_program(text, name):
    exec(compile(text, name, "exec"), {"__name__": "__main__"})


@pytest.fixture
def own_folder(serial_only, tmp_path, monkeypatch):
    """A folder for what programs write, and no arguments for them."""
    (tmp_path / "results").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["program.py"])


@pytest.mark.parametrize("document", list(with_programs()))
def test_programs_of_user_pages(own_folder, document):
    run_program("\n".join(blocks(ROOT / document, "python")), document)


CONVERTED = ROOT / "docs/howto/linear_problem.md"


@pytest.mark.parametrize("program", range(2), ids=["2D", "3D"])
def test_a_linear_problem_becomes_contact_in_nine_lines(own_folder, program):
    lines = blocks(CONVERTED, "diff")[program].splitlines()
    assert sum(line[:1] in ("+", "-") and len(line) > 1 for line in lines) <= 9
    before, after = ("\n".join(line[1:] for line in lines if line[:1] != other) for other in "+-")
    compile(before, "before", "exec")
    run_program(after + "\nassert problem.solution.contact().force.sum() > 0.0", "after")


# commands of pages that no test here starts, and why
NOT_RUN = {
    "python3 -m venv ": "the package is built by test_the_wheel_has_what_it_needs",
    "venv/bin/python -m pip install ": "the same; the wheel of DOLFINx is a download of 1.3 GB",
    "export LD_LIBRARY_PATH=": "of that wheel",
    "conda env create -f environment/": "conda-forge is not within reach of the tests",
    "docker build -f environment/": "a daemon is not, either",
    "mpirun -n 2 python demos/": "of that wheel; tests/test_demos.py runs the demo",
    "./run python3 -m benchmarks.stress": "tests/test_stress.py runs a few scenes",
    "./run python3 benchmarks/": "tests/test_benchmarks.py runs the quick sizes",
    "./run python3 -m pytest": "these tests; .ci/run starts them so",
    "./run python3 docs/pictures.py": "the demos at their default sizes; minutes",
    "./run python3 -m sphinx ": ".ci/run builds the documents, with -W",
}
DIRECTIVES = ("{toctree}", "{eval-rst}", "{include}")


def test_every_block_of_a_page_is_run_or_has_a_reason():
    """A block of no language is a drawing."""
    run = {f"./run {line}" for line in commands()}
    for path in [*DOCUMENTS, ROOT / "CONTRIBUTING.md", ROOT / "environment/README.md"]:
        for language, text in re.findall(r"^```(\S*)\n(.*?)^```", path.read_text(), re.S | re.M):
            known = language in (*DIRECTIVES, "python", "", "diff" if path == CONVERTED else "")
            sample = (language, path.name) == ("text", "report.md")  # tests/test_figures.py
            lines = [] if known or sample else text.splitlines()
            assert not [s for s in lines if s not in run and not s.startswith(tuple(NOT_RUN))], path


def prose(path):
    """A page, but for tables that a benchmark or the code makes, and programs."""
    text = re.sub(r"^```.*?^```", "", path.read_text(), flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"<!-- .*?<!-- end -->", "", text, flags=re.DOTALL)


# what users read as constraints, iterations, active sets, expensive, instead of, compared with
UNSAID = re.compile(
    r"\b(multiplications?|rows?|faces?(?! (away|each|them|it)\b)|dear(er)?|prices?|scenes?|hats?"
    r"|given (bounds?|friction)|(in|takes?) the place of|asks? for|the begin|about so many|beside"
    r"|as ever|likewise|just if|right to|so many|nobody|excludes? each other)\b"
)


def strings_of(path):
    """The texts of a module with a blank in them: messages, helps of options; no docstrings."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    apart = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    found = [n for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str)]
    return "\n".join(node.value for node in found if " " in node.value and id(node) not in apart)


def public_docstrings(names):
    """Docstrings of classes and functions, and of the members of the former."""
    for thing in (pydoc.locate(name if "." in name else f"tfeti_dolfinx.{name}") for name in names):
        members = vars(thing).items() if inspect.isclass(thing) else ()
        shown = [member for name, member in members if not name.startswith("_")]
        yield from (inspect.getdoc(found) or "" for found in (thing, *shown))


def test_what_users_read_has_their_words():
    texts = [prose(path) for path in USER_PAGES]
    core = (ROOT / "tfeti_dolfinx").rglob("*.py")
    texts += [strings_of(path) for path in core if path.name != "testing.py"]
    for demo in (ROOT / "demos").glob("*.py"):  # the site has their texts
        texts += re.findall(r"^ *# .*$", demo.read_text(), re.MULTILINE)
    for_users = (ROOT / "docs/api.md").read_text().partition("## To extend")[0]
    texts += public_docstrings(set(re.findall(r"auto\w+:: ([\w.]+)", for_users)))
    texts = [re.sub(r"`[^`]*`", "", text) for text in texts]
    assert not [line for text in texts for line in text.splitlines() if UNSAID.search(line)]


def test_user_pages_are_short():
    assert sum(len(prose(path).split()) for path in USER_PAGES) <= 15000
    assert len(ast.parse(blocks(ROOT / "README.md", "python")[0]).body) <= 12
    bounds = dict.fromkeys((ROOT / "docs/howto").glob("*.md"), 400)
    bounds |= {ROOT / f"docs/{name}.md": 800 for name in PAGES[:4]}  # tutorials
    assert not [path for path, words in bounds.items() if len(prose(path).split()) > words]


@pytest.mark.parametrize(
    ("folder", "page"), [("demos", "gallery"), ("benchmarks", "developers/benchmarks")]
)
def test_a_page_lists_all_programs(folder, page):
    files = (ROOT / folder).glob("*.py")
    starts = re.compile(r"^(def main\(|# # )", re.MULTILINE)
    programs = [p.name for p in files if starts.search(p.read_text())]
    assert len(programs) > 10
    text = (ROOT / f"docs/{page}.md").read_text()
    assert not [name for name in programs if f"`{name}`" not in text]


def test_documents_name_what_is_in_the_code():
    files = [f"/{p.relative_to(ROOT)}" for p in ROOT.rglob("*.py")]
    for page in (ROOT / "CONTRIBUTING.md", *DOCUMENTS):
        named = re.findall(r"`([\w/]+\.py)`", page.read_text())
        assert not [n for n in named if not any(f.endswith(f"/{n}") for f in files)], page
    code = "\n".join(p.read_text() for p in (ROOT / "tfeti_dolfinx").rglob("*.py"))
    for folder in ("demos", "benchmarks"):
        code += "\n".join(p.read_text() for p in (ROOT / folder).glob("*.py"))
    rows = (ROOT / "docs/notation.md").read_text().splitlines()
    names = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert len(names) > 30
    missing = [name for name in names if not re.search(rf"\b{name}\b", code)]
    assert not missing


def test_ci_runs_the_readme_s_test_command():
    (command,) = re.findall(r"^.*pytest.*$", "".join(blocks(ROOT / "README.md", "sh")), re.M)
    for line in (command, command.replace("./run", "./run mpirun -n 2")):  # for a time, no input
        assert re.search(rf"^ *limit .*{re.escape(line)}$", (ROOT / ".ci/run").read_text(), re.M)


def test_the_wheel_has_what_it_needs(serial_only, tmp_path):
    """It has every file of the package, says what it is, and is imported from where it lies."""
    setuptools = pytest.importorskip("setuptools")
    if int(setuptools.__version__.split(".")[0]) < 77:
        pytest.skip("pyproject.toml asks for setuptools >= 77")
    source = tmp_path / "source"
    unseen = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "tfeti_dolfinx", source / "tfeti_dolfinx", ignore=unseen)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--quiet"]
    process([*command, "--wheel-dir", tmp_path, source], tmp_path)
    (wheel,) = tmp_path.glob("tfeti_dolfinx-*-py3-none-any.whl")
    with zipfile.ZipFile(wheel) as packed:
        names = set(packed.namelist())
        (metadata,) = (name for name in names if name.endswith(".dist-info/METADATA"))
        said = packed.read(metadata).decode()
    package = [path for path in (source / "tfeti_dolfinx").rglob("*") if path.is_file()]
    own = {name for name in names if ".dist-info/" not in name}
    assert own == {str(path.relative_to(source)) for path in package}
    assert "tfeti_dolfinx/py.typed" in own
    assert "License-Expression: MIT\n" in said
    assert f"Version: {tfeti.__version__}\n" in said
    code = "import tfeti_dolfinx; print(tfeti_dolfinx.__file__, tfeti_dolfinx.__version__)"
    environment = {**os.environ, "PYTHONPATH": str(wheel)}
    assert str(wheel) in process([sys.executable, "-c", code], tmp_path, environment)


def test_one_version_and_its_dependencies():
    citation = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    changes = re.search(r"^## \[(.*?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    recipe = re.search(r'version: "(.*?)"', (ROOT / "environment/conda/recipe.yaml").read_text())
    assert citation[1] == changes[1] == recipe[1] == tfeti.__version__
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    for path in (ROOT / "environment/conda").iterdir():
        text = path.read_text().replace(" >=", ">=")
        assert not [package for package in needed if f"- {package}\n" not in text], path


def test_the_report_s_fields_are_documented():
    pages = ("docs/report.md", "docs/developers/report.md")
    text = "".join((ROOT / page).read_text() for page in pages)
    for field in dataclasses.fields(tfeti.Report):
        assert f"`{field.name}`" in text, field.name


def test_every_page_and_every_public_name_is_in_the_documents():
    docs = ROOT / "docs"
    api, seen, waiting = (docs / "api.md").read_text(), set(), [docs / "index.md"]
    while waiting:  # what tables of contents reach
        page = waiting.pop()
        seen.add(page)
        for entry in "\n".join(blocks(page, "{toctree}")).splitlines():
            target = re.sub(r"^.* <(.*)>$", r"\1", entry)
            path = (page.parent / f"{target}.md").resolve()
            if entry and not entry.startswith(":"):
                assert path.exists(), f"{page.name}: {entry}"
                waiting.append(path)
    others = ("CONTRIBUTING.md", "CHANGELOG.md", "environment/README.md")
    assert {*DOCUMENTS, *(ROOT / name for name in others)} <= seen
    described = set(re.findall(r"^\.\. auto\w+:: (?:\w+\.)*(\w+)$", api, re.MULTILINE))
    assert set(tfeti.__all__) - {"__version__"} <= described
