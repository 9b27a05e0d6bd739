"""The talk's Hertz table in 2D: sizes, and few multiplications by F."""

import pytest

from demos import run

TALK = ["-tfeti_qp_type", "smalse", "-tfeti_pc_type", "none", "-tfeti_rtol", "1e-4"]
SIZES = [(2, 99, 60), pytest.param(32, 99, 90, marks=pytest.mark.slow)]


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
