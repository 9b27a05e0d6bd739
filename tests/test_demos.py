"""Every demo runs at its quick size, serially and on ranks, with all of its outputs."""

import re
import sys

import pytest
from quick_demos import DEMOS, ROOT, alone, process

import demos


@pytest.mark.parametrize("name", DEMOS)
def test_quick_size(name, quick_demo, comm):
    found = quick_demo(name)
    assert found.report["converged_reason"].startswith("CONVERGED")
    assert found.report["seconds"]["total"] > 0.0
    assert any(found.folder.glob(f"{name}*.bp")) or any(found.folder.glob(f"{name}*.xdmf"))
    assert any(found.folder.glob(f"{name}*.png")) == found.drawn
    assert ("TFETI solve CONVERGED" in found.out) == (comm.rank == 0)
    # a terminal shows what is logged, too; two levels of refinement may have the same to say
    most = found.out.count("TFETI solve") if name.startswith("adaptive") else 1
    assert all(found.out.count(text) <= most for text in found.report["warnings"])


@pytest.mark.parametrize("name", DEMOS)
def test_a_demo_imports_nothing_of_the_tree_but_the_package(name):
    """Those of the README, of citations and of the command line are run out of the tree, too."""
    text = (ROOT / "demos" / f"{name}.py").read_text()
    assert not re.search(r"^\s*(from|import) (demos|meshes|benchmarks)\b", text, re.MULTILINE)
    assert text.startswith("# # ")


@pytest.mark.slow
@pytest.mark.parametrize("name", DEMOS)
def test_a_demo_runs_out_of_the_tree(serial_only, name, tmp_path):
    path, environment = alone(name, tmp_path)
    process([sys.executable, path, "--quick", "--plot"], tmp_path, environment)
    assert list((tmp_path / "results").glob(f"{name}*.png"))


def test_help_says_nothing_of_petsc(serial_only, tmp_path):
    path, environment = alone("hertz_2d", tmp_path)
    said = process([sys.executable, path, "--help"], tmp_path, environment)
    assert "--elements" in said
    assert "WARNING" not in said


@pytest.mark.slow
@pytest.mark.parametrize("name", DEMOS)
def test_default_size(name):
    _, report = demos.run(name)
    assert report.converged_reason.startswith("CONVERGED")


def test_a_mesh_that_follows_the_error_needs_a_tenth_of_a_uniform_one():
    """7.9 % took 38 836 unknowns of equal size, and 8 856 of hand-graded ones."""
    solution, report = demos.run("adaptive_2d", ["--error", "0.078"])
    assert report.estimates["discretisation"] <= 0.078 * report.estimates["energy"]
    assert report.primal_dofs <= 3900
    assert report.errors["pressure_l2"] <= 0.02
    assert solution.has_discretisation_error


@pytest.mark.slow
def test_a_bouncing_bar_comes_back_as_in_closed_form():
    """Closer to it on each finer mesh with smaller steps, and within 1 % at the default size."""
    found = [demos.run("bouncing_bar", ["--cells", n])[1].errors for n in (25, 50, 100)]
    assert set(found[-1]) >= {"second_begin", "second_end", "second_pressure", "period"}
    assert all(abs(value) <= 0.01 for value in found[-1].values())
    for name in ("first_end", "first_pressure", "second_begin", "second_pressure", "period"):
        coarse, _, fine = (abs(errors[name]) for errors in found)
        assert fine <= 0.5 * coarse, name
    for name in ("second_begin", "period"):
        coarse, middle, fine = (abs(errors[name]) for errors in found)
        assert middle <= 0.7 * coarse, name
        assert fine <= 0.6 * middle, name


@pytest.mark.slow
def test_a_mesh_that_follows_the_error_is_as_good_as_a_graded_one_in_3d():
    """34.3 % took 3 435 unknowns graded by hand."""
    solution, report = demos.run("adaptive_3d", ["--error", "0.343"])
    assert report.estimates["discretisation"] <= 0.343 * report.estimates["energy"]
    assert report.primal_dofs <= 1.5 * 3_435
    assert abs(report.errors["half_width"]) <= 0.1
    assert solution.has_discretisation_error
