"""Figures of user pages: each is the code's, a table's, or that of a run; the others are given."""

import inspect
import re

import dolfinx
import numpy as np
import pytest
from petsc4py import PETSc
from test_docs import ROOT, USER_PAGES, prose

import demos
import tfeti_dolfinx as tfeti
from benchmarks.stability_scenes import MODULI, UNITS
from tfeti_dolfinx.accuracy.diagnostics import WarningLimits
from tfeti_dolfinx.bem.steklov import StiffnessTolerances
from tfeti_dolfinx.feti.dual import DualLimits
from tfeti_dolfinx.mesh.partition import UNKNOWNS
from tfeti_dolfinx.mortar.tolerances import SearchTolerances

HALVINGS = inspect.signature(tfeti.LoadSteps).parameters["max_halvings"].default
CREASE = np.degrees(np.arccos(SearchTolerances.crease))
TURNS, FLAT = WarningLimits.turns, 2 * WarningLimits.flat
PETSC = PETSc.Sys.getVersion()
LENGTHS, PRESSURES = zip(*UNITS[1:], strict=True)


def prices():
    """The column *of GAMG* of contact by block Newton, of both scenes: least and most."""
    rows = (ROOT / "docs/developers/performance.md").read_text().splitlines()
    found = [float(row.split("|")[-3]) for row in rows if row.startswith("| contact, newton |")]
    assert len(found) == 2
    return [round(price, 1) for price in (min(found), max(found))]


PRICE = (r"costs (\S+) to (\S+) times as much as a linear solve by multigrid", prices)


def largest():
    """Seconds and gigabytes of the cube of eleven million unknowns."""
    text = (ROOT / "docs/developers/performance.md").read_text()
    ((gigabytes, seconds),) = re.findall(r"10 956 792 unknowns, .*?(\S+) GB and (\d+) s", text)
    return [float(seconds), round(float(gigabytes))]


OF_CODE_AND_TABLES = [
    ("README", *PRICE),
    ("README", r"Eleven million unknowns with contact take\s+(\d+) s and (\d+) GB", largest),
    ("docs/guide/speed", *PRICE),
    ("docs/load_steps", r"kept, up to (\d+) of them", [DualLimits.recycled]),
    ("docs/dynamics", r"kept, (\d+) of them", [DualLimits.recycled]),
    ("docs/options", r"auto: (\d+) from the second solve", [DualLimits.recycled]),
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
    ("docs/two_bodies", r"more than some (\d+) degrees", [pytest.approx(CREASE, abs=2.0)]),
]
SAG = ("docs/two_bodies", r"elements of size 3 lie (\S+) off", [pytest.approx(9 / 80, abs=0.005)])
OF_CODE_AND_TABLES.append(SAG)
RUBBER = ("docs/gallery", r"rubber pressed by (\d+) % of", lambda: [100 * rubber_depth()])
OF_CODE_AND_TABLES.append(RUBBER)
# of a demo at its default size: what bounds the errors whose names have these words
SLOW = pytest.mark.slow
OF_RUNS = [
    ("docs/boundary_elements", "tbeti_hertz_2d", r"pressure is within (\S+) % of", "peak_pressure"),
    pytest.param(
        "docs/dynamics", "bouncing_bar", r"mean pressures are within (\S+) % ", "", marks=SLOW
    ),
    pytest.param(
        "docs/dynamics", "impact_of_bars", r": pressures are within (\S+) %", "pressure", marks=SLOW
    ),
    pytest.param(
        "docs/dynamics", "impact_of_bars", r"by less than (\S+) %", "oscillates", marks=SLOW
    ),
]


def page(name):
    return (ROOT / f"{name}.md").read_text()


def rubber_depth():
    (depth,) = re.findall(
        r"^depths = (\S+) \* R", (ROOT / "demos/rubber_pressed_3d.py").read_text(), re.M
    )
    return float(depth)


@pytest.mark.parametrize(("name", "pattern", "values"), OF_CODE_AND_TABLES)
def test_a_page_says_what_the_code_or_a_table_has(name, pattern, values):
    (said,) = re.findall(pattern, page(name))
    said = [float(number) for number in ([said] if isinstance(said, str) else said)]
    values = values() if callable(values) else values
    assert said == [pytest.approx(v) if isinstance(v, float) else v for v in values]


@pytest.mark.parametrize(("name", "demo", "pattern", "word"), OF_RUNS)
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
    """Lines and words alike; whole numbers within 5 %, as each gmsh has its own mesh."""
    (sample,) = re.findall(r"^```text\n(.*?)^```", page("docs/report"), re.DOTALL | re.MULTILINE)
    said, printed = (
        re.sub(r"\n {12}", " ", text).splitlines()
        for text in (sample, quick_demo("cylinder_on_block_2d").out)
    )
    start = printed.index(said[0])
    printed = printed[start : start + len(said)]
    number = re.compile(r"-?\d[\d.]*(e[-+]\d+)?")
    for k in (1, 2):
        parts = [line[k].split(", pressure")[0].split(", force")[0] for line in (said, printed)]
        whole = [[int(found) for found in re.findall(r"\b\d+\b", part)] for part in parts]
        assert whole[0] == pytest.approx(whole[1], rel=0.05)
    for k in (1, 2, 3, 4):
        assert number.sub("#", said[k]) == number.sub("#", printed[k])
    assert printed[5].startswith("  time ")
    force, pressure = r"force \(\S+, (\S+)\)", r"pressure up to (\S+),"
    for pattern in (force, pressure):
        numbers = [float(re.search(pattern, lines[2])[1]) for lines in (said, printed)]
        assert numbers[0] == pytest.approx(numbers[1], rel=0.01)
    for pattern in (r"(\d+) iterations", r"(\d+) preconditioned"):
        numbers = [int(re.search(pattern, lines[4])[1]) for lines in (said, printed)]
        assert abs(numbers[0] - numbers[1]) <= 5


# what is no figure: names, dimensions, status and codes, what a page gives to a program or states
GIVEN = [
    r"(io4dolfinx|adios4dolfinx|scifem|setuptools ≥|import with) [\d.]+\d( and [\d.]+\d)?",
    r"io4dolfinx|adios4dolfinx|h5py",
    r"\b[1-3]D\b",
    r"[Dd]egrees? [12](?: and 2)?\b",
    r"DOLFINx(?: ≥)? 0\.\d+",
    r"Debian 1\d( or 13)?",
    r"^\| 0\.\d+ \|.*$",
    r"h²/8R",
    r"2πr",
    r"x\[0\]",
    r"\bb[₀12]\b",
    r"u_r = 0",
    r"\b(tag|rank) \d",
    r"body 0\b",
    r"73, 2008",
    r"CB1|SSNV506|ADIOS2",
    r"near(?: to)? 0\.5",
    r"`` 2 in gmsh",
    r"\(`` 2\)",
    r"rtol 1e-8",
    r"below 1\.",
    r"\(0, 1\)",
    r"200/√2",
    r"\(0 no contact .*$",
    r"200 down",
    r"radius 10",
    r"^of 0\.05",
    r"size 0\.5",
    r"size 3",
    r"down by 0\.1",
    r"100 rtol",
    r"(?:: |is |, |or )[01](?:$|[ :.;,])",
    r"^\| `` \|(?: \w[\w, ]* \|)? [\d.e-]+ \|",
    r"; 0:? ?(none)?",
    r"\| 1 if",
    r"0, since",
    r"0 or more",
    r"1/‖A‖",
    r"ᾱ = 1\.95",
]


@pytest.mark.parametrize("path", USER_PAGES, ids=lambda path: path.stem)
def test_no_figure_of_a_user_page_is_without_a_source(path):
    """What neither a program, a table of a benchmark nor one of the patterns above gives."""
    text = prose(path)
    sources = [*OF_CODE_AND_TABLES, *(getattr(run, "values", run) for run in OF_RUNS)]
    for name, *rest in sources:
        if ROOT / f"{name}.md" == path:
            pattern = next(entry for entry in rest if isinstance(entry, str) and "(" in entry)
            text = re.sub(pattern, "", text)
    text = re.sub(r"\]\([^)]*\)", "]", re.sub(r"`[^`]*`", "``", text))
    for pattern in GIVEN:
        text = re.sub(pattern, "", text, flags=re.MULTILINE)
    assert not [line for line in text.splitlines() if re.search(r"\d", line)]
