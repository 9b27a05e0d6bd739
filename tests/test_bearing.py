"""The ball bearing: contact forces that balance on every body, on any number of ranks."""

import numpy as np
import pytest

import tfeti_dolfinx as tfeti
from demos import ball_bearing_3d
from demos.ball_bearing_3d import contact_forces
from meshes.ball_bearing import Bearing, build


@pytest.fixture(scope="module")
def bearing():
    """Solution and report at the quick size; nothing in them changes."""
    return ball_bearing_3d.run(["--quick", "-tfeti_rtol", "1e-8"])


def test_forces_balance_on_every_ball_and_on_the_inner_ring(bearing):
    _, report = bearing
    assert report.converged_reason == "CONVERGED_RTOL"
    assert report.bodies == 10
    assert report.errors["ball_balance"] <= 1e-8
    assert abs(report.errors["force"]) <= 1e-8
    assert report.errors["side_force"] <= 0.02


def test_the_lower_balls_carry_the_load(bearing):
    """Stribeck: the lowest of Z balls carries about 4.37/Z of the load, 5/Z with clearance."""
    solution, _ = bearing
    inner, outer = np.linalg.norm(contact_forces(solution, 8), axis=2).T / 2500.0
    assert 4.3 / 8 < inner[0] < 5 / 8
    assert inner[1] == pytest.approx(inner[7], rel=0.1)
    assert np.all(np.abs(inner[2:7]) <= 1e-9)
    assert outer[3:6] == pytest.approx(3.5 / 2500.0, rel=0.1)  # the centrifugal force


def test_another_number_of_balls():
    _, report = ball_bearing_3d.run(["--quick", "--balls", "5", "-tfeti_rtol", "1e-7"])
    assert report.bodies == 7
    assert report.errors["ball_balance"] <= 1e-7
    assert abs(report.errors["force"]) <= 1e-7


def test_partitions_keep_the_names(comm):
    model = None
    if comm.rank == 0:
        model = build(Bearing(balls=3), fine=1.0, growth=1.0, coarse=4.0, partitions=6)
    d = tfeti.read_gmsh(model, comm)
    balls = {"ball 1", "ball 2", "ball 3"}
    rings = {"inner groove", "outer groove", "bore", "outside", "mid plane"}
    assert set(d.names.volumes) == {"inner ring", "outer ring", *balls}
    assert set(d.names.surfaces) == rings | balls
    assert d.num_bodies == 5
    assert d.num_subdomains >= 6
