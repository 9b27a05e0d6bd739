"""``-citations`` prints the papers of the methods that a run has used, and no others."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tfeti_dolfinx.common.logging import PAPERS, cite, entry
from tfeti_dolfinx.qp.solvers import SOLVERS

ROOT = Path(__file__).resolve().parents[1]


def keys(text):
    return {key for key in re.findall(r"@\w+\{([^,]+),", text) if not key.startswith("petsc")}


def of(*methods):
    return {key for method in methods for key in PAPERS[method]}


@pytest.mark.parametrize(
    ("demo", "options", "methods"),
    [
        ("linear_3d", [], ("tfeti", "pcpg")),
        ("cube_3d", [], ("tfeti", "newton")),
        ("cube_3d", ["-tfeti_qp_type", "smalse"], ("tfeti", "smalse")),
        ("tbeti_cube_3d", [], ("tfeti", "newton", "boundary elements")),
        ("belt_2d", [], ("tfeti", "newton", "newton on friction", "mortar")),
        ("stacked_blocks_3d", [], ("tfeti", "newton", "mortar")),
    ],
)
def test_citations_of_a_run(serial_only, demo, options, methods, tmp_path):
    command = [sys.executable, ROOT / f"demos/{demo}.py", "--quick", "-citations", *options]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    ours = of(*PAPERS)
    assert keys(result.stdout) & ours == of(*methods)
    for key in of(*methods):
        assert result.stdout.count(f"{{{key},") == 1


def test_all_solvers_have_papers():
    assert set(SOLVERS) <= set(PAPERS)


def test_papers_are_whole():
    for papers in PAPERS.values():
        for key in papers:
            paper = entry(key)
            assert keys(paper) == {key}
            assert paper.count("{") == paper.count("}")
            for field in ("title", "author", "year"):
                assert f"{field} = {{" in paper


def test_methods_without_a_paper_are_passed_over():
    cite("nobody's method")
