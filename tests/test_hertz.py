"""Hertz' closed forms: force, half width, peak pressure, convergence of the pressure."""

from itertools import pairwise

import pytest

from benchmarks.hertz_convergence import study_2d, study_3d, study_pair, study_pair_3d
from demos import cylinder_on_block_2d, hertz_2d, hertz_3d


@pytest.mark.slow
@pytest.mark.parametrize(("demo", "tolerance"), [(hertz_2d, 0.02), (hertz_3d, 0.05)])
def test_default_sizes_are_near_the_closed_form(demo, tolerance):
    _, report = demo.run(["-tfeti_rtol", "1e-8"])
    assert abs(report.errors["force"]) <= 1e-6
    assert abs(report.errors["half_width"]) <= tolerance
    assert abs(report.errors["peak_pressure"]) <= tolerance


def falls(rows, name):
    errors = [row[name] for row in rows]
    return all(finer < coarser for coarser, finer in pairwise(errors))


# elements along the half width; the last solution is the reference
SIZES = [(8, 16, 32, 64), pytest.param((8, 16, 32, 128), marks=pytest.mark.slow)]


@pytest.mark.parametrize("sizes", SIZES)
def test_pressure_converges_in_2d(sizes):
    rows, slopes = study_2d(sizes)
    assert falls(rows, "pressure_l2")
    assert falls(rows, "pressure_l2_finer")
    assert slopes["pressure_l2"] >= 0.9
    assert slopes["pressure_l2_finer"] >= 0.9


@pytest.mark.slow
def test_pressure_converges_in_3d():
    rows, slopes = study_3d((8_000, 24_000, 72_000, 250_000))
    assert falls(rows, "pressure_l2")
    assert falls(rows, "pressure_l2_finer")
    assert slopes["pressure_l2_finer"] >= 0.5


def test_a_cylinder_on_a_block_is_near_the_closed_form():
    """NAFEMS CB1: a = 6.21 mm, p₀ = 3585.37 MPa."""
    hertz = cylinder_on_block_2d.closed_form()
    assert abs(hertz.half_width - 6.21) < 0.01
    assert abs(hertz.peak - 3585.37) < 1
    runs = {
        name: cylinder_on_block_2d.run([*options, "-tfeti_rtol", "1e-10"])[1].errors
        for name, options in {
            "default": [],
            "exchanged": ["--exchange"],
        }.items()
    }
    for errors in runs.values():
        assert abs(errors["force"]) <= 1e-8
    for name in ("half_width", "peak_pressure"):
        default, exchanged = (errors[name] for errors in runs.values())
        assert abs(default) <= 0.03
        assert abs(exchanged - default) <= 0.01


@pytest.mark.slow
def test_pressure_of_a_pair_converges():
    """A quick run, on coarser meshes, is one of ``test_benchmarks``."""
    rows, slopes = study_pair((8, 16, 32, 128))
    assert falls(rows, "pressure_l2_finer")
    assert slopes["pressure_l2_finer"] >= 0.9


@pytest.mark.slow
def test_pressure_of_a_pair_converges_in_3d():
    rows, slopes = study_pair_3d((8_000, 24_000, 72_000, 250_000))
    assert falls(rows, "pressure_l2_finer")
    assert slopes["pressure_l2_finer"] >= 0.4
