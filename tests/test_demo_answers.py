"""What demos find: closed forms, forces in balance, the laws of friction."""

import numpy as np
import pytest
from scenes import accepted, largest

import demos
import tfeti_dolfinx as tfeti

BOUND = 0.008  # of the friction of four bodies
PAIRS = ("wedge left", "wedge right", "left bottom", "right bottom")
BOLTS = 4 * 30e3  # of both clamps
BARS = [f"{side} bar {i}" for i in (1, 2) for side in ("lower", "upper")]
PEAK = ("half_width", "peak_pressure")
SLIP = {"half_width": 0.05, "stick_half_width": 0.05}
LOOP = {"stick_half_width": 0.05, "stick_after_turns": 0.05, "dissipation": 0.05}
LOOP["least_dissipation"] = (-1e-6, np.inf)  # of what a cycle loses


def hertz(force, others):
    return {"force": force, **dict.fromkeys(PEAK, others)}


def partial_slip(others, friction):
    """Of meshes and loads that are mirror images: pressing makes no friction."""
    found = {"half_width": others, "stick_half_width": others, "traction_l2": friction}
    return found | {
        "friction_without_force": 1e-5,
        "force": 1e-6,
        "friction_force": 1e-6,
        "law": 1e-3,
    }


def impact(name, **bounds):
    return {f"{name}_{key}": bound for key, bound in bounds.items()}


# largest errors at the quick size, or least and largest ones
QUICK = {
    "ball_bearing_3d": {"ball_balance": 1e-5, "force": 1e-5, "side_force": 0.02},
    "belt_2d": {"capstan": 0.01, "capstan_hung": 0.01, "capstan_thin": 0.01},
    "bolted_joint_3d": {
        "slip_of_plates": 1e-3,
        "slip_of_joint": 5e-3,
        "pretension_of_springs": 0.2,  # springs of handbooks are a rough guide
    },
    "bouncing_bar": {"first_begin": 0.01, "first_end": 0.03, "first_pressure": 0.01},
    "cattaneo_mindlin_2d": partial_slip(0.03, 0.03),
    "clamped_connection_3d": {"force": 1e-5},
    "deep_drawing_2d": {
        "balance_of_tools": 1e-4,
        "balance_of_work": 0.25,  # two steps: the work is a rough sum
        "springback_degrees": (0.5, 3.0),
    },
    "four_bodies_2d": {"force_wedge": 1e-5, "force_base": 1e-5},
    "hertz_2d": hertz(1e-4, 0.02),
    "hertz_3d": hertz(1e-4, 0.05),
    "impact_of_bars": impact(
        "two", pressure=0.01, duration=0.01, oscillates=0.01, velocity=0.03, energy=0.02
    ),
    # the die piles the slab up before it
    "ironing_3d": {"balance": 1e-9, "force_along_over_force_down": (0.3, 0.4)},
    "mindlin_3d": partial_slip(0.15, 0.25),
    "sphere_on_block_3d": hertz(1e-4, 0.05),
    "stacked_blocks_3d": {"force_base": 1e-5},
    "unloading_2d": LOOP,
}
TIGHT = ["-tfeti_rtol", "1e-8"]
# the same with arguments
OTHERS = [
    ("cylinder_on_block_2d", TIGHT, hertz(1e-8, 0.03)),
    ("cylinder_on_block_2d", ["--exchange", *TIGHT], hertz(1e-8, 0.03)),
    # half planes against squares whose width is 7 half widths: bodies differ by percents
    ("talk_hertz_2d", TIGHT, hertz(1e-6, 0.03)),
]
SLOW = [
    ("belt_2d", [], {"capstan": 1e-3, "capstan_hung": 1e-3}),
    ("cattaneo_mindlin_2d", ["--refine", 2], {"half_width": 0.01, "stick_half_width": 0.01}),
    ("hertz_2d", TIGHT, hertz(1e-6, 0.02)),
    ("hertz_3d", TIGHT, hertz(1e-6, 0.05)),
    ("mindlin_3d", [], SLIP),
    ("unloading_2d", [], {**LOOP, "dissipation": 0.01}),
    # a contact that is small beside the ball, a/R = 0.056, and smooth
    (
        "falling_balls_3d",
        ["--balls=1", "--modulus=4e7", "--fine=0.015", "--gap=0.01", "--end=0.01"]
        + ["--steps=30", "--smooth"],
        {"force": 0.05, "duration": 0.05},
    ),
]
for name, steps in (("two", 80), ("clamped", 160), ("wall", 80)):  # a step of duration
    bounds = impact(
        name, pressure=0.01, duration=1.01 / steps, oscillates=0.005, energy=(-0.02, 0.0)
    )
    SLOW.append(("impact_of_bars", ["--impact", name, "--cells", 40], bounds))
OTHERS += [pytest.param(*case, marks=pytest.mark.slow) for case in SLOW]


def check(errors, bounds):
    for name, bound in bounds.items():
        low, high = bound if isinstance(bound, tuple) else (-bound, bound)
        assert low <= errors[name] <= high, name


@pytest.mark.parametrize("name", QUICK)
def test_errors_at_the_quick_size(quick_demo, name):
    check(quick_demo(name).report["errors"], QUICK[name])


@pytest.mark.parametrize(("name", "arguments", "bounds"), OTHERS)
def test_errors_at_other_sizes(name, arguments, bounds):
    check(demos.run(name, arguments)[1].errors, bounds)


def test_the_energy_defect_of_a_loop_halves_with_the_step(quick_demo):
    one = quick_demo("unloading_2d").report["errors"]
    _, report = demos.run("unloading_2d", ["--quick", "--steps", 2])
    check(report.errors, LOOP)
    assert abs(report.errors["energy_defect"]) <= 0.5 * abs(one["energy_defect"])


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
    rubbing = data.status != tfeti.ContactStatus.OPEN
    # from the held side on the right to the pulled one: the way in which the belt slips
    along = np.stack((-data.points[:, 1], data.points[:, 0]), axis=1)
    assert report["sticking"] == 0
    assert comm.allreduce(int(np.sum(rubbing))) == report["sliding"] > 30
    assert np.all(np.sum(data.slip * along, axis=1)[rubbing] < 0.0)
    assert np.all(np.sum(data.tangential_traction * along, axis=1)[rubbing] > 0.0)


def test_friction_holds_the_load_and_the_bolts_press(quick_demo, comm):
    found = quick_demo("clamped_connection_3d")
    solution, report = found.solution, found.report
    assert report["bodies"] == 6
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
    assert report["sticking"] > 0
    for name in PAIRS:
        size, slips = check_friction(solution.contact(name), BOUND * (1.0 + 1e-9))
        assert np.allclose(size[slips], BOUND, rtol=1e-9, atol=0)
    # both sides do the same
    sides = [solution.contact(name) for name in ("wedge left", "wedge right")]
    force = [comm.allreduce(float(data.force.sum())) for data in sides]
    slipping = [comm.allreduce(int(sum(at.status == tfeti.ContactStatus.SLIP))) for at in sides]
    assert force[0] == pytest.approx(force[1], rel=1e-4)
    assert 0 < slipping[0] == slipping[1]
    assert report["sliding"] >= 2 * slipping[0]


def test_stacked_blocks_are_held_by_contact_alone(quick_demo):
    """Each of the three upper blocks slides and turns freely on its flat sides: 3 modes each."""
    report = quick_demo("stacked_blocks_3d").report
    assert report["bodies"] == 4
    assert report["free_modes"] == 9


@pytest.mark.parametrize(
    ("words", "steps", "most"),  # multiplications of a load step
    [
        (["--quick"], 2, 36),
        (["--size", "0.22"], 4, 31),
        pytest.param([], 8, 68.5, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_a_half_ball_of_rubber_is_right_to_a_hundred_thousandth_of_its_radius(words, steps, most):
    """Beside tight tolerances; at the demo's own few tangents a load step and multiplications."""
    made = demos.scene("rubber_pressed_3d", words, "NonlinearContactProblem")
    u, down, ends = made["u"], made["bcs"][0].g, []
    for options in (made.pop("petsc_options"), {"tfeti_rtol": 1e-8}):
        u.x.array[:], found, reports = 0.0, [], []
        problem = tfeti.NonlinearContactProblem(**made, petsc_options=options)
        for depth in np.linspace(0.0, 0.4, steps + 1)[1:]:
            down.value[2] = -depth
            reports.append(accepted(problem))
            found.append(np.array(u.x.array))
        ends.append((np.array(found), reports))
    (found, reports), (tight, _) = ends
    assert largest(found - tight) <= 1e-5
    assert max(report.assemblies for report in reports) <= 5
    assert sum(report.F_multiplications for report in reports) <= most * steps
