"""The ball bearing: contact forces that balance on every body, on any number of ranks."""

import numpy as np
import pytest

import tfeti_dolfinx as tfeti
from demos.ball_bearing_3d import contact_forces
from meshes.ball_bearing import Bearing, build


def test_forces_balance_and_the_lower_balls_carry_the_load(quick_demo):
    """Stribeck: the lowest of Z balls carries about 4.37/Z of the load, 5/Z with clearance."""
    bearing = quick_demo("ball_bearing_3d")
    assert bearing.report["bodies"] == 10
    assert bearing.report["errors"]["ball_balance"] <= 1e-5
    assert abs(bearing.report["errors"]["force"]) <= 1e-5
    assert bearing.report["errors"]["side_force"] <= 0.02
    inner, outer = np.linalg.norm(contact_forces(bearing.solution, 8), axis=2).T / 2500.0
    assert 4.3 / 8 < inner[0] < 5 / 8
    assert inner[1] == pytest.approx(inner[7], rel=0.1)
    assert np.all(np.abs(inner[2:7]) <= 1e-6)
    assert outer[3:6] == pytest.approx(3.5 / 2500.0, rel=0.1)  # the centrifugal force


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
