"""The belt on a drum: the capstan equation, before and after the drum turns."""

import numpy as np
import pytest

import tfeti_dolfinx as tfeti
from demos import belt_2d


@pytest.fixture(scope="module")
def belt():
    """Solution and report at the quick size; nothing in them changes."""
    return belt_2d.run(["--quick"])


def test_the_capstan_equation_holds(belt):
    _, report = belt
    assert abs(report.errors["capstan"]) <= 0.01
    assert abs(report.errors["capstan_hung"]) <= 0.01
    assert abs(report.errors["capstan_thin"]) <= 0.01


def test_all_of_the_belt_slips_back(belt, comm):
    solution, report = belt
    data = solution.contact("belt")
    rubbing = data.status != tfeti.ContactStatus.OPEN
    # from the held side on the right to the pulled one: the way in which the belt slips
    along = np.stack((-data.points[:, 1], data.points[:, 0]), axis=1)
    assert report.sticking == 0
    assert comm.allreduce(int(np.sum(rubbing))) == report.sliding > 30
    assert np.all(np.sum(data.slip * along, axis=1)[rubbing] < 0.0)
    assert np.all(np.sum(data.tangential_traction * along, axis=1)[rubbing] > 0.0)


def test_few_problems(belt):
    _, report = belt
    assert report.friction_iterations <= 10
    assert report.in_all["friction_iterations"] <= 20


def test_forces_are_those_of_a_sharper_solve(belt):
    """A drum that turns moves far: displacements say little of forces, bounds at rest do."""
    _, report = belt
    _, exact = belt_2d.run(["--quick", "-tfeti_rtol", "1e-10"])
    for name in ("capstan", "capstan_hung"):
        assert abs(report.errors[name] - exact.errors[name]) <= 1e-4


def test_another_angle_and_coefficient():
    _, report = belt_2d.run(["--quick", "--angle", "100", "--friction", "0.2"])
    assert report.sticking == 0
    assert abs(report.errors["capstan"]) <= 0.01
    assert abs(report.errors["capstan_hung"]) <= 0.01


@pytest.mark.slow
def test_the_error_falls_with_the_mesh():
    _, report = belt_2d.run([])
    assert report.friction_iterations <= 10
    assert abs(report.errors["capstan"]) <= 0.001
    assert abs(report.errors["capstan_hung"]) <= 0.001
