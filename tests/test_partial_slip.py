"""Partial slip: closed forms of Cattaneo and Mindlin, hysteresis, few problems for each step."""

from argparse import Namespace

import numpy as np
import pytest

import tfeti_dolfinx as tfeti
from demos import cattaneo_mindlin_2d, mindlin_3d, unloading_2d
from demos.partial_slip import pushed_in_steps

QUICK = Namespace(quick=True, refine=0, subdomains=None, elements=None)


@pytest.mark.parametrize("demo", [cattaneo_mindlin_2d, mindlin_3d])
def test_the_closed_form_of_friction_has_the_force_that_was_given(demo):
    closed, a = demo.CLOSED, demo.a
    r = np.linspace(0.0, a, 200_001)
    around = 2.0 if demo is cattaneo_mindlin_2d else 2 * np.pi * r

    def force(traction):
        return np.trapezoid(around * traction, r) / closed.capacity

    for share in (0.1, 0.5, 0.9):
        Q = share * closed.capacity
        assert force(closed.traction(r, Q)) == pytest.approx(share, abs=1e-6)
        back = closed.traction_after(r, Q, 1.5 * Q)
        assert force(back) == pytest.approx(-0.5 * share, abs=1e-6)
        assert np.all(np.abs(back) <= closed.mu * closed.hertz.pressure(r) + 1e-12)
        assert closed.largest(Q) == pytest.approx(closed.traction(r, Q).max(), rel=1e-4)


@pytest.mark.parametrize(("demo", "tolerance"), [(cattaneo_mindlin_2d, 0.03), (mindlin_3d, 0.15)])
def test_small_sizes_are_near_the_closed_form(demo, tolerance, comm):
    """Meshes and loads are mirror images: pressing makes no friction."""
    loads, parts = demo.scene(demo.torn_mesh(QUICK))
    problem = tfeti.ContactProblem(**parts)
    errors, rows, curves = pushed_in_steps(problem, loads, demo.CLOSED, 2)
    assert abs(errors["half_width"]) <= tolerance
    assert abs(errors["stick_half_width"]) <= tolerance
    assert abs(errors["friction_without_force"]) <= 1e-5
    assert abs(errors["force"]) <= 1e-6
    assert abs(errors["friction_force"]) <= 1e-6
    assert abs(errors["law"]) <= 1e-3
    assert all(0 < row["problems"] <= 10 for row in rows)
    if demo is cattaneo_mindlin_2d:
        assert abs(errors["peak_traction"]) <= tolerance
    if comm.rank == 0:
        for force, (x, q) in curves.items():
            away = np.abs(np.abs(x) - demo.CLOSED.stick(force)) > 0.2 * demo.a
            miss = np.abs(q - demo.CLOSED.traction(x, force))[away]
            assert np.all(miss <= 0.15 * demo.mu * demo.HERTZ.peak)
    problem.destroy()


def test_a_loop_and_what_it_dissipates():
    """Stick after each turn, dissipation, and an energy defect that halves with the step."""
    defects = []
    for steps in (1, 2):
        pair = unloading_2d.Pair(QUICK)
        rows = [pair.push(Q) for Q in unloading_2d.way(steps)[: 3 * steps]]  # half a cycle
        for row in rows:
            assert row["c/a"] == pytest.approx(row["closed form"], rel=0.05)
            assert row["dissipation"] >= -1e-6  # of what a cycle loses
            assert 0 < row["problems"] <= 10
        lost = sum(row["dissipation"] for row in rows[steps:])
        defects.append(sum(row["defect"] for row in rows[steps:]))
        assert lost == pytest.approx(0.5, abs=0.025)
        pair.problem.destroy()
    assert abs(defects[1]) <= 0.5 * abs(defects[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("demo", "arguments", "tolerance"),
    [(cattaneo_mindlin_2d, ["--refine", "2"], 0.01), (mindlin_3d, [], 0.05)],
)
def test_default_sizes(demo, arguments, tolerance):
    _, report = demo.run(arguments)
    for name in ("half_width", "stick_half_width"):
        assert abs(report.errors[name]) <= tolerance


@pytest.mark.slow
def test_hysteresis_of_default_size():
    _, report = unloading_2d.run([])
    assert abs(report.errors["stick_half_width"]) <= 0.05
    assert abs(report.errors["stick_after_turns"]) <= 0.05
    assert abs(report.errors["dissipation"]) <= 0.01
    assert report.errors["least_dissipation"] >= -1e-6
