"""``-citations`` prints the papers of the methods that a run has used, and no others."""

import re
import sys
from pathlib import Path

import pytest
from quick_demos import alone, process

from tfeti_dolfinx.common.logging import PAPERS, entry
from tfeti_dolfinx.options import SOLVERS

ROOT = Path(__file__).resolve().parents[1]


def keys(text):
    return {key for key in re.findall(r"@\w+\{([^,]+),", text) if not key.startswith("petsc")}


def of(*methods):
    return {key for method in methods for key in PAPERS[method]}


@pytest.mark.parametrize(
    ("demo", "options", "methods"),
    [
        ("linear_3d", [], ("tfeti", "pcpg")),
        ("tbeti_cube_3d", ["-tfeti_qp_type", "smalse"], ("tfeti", "smalse", "boundary elements")),
        ("belt_2d", [], ("tfeti", "newton", "newton on friction", "mortar")),
    ],
)
def test_citations_of_a_run(serial_only, demo, options, methods, tmp_path):
    path, environment = alone(demo, tmp_path)
    command = [sys.executable, path, "--quick", "-citations", *options]
    said = process(command, tmp_path, environment)
    ours = of(*PAPERS)
    assert keys(said) & ours == of(*methods)
    for key in of(*methods):
        assert said.count(f"{{{key},") == 1


def test_all_solvers_have_papers_that_are_whole():
    assert set(SOLVERS) <= set(PAPERS)
    for papers in PAPERS.values():
        for key in papers:
            paper = entry(key)
            assert keys(paper) == {key}
            assert paper.count("{") == paper.count("}")
            for field in ("title", "author", "year"):
                assert f"{field} = {{" in paper


def test_the_package_s_citation_has_all_papers():
    """Its version is looked at in test_docs."""
    cited = (ROOT / "CITATION.cff").read_text()
    papers = {key for keys in PAPERS.values() for key in keys}
    assert cited.count("  - type: ") == len(papers)
