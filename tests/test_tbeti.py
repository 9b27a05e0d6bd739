"""Scenes of boundary elements: the talk's table, and Hertz' contact in 2D."""

import pytest

from demos import run

# the talk's multiplications for 8, 64 and 216 subdomains, and what block Newton may take
TALK = {8: 130, 64: 137, 216: 133}
NEWTON = 35
LARGE = [pytest.param(n, 9, marks=pytest.mark.slow) for n in TALK]


@pytest.mark.parametrize(("subdomains", "cells"), [(8, 4), *LARGE])
def test_the_table_of_the_talk(subdomains, cells):
    for qp_type, most in (("newton", NEWTON), ("smalse", TALK[subdomains])):
        sizes = ["--subdomains", str(subdomains), "--cells", str(cells)]
        _, report = run("tbeti_cube_3d", [*sizes, "-tfeti_qp_type", qp_type])
        assert report.converged_reason == "CONVERGED_RTOL"
        assert report.F_multiplications <= most
        assert report.primal_dofs == 3 * (6 * cells**2 + 2) * subdomains
        assert report.kernel_dim == 6 * subdomains


@pytest.fixture(scope="module")
def hertz():
    """Reports by the bodies that have finite elements."""
    bodies = {"none": [], "block": ["block"], "both": ["cylinder", "block"]}
    options = {name: ["--finite", *some] if some else [] for name, some in bodies.items()}
    return {name: run("tbeti_hertz_2d", given)[1] for name, given in options.items()}


@pytest.mark.parametrize("finite", ["none", "block", "both"])
def test_hertz(hertz, finite):
    errors = hertz[finite].errors
    assert abs(errors["half_width"]) < 0.01
    assert abs(errors["peak_pressure"]) < 0.01
    assert abs(errors["force"]) < 1e-8
    assert errors["pressure_l2"] < 0.01


def test_boundary_elements_need_fewer_unknowns_for_the_same_error(hertz):
    boundary, finite = hertz["none"], hertz["both"]
    assert boundary.errors["pressure_l2"] < finite.errors["pressure_l2"]
    assert boundary.errors["stress_below"] < 1e-3 < finite.errors["stress_below"]
    assert 15 * boundary.primal_dofs < finite.primal_dofs
