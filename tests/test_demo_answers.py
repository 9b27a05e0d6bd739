"""What demos find at their quick size: closed forms, forces in balance, the laws of friction."""

import numpy as np
import pytest
from mpi4py import MPI

import demos
import tfeti_dolfinx as tfeti

BOUND = 0.008  # of the friction of four bodies
PAIRS = ("wedge left", "wedge right", "left bottom", "right bottom")
BOLTS = 4 * 30e3  # of both clamps
BARS = [f"{side} bar {i}" for i in (1, 2) for side in ("lower", "upper")]


def check_friction(data, bound):
    """At most its bound, reached where nodes slip, against the slip."""
    size = np.linalg.norm(data.tangential_traction, axis=1)
    slips = data.status == tfeti.ContactStatus.SLIP
    assert np.all(size <= bound)
    assert np.all(np.sum(data.tangential_traction * data.slip, axis=1)[slips] < 0.0)
    return size, slips


def test_forces_balance_and_the_lower_balls_carry_the_load(quick_demo):
    """Stribeck: the lowest of Z balls carries about 4.37/Z of the load, 5/Z with clearance."""
    bearing = quick_demo("ball_bearing_3d")
    assert bearing.report["bodies"] == 10
    assert bearing.report["errors"]["ball_balance"] <= 1e-5
    assert abs(bearing.report["errors"]["force"]) <= 1e-5
    assert bearing.report["errors"]["side_force"] <= 0.02
    forces = [bearing.solution.contact(i).resultant.force for i in range(16)]
    inner, outer = np.linalg.norm(np.reshape(forces, (8, 2, 3)), axis=2).T / 2500.0
    assert 4.3 / 8 < inner[0] < 5 / 8
    assert inner[1] == pytest.approx(inner[7], rel=0.1)
    assert np.all(np.abs(inner[2:7]) <= 1e-6)
    assert outer[3:6] == pytest.approx(3.5 / 2500.0, rel=0.1)  # the centrifugal force


def test_partitions_keep_the_names(quick_demo):
    d = quick_demo("ball_bearing_3d").solution.decomposition
    balls = {f"ball {i}" for i in range(1, 9)}
    rings = {"inner groove", "outer groove", "bore", "outside", "mid plane"}
    assert set(d.names.volumes) == {"inner ring", "outer ring", *balls}
    assert set(d.names.surfaces) == rings | balls
    assert d.num_bodies == 10
    assert d.num_subdomains >= 10


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
    _, report = demos.run("belt_2d")
    assert abs(report.errors["capstan"]) <= 0.001
    assert abs(report.errors["capstan_hung"]) <= 0.001


def test_friction_holds_the_load_and_the_bolts_press(quick_demo, comm):
    found = quick_demo("clamped_connection_3d")
    solution, report = found.solution, found.report
    assert report["bodies"] == 6
    assert abs(report["errors"]["force"]) <= 1e-5
    for side in ("lower", "upper"):
        data = [solution.contact(f"{side} bar {i}") for i in (1, 2)]
        force = sum(float(d.force.sum()) for d in data)
        assert comm.allreduce(force) == pytest.approx(BOLTS, rel=1e-5)
    between = comm.allreduce(float(solution.contact("upper outside").force.sum()))
    assert between == pytest.approx(BOLTS, rel=0.2)  # the ends bear the rest
    assert min(report["sticking"], report["sliding"]) > 0
    assert report["residuals"]["friction"] <= 1e-4
    for name in ("upper outside", *BARS):
        data = solution.contact(name)
        check_friction(data, 0.3 * data.pressure + 1e-3 * data.pressure.max(initial=0.0))


def test_forces_balance_and_the_bound_is_reached_where_nodes_slip(quick_demo, comm):
    found = quick_demo("four_bodies_2d")
    solution, report = found.solution, found.report
    assert report["bodies"] == 4
    assert report["free_modes"] == 0
    assert abs(report["errors"]["force_wedge"]) <= 1e-5
    assert abs(report["errors"]["force_base"]) <= 1e-5
    assert report["sticking"] > 0
    for name in PAIRS:
        size, slips = check_friction(solution.contact(name), BOUND * (1.0 + 1e-9))
        assert np.allclose(size[slips], BOUND, rtol=1e-9, atol=0)
    # both sides do the same
    sides = [solution.contact(name) for name in ("wedge left", "wedge right")]
    force = [comm.allreduce(float(data.force.sum())) for data in sides]
    slipping = [
        comm.allreduce(int(np.sum(data.status == tfeti.ContactStatus.SLIP))) for data in sides
    ]
    assert force[0] == pytest.approx(force[1], rel=1e-4)
    assert 0 < slipping[0] == slipping[1]
    assert report["sliding"] >= 2 * slipping[0]


@pytest.mark.parametrize(
    ("name", "tolerance"), [("hertz_2d", 0.02), ("hertz_3d", 0.05), ("sphere_on_block_3d", 0.05)]
)
def test_small_sizes_are_near_the_closed_form(quick_demo, name, tolerance):
    errors = quick_demo(name).report["errors"]
    assert abs(errors["force"]) <= 1e-4
    assert abs(errors["half_width"]) <= tolerance
    assert abs(errors["peak_pressure"]) <= tolerance


def test_stacked_blocks_are_held_by_contact_alone(quick_demo):
    """Each of the three upper blocks slides and turns freely on its flat sides: 3 modes each."""
    report = quick_demo("stacked_blocks_3d").report
    assert report["bodies"] == 4
    assert report["free_modes"] == 9
    assert abs(report["errors"]["force_base"]) <= 1e-5


def test_a_bouncing_bar_is_as_in_closed_form(quick_demo):
    """Up to the end of the first impact, on few cells."""
    report = quick_demo("bouncing_bar").report
    for name, most in (("first_begin", 0.01), ("first_end", 0.03), ("first_pressure", 0.01)):
        assert abs(report["errors"][name]) <= most
    assert report["in_all"]["assemblies"] == report["in_all"]["gluings"] == 1


def test_an_impact_of_bars_is_as_in_closed_form(quick_demo):
    """On few cells, of two equal bars that exchange their velocities."""
    errors = quick_demo("impact_of_bars").report["errors"]
    most = {
        "pressure": 0.01,
        "duration": 0.01,
        "oscillates": 0.01,
        "velocity": 0.03,
        "energy": 0.02,
    }
    assert all(abs(errors[f"two_{name}"]) <= bound for name, bound in most.items())


def test_a_bolted_joint_slides_at_its_friction(quick_demo):
    """Both sides of the pulled plate slide in the end; springs of handbooks are a rough guide."""
    errors = quick_demo("bolted_joint_3d").report["errors"]
    assert abs(errors["slip_of_plates"]) <= 1e-3
    assert abs(errors["slip_of_joint"]) <= 5e-3
    assert abs(errors["pretension_of_springs"]) <= 0.2


def test_forces_of_ironing_balance(quick_demo):
    """What holds the slab takes what the die does; the die piles the slab up before it."""
    errors = quick_demo("ironing_3d").report["errors"]
    assert errors["balance"] <= 1e-3
    assert 0.3 < errors["force_along_over_force_down"] < 0.4


def test_tools_balance_and_a_drawn_sheet_springs_back(quick_demo):
    errors = quick_demo("deep_drawing_2d").report["errors"]
    assert abs(errors["balance_of_tools"]) <= 1e-4
    assert abs(errors["balance_of_work"]) <= 0.25  # two steps: the work is a rough sum
    assert 0.5 < errors["springback_degrees"] < 3.0


@pytest.mark.parametrize(
    "words", [["--quick"], pytest.param([], marks=pytest.mark.slow)], ids=["quick", "default"]
)
def test_a_half_ball_of_rubber_is_right_to_a_hundred_thousandth_of_its_radius(words, comm):
    """Beside tight tolerances; at the demo's own few tangents a load step and multiplications."""
    made = demos.scene("rubber_pressed_3d", words, "NonlinearContactProblem")
    u, down, ends = made["u"], made["bcs"][0].g, []
    for options in (made.pop("petsc_options"), {"tfeti_rtol": 1e-8}):
        u.x.array[:], found, reports = 0.0, [], []
        problem = tfeti.NonlinearContactProblem(**made, petsc_options=options)
        for depth in np.linspace(0.0, 0.4, 3 if words else 9)[1:]:
            down.value[2] = -depth
            problem.solve()
            problem.accept()
            found.append(np.array(u.x.array))
            reports.append(problem.report)
        ends.append((np.array(found), reports))
    (found, reports), (tight, _) = ends
    assert comm.allreduce(float(np.abs(found - tight).max(initial=0.0)), op=MPI.MAX) <= 1e-5
    assert max(report.assemblies for report in reports) <= 5
    assert sum(report.F_multiplications for report in reports) <= 548
