"""The belt on a drum: the capstan equation, before and after the drum turns."""

import numpy as np
import pytest

import tfeti_dolfinx as tfeti
from demos import belt_2d


def test_the_capstan_equation_holds_and_all_of_the_belt_slips_back(quick_demo, comm):
    belt = quick_demo("belt_2d")
    data, report = belt.solution.contact("belt"), belt.report
    for name in ("capstan", "capstan_hung", "capstan_thin"):
        assert abs(report["errors"][name]) <= 0.01
    rubbing = data.status != tfeti.ContactStatus.OPEN
    # from the held side on the right to the pulled one: the way in which the belt slips
    along = np.stack((-data.points[:, 1], data.points[:, 0]), axis=1)
    assert report["sticking"] == 0
    assert comm.allreduce(int(np.sum(rubbing))) == report["sliding"] > 30
    assert np.all(np.sum(data.slip * along, axis=1)[rubbing] < 0.0)
    assert np.all(np.sum(data.tangential_traction * along, axis=1)[rubbing] > 0.0)


@pytest.mark.slow
def test_the_error_falls_with_the_mesh():
    _, report = belt_2d.run([])
    assert abs(report.errors["capstan"]) <= 0.001
    assert abs(report.errors["capstan_hung"]) <= 0.001
