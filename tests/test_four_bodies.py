"""The wedge between two blocks: forces in balance, the law, symmetry, few multiplications."""

import numpy as np
import pytest

import tfeti_dolfinx as tfeti
from demos.four_bodies_2d import PAIRS

BOUND = 0.008


def test_forces_balance_and_the_bound_is_reached_where_nodes_slip(quick_demo, comm):
    found = quick_demo("four_bodies_2d")
    solution, report = found.solution, found.report
    assert report["bodies"] == 4
    assert report["free_modes"] == 0
    assert abs(report["errors"]["force_wedge"]) <= 1e-5
    assert abs(report["errors"]["force_base"]) <= 1e-5
    assert report["sticking"] > 0
    for name, _ in PAIRS:
        data = solution.contact(name)
        size = np.linalg.norm(data.tangential_traction, axis=1)
        slips = data.status == tfeti.ContactStatus.SLIP
        assert np.all(size <= BOUND * (1.0 + 1e-9))
        assert np.allclose(size[slips], BOUND, rtol=1e-9, atol=0)
        work = np.sum(data.tangential_traction * data.slip, axis=1)
        assert np.all(work[slips] < 0.0)
    # both sides do the same
    sides = [solution.contact(name) for name in ("wedge left", "wedge right")]
    force = [comm.allreduce(float(data.force.sum())) for data in sides]
    slipping = [
        comm.allreduce(int(np.sum(data.status == tfeti.ContactStatus.SLIP))) for data in sides
    ]
    assert force[0] == pytest.approx(force[1], rel=1e-4)
    assert 0 < slipping[0] == slipping[1]
    assert report["sliding"] >= 2 * slipping[0]
