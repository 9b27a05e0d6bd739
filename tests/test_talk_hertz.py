"""The talk's Hertz table in 2D: sizes, and few multiplications by F."""

import pytest

from demos import run

TALK = ["-tfeti_qp_type", "smalse", "-tfeti_pc_type", "none", "-tfeti_rtol", "1e-4"]


SIZES = [
    (2, 99, 60),
    pytest.param(32, 99, 90, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("subdomains", "cells", "most"), SIZES)
def test_multiplications(subdomains, cells, most):
    """At most those of the table's size, 99 cells."""
    _, report = run(
        "talk_hertz_2d", ["--subdomains", str(subdomains), "--cells", str(cells), *TALK]
    )
    assert report.F_multiplications <= most
    assert report.primal_dofs == 2 * (cells + 1) ** 2 * subdomains
    assert report.kernel_dim == 3 * subdomains
    assert report.subdomains == subdomains
    assert report.bodies == 2
    assert 0 < report.active_contacts < report.contact_rows < report.contact_candidates


def test_near_the_closed_form():
    """Half planes against squares whose width is 7 half widths: the bodies differ by percents."""
    _, report = run("talk_hertz_2d", ["-tfeti_rtol", "1e-8"])
    assert abs(report.errors["force"]) <= 1e-6
    assert abs(report.errors["half_width"]) <= 0.03
    assert abs(report.errors["peak_pressure"]) <= 0.03


def test_the_number_of_subdomains_does_not_change_the_answer():
    coarse, fine = (
        run("talk_hertz_2d", ["--subdomains", n, "--cells", cells, "-tfeti_rtol", "1e-8"])[1]
        for n, cells in (("2", "32"), ("32", "8"))
    )
    assert fine.errors["half_width"] == pytest.approx(coarse.errors["half_width"], abs=1e-5)
    assert fine.errors["peak_pressure"] == pytest.approx(coarse.errors["peak_pressure"], abs=1e-5)
    assert fine.active_contacts == coarse.active_contacts
