"""Partial slip: closed forms of Cattaneo and Mindlin, hysteresis, Coulomb's law at all nodes."""

import pytest

from demos import run


@pytest.mark.parametrize(
    ("name", "tolerance", "friction"),
    [("cattaneo_mindlin_2d", 0.03, 0.03), ("mindlin_3d", 0.15, 0.25)],
)
def test_small_sizes_are_near_the_closed_form(quick_demo, name, tolerance, friction):
    """Meshes and loads are mirror images: pressing makes no friction."""
    errors = quick_demo(name).report["errors"]
    assert abs(errors["half_width"]) <= tolerance
    assert abs(errors["stick_half_width"]) <= tolerance
    assert abs(errors["friction_without_force"]) <= 1e-5
    assert abs(errors["force"]) <= 1e-6
    assert abs(errors["friction_force"]) <= 1e-6
    assert abs(errors["law"]) <= 1e-3
    assert errors["traction_l2"] <= friction


def test_a_loop_and_what_it_dissipates(quick_demo):
    """Stick after each turn, dissipation, and an energy defect that halves with the step."""
    one = quick_demo("unloading_2d").report["errors"]
    _, report = run("unloading_2d", ["--quick", "--steps", 2])
    for errors in (one, report.errors):
        assert abs(errors["stick_half_width"]) <= 0.05
        assert abs(errors["stick_after_turns"]) <= 0.05
        assert errors["least_dissipation"] >= -1e-6  # of what a cycle loses
        assert abs(errors["dissipation"]) <= 0.05
    assert abs(report.errors["energy_defect"]) <= 0.5 * abs(one["energy_defect"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("demo", "arguments", "tolerance"),
    [("cattaneo_mindlin_2d", ["--refine", 2], 0.01), ("mindlin_3d", [], 0.05)],
)
def test_default_sizes(demo, arguments, tolerance):
    _, report = run(demo, arguments)
    for name in ("half_width", "stick_half_width"):
        assert abs(report.errors[name]) <= tolerance


@pytest.mark.slow
def test_hysteresis_of_default_size():
    _, report = run("unloading_2d")
    assert abs(report.errors["stick_half_width"]) <= 0.05
    assert abs(report.errors["stick_after_turns"]) <= 0.05
    assert abs(report.errors["dissipation"]) <= 0.01
    assert report.errors["least_dissipation"] >= -1e-6
