"""Hertz' closed forms: force, half width, peak pressure, convergence of the pressure."""

from itertools import pairwise

import pytest

from benchmarks.hertz_convergence import study_2d, study_3d
from demos import hertz_2d, hertz_3d


@pytest.mark.parametrize(("demo", "tolerance"), [(hertz_2d, 0.02), (hertz_3d, 0.05)])
def test_small_sizes_are_near_the_closed_form(demo, tolerance):
    _, report = demo.run(["--quick", "-tfeti_rtol", "1e-8"])
    assert abs(report.errors["force"]) <= 1e-6
    assert abs(report.errors["half_width"]) <= tolerance
    assert abs(report.errors["peak_pressure"]) <= tolerance


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


def test_pressure_converges_in_2d():
    rows, slopes = study_2d((8, 16, 32, 128))
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
