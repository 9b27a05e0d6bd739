"""The clamped connection: forces in balance, Coulomb's law, few multiplications."""

import numpy as np
import pytest

import tfeti_dolfinx as tfeti
from demos.clamped_connection_3d import BARS, BOLT, PROFILES
from meshes.clamped_connection import CLAMPS, Connection, build

SIDES = ("lower", "upper")


def test_friction_holds_the_load_and_the_bolts_press(quick_demo, comm):
    found = quick_demo("clamped_connection_3d")
    solution, report = found.solution, found.report
    assert report["bodies"] == 6
    assert abs(report["errors"]["force"]) <= 1e-5
    pressed = 2 * CLAMPS * BOLT
    for side in SIDES:
        data = [solution.contact(f"{side} bar {i}") for i in (1, 2)]
        force = sum(float(d.force.sum()) for d in data)
        assert comm.allreduce(force) == pytest.approx(pressed, rel=1e-5)
    between = comm.allreduce(float(solution.contact(PROFILES[0]).force.sum()))
    assert between == pytest.approx(pressed, rel=0.2)  # the ends bear the rest
    assert min(report["sticking"], report["sliding"]) > 0
    assert report["residuals"]["friction"] <= 1e-4
    for name in (PROFILES[0], *(a for a, _ in BARS)):
        data = solution.contact(name)
        size = np.linalg.norm(data.tangential_traction, axis=1)
        slips = data.status == tfeti.ContactStatus.SLIP
        largest = data.pressure.max(initial=0.0)
        assert np.all(size <= 0.3 * data.pressure + 1e-3 * largest)
        assert np.all(np.sum(data.tangential_traction * data.slip, axis=1)[slips] < 0.0)


def test_groups_and_measures(comm):
    model = build(Connection(), size=30.0, partitions=4) if comm.rank == 0 else None
    d = tfeti.read_gmsh(model, comm)
    assert d.num_bodies == 6
    bars = {f"{side} bar {i}" for side in SIDES for i in (1, 2)}
    ends = {"lower end", "upper end", "lower inside", "upper outside", "bottom", "lips"}
    assert set(d.names.volumes) == {"lower profile", "upper profile", *bars}
    assert set(d.names.surfaces) == {*bars, *ends, "bolts below", "bolts above"}
