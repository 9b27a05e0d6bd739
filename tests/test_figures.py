"""Figures of user pages: each is the code's, a table's, or that of a run; the others are given."""

import inspect
import re
from functools import partial

import dolfinx
import numpy as np
import pytest
from petsc4py import PETSc
from test_docs import DOCUMENTS, ROOT, USER_PAGES, prose

import demos
import tfeti_dolfinx as tfeti
from benchmarks.stability_scenes import MODULI, UNITS
from tfeti_dolfinx.accuracy import WarningLimits
from tfeti_dolfinx.bem.steklov import StiffnessTolerances
from tfeti_dolfinx.feti.dual import DualLimits
from tfeti_dolfinx.mesh.partition import UNKNOWNS
from tfeti_dolfinx.mortar.tolerances import SearchTolerances

HALVINGS = inspect.signature(tfeti.LoadSteps).parameters["max_halvings"].default
EDGE = 2.0 * np.degrees(np.arccos(SearchTolerances.edge))
TURNS, FLAT = WarningLimits.turns, 2 * WarningLimits.flat
PETSC = PETSc.Sys.getVersion()
LENGTHS, PRESSURES = zip(*UNITS[1:], strict=True)


def of_contact(column):
    """What contact by block Newton has in a column of the price of contact: least and most."""
    text = (ROOT / "docs/developers/performance.md").read_text()
    tables = re.findall(r"^<!-- linear_price: .*? -->\n(.*?)^<!-- end -->", text, re.S | re.M)
    rows = [[cell.strip() for cell in row.split("|")] for row in "".join(tables).splitlines()]
    cube, ball = (float(row[1:-1][column]) for row in rows if row[1:2] == ["contact, newton"])
    return [round(found, 1) for found in sorted((cube, ball))]


SECONDS, OF_GAMG = (partial(of_contact, column) for column in (5, -2))
PRICE = (r"costs (\S+) to (\S+) times as much as a linear solve by multigrid", OF_GAMG)
TAKES = (r"quarter of a million unknowns with contact\s+take (\S+) to (\S+) s", SECONDS)


def rubber_depth():
    text = (ROOT / "demos/rubber_pressed_3d.py").read_text()
    return [100 * float(depth) for depth in re.findall(r"^depths = (\S+) \* R", text, re.M)]


def of_test(name, pattern):
    """Return the bounds that the assertions of a test have."""
    found = re.finditer(pattern, (ROOT / f"tests/test_{name}.py").read_text())
    return [float(number) for match in found for number in match.groups()]


ABOVE = of_test("duality_gap", r"algebraic <= (\S+) \* error")
REPORTED = of_test("duality_gap", r"size [<>]= (\S+) \* (?:error|found)")
ESTIMATED = of_test("discretisation", r"assert (\S+) <= index\(p, error\) <= (\S+)")
NOTES_ON_ERRORS = "docs/developers/accuracy"
SAG = pytest.approx(9 / 80, abs=0.005)
OF_CODE_AND_TABLES = [
    ("README", *PRICE),
    ("README", *TAKES),
    ("docs/guide/speed", *PRICE),
    ("docs/load_steps", r"kept, up to (\d+) of them", [DualLimits.recycled]),
    ("docs/dynamics", r"kept, (\d+) of them", [DualLimits.recycled]),
    ("docs/developers/options", r"auto: (\d+) from the second solve", [DualLimits.recycled]),
    ("docs/load_steps", r"`max_halvings` \((\d+)\)", [HALVINGS]),
    ("docs/tutorial", r"`reach` \((\d+) % of", [100 * SearchTolerances.reach]),
    ("docs/boundary_elements", r"wrong by more than (\d+) %", [100 * StiffnessTolerances.wrong]),
    ("docs/guide/speed", r"`decompose` takes about (\d+) unknowns", [UNKNOWNS]),
    ("docs/howto/ranks", r"gets about (\d+) unknowns", [UNKNOWNS]),
    ("docs/guide/hard", r"reverse, up to 1 : (\S+) ", [MODULI[-1]]),
    ("docs/guide/hard", r"units from (\S+) m to (\S+) m", [min(LENGTHS), max(LENGTHS)]),
    ("docs/guide/hard", r"and from (\S+) Pa to (\S+) Pa", [min(PRESSURES), max(PRESSURES)]),
    ("docs/guide/hard", r"for strain: (\S+) % at (\S+) ", [100 * TURNS**2 / 2, TURNS]),
    ("docs/guide/hard", r"more than about (\d+): forces", [FLAT]),
    ("docs/guide/mesh", r"From about 1 : (\d+) on", [FLAT]),
    ("docs/two_bodies", r"more than some (\d+) degrees", [pytest.approx(EDGE, abs=2.0)]),
    ("docs/two_bodies", r"elements of size 3 lie (\S+) off", [SAG]),
    ("docs/developers/stability", r"for strain: (\S+) % at (\S+) ", [100 * TURNS**2 / 2, TURNS]),
    (NOTES_ON_ERRORS, r"at most (\d+) times it", ABOVE),
    (NOTES_ON_ERRORS, r"least (\S+) times the error, .*? at most (\d+) times", REPORTED),
    (NOTES_ON_ERRORS, r"(\S+) to (\S+) times the true error", ESTIMATED[:2]),
    (NOTES_ON_ERRORS, r"quadrilaterals: (\S+) to (\S+) times", ESTIMATED[2:]),
    ("docs/gallery", r"rubber pressed by (\d+) % of", rubber_depth),
]
# of a demo at its default size: what bounds the errors whose names have these words
OF_RUNS = [
    ("docs/boundary_elements", "tbeti_hertz_2d", r"pressure is within (\S+) % of", "peak_pressure"),
    ("docs/dynamics", "bouncing_bar", r"mean pressures are within (\S+) % ", ""),
    ("docs/dynamics", "impact_of_bars", r": pressures are within (\S+) %", "pressure"),
    ("docs/dynamics", "impact_of_bars", r"by less than (\S+) %", "oscillates"),
]
SLOW = [pytest.param(*run, marks=pytest.mark.slow) for run in OF_RUNS[1:]]


def page(name):
    return (ROOT / f"{name}.md").read_text()


@pytest.mark.parametrize(("name", "pattern", "values"), OF_CODE_AND_TABLES)
def test_a_page_says_what_the_code_or_a_table_has(name, pattern, values):
    (said,) = re.findall(pattern, page(name))
    said = [float(number) for number in ([said] if isinstance(said, str) else said)]
    values = values() if callable(values) else values
    assert said == [pytest.approx(v) if isinstance(v, float) else v for v in values]


@pytest.mark.parametrize(("name", "demo", "pattern", "word"), [OF_RUNS[0], *SLOW])
def test_a_page_says_what_a_demo_finds(name, demo, pattern, word):
    (percent,) = re.findall(pattern, page(name))
    errors = {key: error for key, error in demos.run(demo)[1].errors.items() if word in key}
    assert errors
    assert all(abs(error) <= float(percent) / 100 for error in errors.values()), errors


def test_iterations_are_as_pages_say(serial_only):
    """Nearly constant from 8 to 64 subdomains of a size; several times as many with smalse."""
    for name, words in (
        ("README", "stay nearly constant"),
        ("docs/guide/speed", "nearly constant"),
    ):
        assert words in page(name)
    assert "`smalse` takes several times as many iterations" in page("docs/guide/speed")
    few, many, smalse = (
        demos.run("cube_3d", ["--subdomains", number, "--cells", 4, *more])[1].F_multiplications
        for number, more in ((8, []), (64, []), (8, ["-tfeti_qp_type", "smalse"]))
    )
    assert many <= 1.2 * few
    assert smalse >= 3 * few


def test_versions_of_the_readme_are_those_that_run():
    major, minor, *_ = PETSC
    row = re.search(
        rf"^\| {'.'.join(dolfinx.__version__.split('.')[:2])} \| (.*?) \|", page("README"), re.M
    )
    assert row is not None
    assert row[1] == f"{major}.{minor}"


def test_the_sample_of_a_report_is_what_a_demo_prints(quick_demo, serial_only):
    """Lines and words alike; counts within 5 %, iterations within 5: each gmsh has its own mesh."""
    (sample,) = re.findall(r"^```text\n(.*?)^```", page("docs/report"), re.DOTALL | re.MULTILINE)
    said, printed = (
        re.sub(r"\n {12}", " ", text).splitlines()
        for text in (sample, quick_demo("cylinder_on_block_2d").out)
    )
    printed = printed[printed.index(said[0]) :]
    for k, within in enumerate(({"rel": 0.05}, {"rel": 0.05}, {}, {"abs": 5}), 1):
        words = [re.sub(r"-?\d[\d.]*(e[-+]\d+)?", "#", lines[k]) for lines in (said, printed)]
        assert words[0] == words[1]
        counts = [re.findall(r"\d+(?= [a-z])", lines[k]) for lines in (said, printed)]
        assert [int(n) for n in counts[0]] == pytest.approx([int(n) for n in counts[1]], **within)
    assert printed[5].startswith("  time ")
    for pattern in (r"force \(\S+, (\S+)\)", r"pressure up to (\S+),"):
        numbers = [float(re.search(pattern, lines[2])[1]) for lines in (said, printed)]
        assert numbers[0] == pytest.approx(numbers[1], rel=0.01)


# what is no figure: names, dimensions, status and codes, what a page gives to a program or states
GIVEN = [
    *(f"{a} {b}" for a, b in re.findall(r"([\w-]+)==(\S+)\b", (ROOT / ".ci/run").read_text())),
    r"\w+ [\d.]+ (?=does not import|wants)|setuptools ≥ 77|\w+4dolfinx|h5py",
    r"\b[1-3]D\b",
    r"[Dd]egrees? [12](?: and 2)?\b",
    r"DOLFINx(?: ≥)? 0\.\d+",
    r"(Debian 1|Ubuntu 26.0)\d( or 13)?",
    r"^\| 0\.\d+ \|.*$",
    r"\bb[₀12]\b|h²/8R|2πr|x\[0\]|u_r = 0|73, 2008|CB1|SSNV506|ADIOS2|rtol 1e-8|below 1\.",
    r"200/√2|200 down|radius 10|size (?:0\.5|3)|down by 0\.1|^of 0\.05|near(?: to)? 0\.5",
    r"\b(tag|rank) \d",
    r"body 0\b",
    r"`` 2 in gmsh",
    r"\(`` 2\)",
    r"\(0 no contact .*$",
    r"(?:: |is |, |or |; )[01](?:$|[ :.;,])",
    r"\| 1 if",
    r"^\| `` \|(?: \w[\w, ]* \|)? [\d.e-]+ \|",
]


# figures in words, and what they are of in pages that give them: options, laws, the kind of model
WORDS = r"(thousand|million|percent|twice as|half the|third|quarter|tenth|fifth|\w+ times as)\b"
GIVEN_IN_WORDS = [
    r"a few thousand to millions",
    r"a tenth of the (estimated error|mesh's)",
    r"half the (square|step|error)",
    r"N times as long",
    r"a quarter of both",
    r"takes several times as many iterations",
]
NUMBER = re.compile(rf"\d|{WORDS}")
# examples and notes have numbers of their models and rules; a cost or an error has one of these
UNITS_OF_COST = "s|ms|MB|GB|times|unknowns|iterations|multiplications"
COST = re.compile(rf"\d ?%|\d ({UNITS_OF_COST})\b|\b(million|percent|times as)\b")
OF_MODELS = (
    r"4000|67 330|1464|1.6 million|2500 unknowns|40 % of its r|by less than 12 %|100 times what"
    r"|(1.3|1.5|so many|several|three|four|ten|1000) times|2 × 1 MB of L2, 32 MB|2364 multi"
)
NOTES = [path for path in DOCUMENTS if path not in USER_PAGES]


def without_sources(path):
    """The prose of a page, but for what has a source in the tables above."""
    text = prose(path)
    for name, *rest in (*OF_CODE_AND_TABLES, *OF_RUNS):
        if ROOT / f"{name}.md" == path:
            pattern = next(entry for entry in rest if isinstance(entry, str) and "(" in entry)
            text = re.sub(pattern, "", text)
    return re.sub(r"\]\([^)]*\)", "]", re.sub(r"`[^`]*`", "``", text))


@pytest.mark.parametrize("path", [ROOT / "demos", *NOTES], ids=lambda path: path.stem)
def test_texts_of_examples_and_notes_have_no_figure_of_a_run(path):
    programs = "\n".join(demo.read_text() for demo in path.glob("*.py"))
    texts = re.findall(r"^ *# .*$", programs, re.M) or without_sources(path).splitlines()
    assert not [line for line in texts if COST.search(re.sub(OF_MODELS, "", line))]


@pytest.mark.parametrize("path", USER_PAGES, ids=lambda path: path.stem)
def test_no_figure_of_a_user_page_is_without_a_source(path):
    """What neither a program, a table of a benchmark nor one of the patterns above gives."""
    text = without_sources(path)
    for pattern in (*GIVEN, *GIVEN_IN_WORDS):
        text = re.sub(pattern, "", text, flags=re.MULTILINE)
    assert not [line for line in text.splitlines() if NUMBER.search(line)]
