"""The wedge between two blocks: forces in balance, the law, symmetry, few multiplications."""

import numpy as np
import pytest

import tfeti_dolfinx as tfeti
from demos import four_bodies_2d
from demos.four_bodies_2d import PAIRS

BOUND = 0.008


@pytest.fixture(scope="module")
def wedge():
    """Solution and report at the quick size; nothing in them changes."""
    return four_bodies_2d.run(["--quick", "-tfeti_rtol", "1e-8"])


def test_forces_balance(wedge):
    _, report = wedge
    assert report.bodies == 4
    assert report.subdomains == 8
    assert report.free_modes == 0
    assert abs(report.errors["force_wedge"]) <= 1e-8
    assert abs(report.errors["force_base"]) <= 1e-8


def test_the_bound_is_kept_and_reached_where_nodes_slip(wedge):
    solution, report = wedge
    assert report.sticking > 0
    for name, _ in PAIRS:
        data = solution.contact(name)
        size = np.linalg.norm(data.tangential_traction, axis=1)
        slips = data.status == tfeti.ContactStatus.SLIP
        assert np.all(size <= BOUND * (1.0 + 1e-9))
        assert np.allclose(size[slips], BOUND, rtol=1e-9, atol=0)
        work = np.sum(data.tangential_traction * data.slip, axis=1)
        assert np.all(work[slips] < 0.0)


def test_both_sides_do_the_same(wedge, comm):
    solution, report = wedge
    sides = [solution.contact(name) for name in ("wedge left", "wedge right")]
    force = [comm.allreduce(float(data.force.sum())) for data in sides]
    slipping = [
        comm.allreduce(int(np.sum(data.status == tfeti.ContactStatus.SLIP))) for data in sides
    ]
    assert force[0] == pytest.approx(force[1], rel=1e-6)
    assert 0 < slipping[0] == slipping[1]
    assert report.sliding >= 2 * slipping[0]


@pytest.mark.slow
def test_sizes_and_multiplications():
    """Of the talk's scene: 67 330 unknowns, 1786 rows, 3836 multiplications."""
    _, report = four_bodies_2d.run([])
    assert 60_000 < report.primal_dofs < 70_000
    assert report.subdomains == 8
    assert report.sticking > 0.2 * report.active_contacts
    assert report.sliding > 0.2 * report.active_contacts
