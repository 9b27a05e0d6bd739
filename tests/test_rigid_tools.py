"""Rigid bodies that move by a law, or under a force: closed forms, statics, and each other."""

import csv
import dataclasses

import numpy as np
import pytest
import ufl
from bodies import clamped, drawn, held, torn_boxes
from dolfinx import fem
from panels import SPACE, polygon
from scenes import accepted, apart, decomposed, elastic, hooke, largest, strain, unknowns, vectors

import tfeti_dolfinx as tfeti
from benchmarks.stress.laws import neo_hooke
from tfeti_dolfinx.contact.rigid_body import Pose, motion_fields

CELLS = {2: "triangle", 3: "tetrahedron"}
TIGHT = {"rtol": 1e-10}
DX = ufl.dx(metadata={"quadrature_degree": 2})
ROUGH = tfeti.Coulomb(0.3)
DOWN = {2: np.array((0.0, -1.0)), 3: np.array((0.0, 0.0, -1.0))}


def block(gdim, degree=1, n=6, hold=clamped, nu=0.3):
    """Unit square or cube on its bottom, elastic with E = 1."""
    d = decomposed(CELLS[gdim], n, 4)
    V, u, v = vectors(d, degree)
    given = {"a": elastic(u, v, nu=nu), "L": ufl.ZeroBaseForm((v,)), "decomposition": d}
    return {**given, "bcs": hold(d, "bottom")(V)}


def top(gdim, height=1.0):
    """Half space that lies on the block."""
    return tfeti.Plane(-height * DOWN[gdim], normal=tuple(DOWN[gdim]))


def ball(gdim, radius=1.0, offset=0.0):
    """Ball that touches the top, beside the middle."""
    return tfeti.Sphere(np.array([0.5 + offset, *[0.5] * (gdim - 2), 1.0 + radius]), radius)


def solved(scene, *contacts, **options):
    problem = tfeti.ContactProblem(**scene, contacts=contacts, petsc_options={**TIGHT, **options})
    problem.solve()
    return problem


def same(one, other, to=1e-9):
    """Whether two displacements agree."""
    return apart(other.u.x.array, one.u.x.array) <= to


@pytest.mark.parametrize("gdim", [2, 3])
def test_a_tool_by_displacement_is_an_obstacle_that_lies_there(gdim):
    scene, down = block(gdim, n=4), 0.03 * DOWN[gdim]
    there = solved(scene, tfeti.Obstacle("top", top(gdim, 0.97)))
    moved = solved(scene, tfeti.Obstacle("top", top(gdim), displacement=down, name="punch"))
    assert same(there, moved, 1e-12)
    tool, contact = moved.solution.tool("punch"), there.solution.contact(0)
    assert np.allclose(tool.displacement, down)
    assert np.allclose(tool.resultant.force, -contact.resultant.force, rtol=1e-11)
    assert np.abs(moved.solution.contact(0).gap).max(initial=0.0) <= 1e-10
    assert "  tools     moved: punch (0, " in str(moved.report)
    with pytest.raises(tfeti.InputError, match="tool 3: there is none; .* of 0: punch; name="):
        moved.solution.tool(3)


def test_another_displacement_needs_neither_rows_nor_factors():
    scene = block(2)
    way = fem.Constant(scene["decomposition"].mesh, 0.02 * DOWN[2])
    problem = solved(scene, tfeti.Obstacle("top", ball(2), displacement=way))
    way.value[:] = 0.03 * DOWN[2]
    problem.solve()
    report = problem.report
    assert report.searches == report.gluings == report.factorizations == 0
    assert report.coarse_factorizations == report.assemblies == 0
    again = solved(scene, tfeti.Obstacle("top", ball(2), displacement=0.03 * DOWN[2]))
    assert same(problem, again)


@pytest.mark.parametrize("gdim", [2, 3])
@pytest.mark.parametrize("friction", [None, ROUGH])
def test_a_force_moves_a_tool_as_far_as_its_displacement_has_needed(gdim, friction):
    scene, way = block(gdim), 0.03 * DOWN[gdim]
    law = tfeti.Obstacle("top", ball(gdim), displacement=way, friction=friction, name="ball")
    by_law = solved(scene, law)
    rounding = 1e-18  # as a vector has that was turned
    force = np.where(way != 0.0, -by_law.solution.tool("ball").resultant.force, rounding)
    pressed = tfeti.RigidBody(ball(gdim), force=force, free=("xyz"[gdim - 1],), name="ball")
    by_force = solved(scene, tfeti.Obstacle("top", pressed, friction=friction))
    assert same(by_law, by_force)
    assert np.allclose(by_force.solution.tool("ball").displacement, way, rtol=1e-8)
    assert by_force.report.kernel_dim == by_law.report.kernel_dim + 1
    # its start knows as well which rows touch
    assert by_force.report.F_multiplications <= by_law.report.F_multiplications + 2


@pytest.mark.parametrize("gdim", [2, 3])
def test_an_eccentric_force_tilts_a_punch_as_in_closed_form(gdim):
    """σ = E(a + bx) along z of a block on rollers: u_z = (a + bx)z, u_x = −bz²/2, without ν.

    The force F at the eccentricity e within the core needs a = F/(EA) and b = Fe/(EI). Multipliers
    have no linear pressure: an error of h². It may be given at a far point, with its moment.
    """
    scene = block(gdim, degree=2, n=8 if gdim == 2 else 4, hold=held, nu=0.0)
    force, e = 0.02, 0.1
    at = np.array([0.5 + e, *[0.5] * (gdim - 2), 1.0])
    free = ("y", "rz") if gdim == 2 else ("z", "rx", "ry")
    punch = tfeti.RigidBody(top(gdim), force=force * DOWN[gdim], free=free, point=at, name="punch")
    problem = solved(scene, tfeti.Obstacle("top", punch))
    b, tool = 12.0 * force * e, problem.solution.tool("punch")
    angle = tool.rotation[2] if gdim == 2 else -tool.rotation[1]
    assert np.isclose(angle, -b, rtol=1e-3 if gdim == 2 else 4e-3)  # of u_z = −(F + bx)z
    assert np.isclose(tool.displacement[-1], -force - b * e, rtol=1e-3)
    assert np.allclose(tool.resultant.force, -force * DOWN[gdim], atol=1e-9 * force)
    assert np.abs(tool.resultant.moment).max() <= 1e-9 * force
    support, arm = problem.solution.reaction("bottom"), [*at, 0.0][:3]
    assert np.allclose(support.force, tool.resultant.force, atol=1e-9 * force)
    about_origin = np.cross(arm, [*tool.resultant.force, 0.0][:3])
    assert np.allclose(support.moment, about_origin, atol=1e-8 * force)
    turn = tool.rotation[2] if gdim == 2 else tool.rotation
    law = tfeti.RigidBody(top(gdim), displacement=tool.displacement, rotation=turn, point=at)
    by_law = solved(scene, tfeti.Obstacle("top", law))
    assert np.isclose(by_law.solution.tool(0).resultant.force[-1], force, rtol=1e-8)
    far, moment = [at[0] + 1e5, *at[1:]], 1e5 * force * (1.0 if gdim == 2 else -np.eye(3)[1])
    punch = dataclasses.replace(punch, point=far, moment=moment)
    by_far = solved(scene, tfeti.Obstacle("top", punch))
    assert same(problem, by_law)
    assert same(problem, by_far, 1e-7)


def test_one_tool_on_two_surfaces_has_the_statics_of_a_beam():
    """Its force at a quarter of the way is borne by three quarters there, whatever bends."""
    scene = block(2, n=8)

    def way(x):
        return np.stack((x[0] - (x[0] >= 0.5), x[1] - 1.5, 0 * x[0]))

    shapes = tfeti.SignedDistance(lambda x: np.linalg.norm(way(x), axis=0) - 0.5, way)
    bridge = tfeti.RigidBody(shapes, force=(0, -0.01), free=("y", "rz"), point=(0.25, 1.0))
    data = solved(scene, tfeti.Obstacle("top", bridge)).solution.contact(0)
    left, comm = data.points[:, 0] < 0.5, scene["decomposition"].comm
    forces = [comm.allreduce(float(data.force[side].sum())) for side in (left, ~left)]
    (x, y), (right, up) = (data.points[:, :2] - (0.25, 1.0)).T, data.force * data.normal.T
    assert abs(comm.allreduce(float(np.sum(x * up - y * right)))) <= 1e-11
    assert 2.5 <= forces[0] / forces[1] <= 3.5


def test_a_tool_that_nothing_balances_is_named():
    for words, law in (
        ("translation in y", {"force": (0, 1.0), "free": ("y",)}),
        ("translation in x", {"force": (0.1, -1.0), "free": ("x", "y")}),
        ("rotation in the plane", {"moment": -1.0, "free": ("rz",), "point": (9.0, 1.0)}),
    ):
        tool = tfeti.RigidBody(top(2), name="punch", **law)
        with pytest.raises(tfeti.NoSolutionError, match=f"punch.*{words}"):
            solved(block(2, n=3), tfeti.Obstacle("top", tool))


@pytest.mark.parametrize("law", [ROUGH, tfeti.Tresca(0.03)])
def test_a_free_tool_rubs_on_nodes_that_are_held_along_the_surface(law):
    """Friction of the others alone would not hold it."""
    scene, force = block(2, n=4, hold=lambda d, side: held(d, side, "left")), (0.028, -0.1)
    tool = tfeti.RigidBody(top(2), force=force, free=("x", "y"))
    found = solved(scene, tfeti.Obstacle("top", tool, friction=law)).solution.tool(0)
    assert np.allclose(found.resultant.force, np.negative(force), rtol=0, atol=1e-10)


def test_motions_that_nothing_resists_or_drives_are_free():
    free = tfeti.RigidBody(top(2), force=(0, -0.01), free=("x", "y"), name="punch")
    problem = solved(block(2, n=3), tfeti.Obstacle("top", free))
    assert problem.report.free_modes == 1
    assert abs(problem.solution.tool(0).displacement[0]) <= 1e-14


def test_a_far_tool_falls_until_it_touches():
    scene = block(2)
    shapes = ball(2), tfeti.Sphere((0.5, 2.7), 1.0)
    law = {"force": 0.01 * DOWN[2], "free": ("y",)}
    found = [solved(scene, tfeti.Obstacle("top", tfeti.RigidBody(s, **law))) for s in shapes]
    ways = [problem.solution.tool(0).displacement[1] for problem in found]
    assert np.isclose(ways[1], ways[0] - 0.7, rtol=1e-9)
    assert same(*found)


@pytest.mark.parametrize("law", [tfeti.Coulomb(0.4), tfeti.Tresca(0.003)])
def test_friction_knows_only_the_relative_motion(law):
    """A tool that is dragged along, and a block that is drawn back under it."""
    scene, ends = block(2), []
    decomposition = scene["decomposition"]
    W = scene["a"].arguments()[0].ufl_function_space()
    pressed = np.array((0.0, -0.03))
    for moves in ("tool", "block"):
        way, below = (fem.Constant(decomposition.mesh, (0.0, 0.0)) for _ in range(2))
        given = {**scene, "bcs": clamped(decomposition, ("bottom", below))(W)}
        contacts = [tfeti.Obstacle("top", ball(2), displacement=way, friction=law)]
        problem = tfeti.ContactProblem(**given, contacts=contacts, petsc_options=TIGHT)
        for x in (0.0, 0.002, 0.02, 0.01):
            along = np.array((x, 0.0))
            way.value[:] = pressed + (along if moves == "tool" else 0.0)
            below.value[:] = -along if moves == "block" else 0.0
            accepted(problem)
        ends.append((problem.u.x.array.reshape(-1, 2) - below.value, problem.solution))
    (one, solution), (other, _) = ends
    assert np.abs(one - other).max(initial=0.0) <= 1e-9
    assert solution.tool(0).resultant.force[0] != 0.0


def test_large_motions_place_the_tool_anew():
    """A surface may turn away from one that has passed, which may come back."""
    scene, shape = block(2, n=8), ball(2, radius=0.3)
    way, turn = (fem.Constant(scene["decomposition"].mesh, at) for at in ((0.2, -0.03), 0.0))
    tool = tfeti.RigidBody(shape, displacement=way, rotation=turn, large=True)
    problem = solved(scene, tfeti.Obstacle("top", tool))
    for *to, turn.value in ((0.2, -0.03, 0.0), (-0.25, -0.02, 0.4), (0.2, -0.03, 0.0)):
        way.value = to
        problem.solve()
        there = tfeti.Sphere(shape.centre[:2] + to, 0.3)
        assert same(solved(scene, tfeti.Obstacle("top", there)), problem, 1e-11)
        way.value = (5.0, -3.0)
        problem.solve()
        assert largest(problem.u.x.array) <= 1e-12


def test_a_wheel_that_turns_drags_along():
    """Its surface slips wherever the wheel was before; the second of two turns changes nothing."""
    scene = block(2, n=8)
    angle = fem.Constant(scene["decomposition"].mesh, 0.0)
    wheel = tfeti.RigidBody(ball(2, 0.5), rotation=angle, displacement=0.02 * DOWN[2], large=True)
    contact = tfeti.Obstacle("top", wheel, friction=tfeti.Tresca(0.01))
    problem, drags = tfeti.ContactProblem(**scene, contacts=[contact], petsc_options=TIGHT), []
    for angle.value in (0.0, 0.004, 3.0, 3.1, 3.0):
        accepted(problem)
        drags.append(problem.solution.tool(0).resultant.force[0])
    begun, all_slips, still, back = drags[1:]
    assert all_slips < begun < 0.0 < back
    assert np.isclose(all_slips, still)


def test_load_steps_take_laws_of_time_and_write_a_table(tmp_path):
    scene = block(2)
    comm = scene["decomposition"].comm
    tool = tfeti.RigidBody(ball(2), displacement=lambda t: (0.0, -0.04 * t), name="ball")
    problem = tfeti.ContactProblem(**scene, contacts=[tfeti.Obstacle("top", tool)])
    steps = tfeti.LoadSteps(problem, lambda problem, t: None, [0.25, 0.5, 1.0])
    records = steps.run()
    assert [r.tools["ball displacement y"] for r in records] == [-0.01, -0.02, -0.04]
    forces = [r.tools["ball force y"] for r in records]
    assert problem.time == 1.0
    assert forces == sorted(forces)
    path = comm.bcast(str(tmp_path / "curve.csv"))
    steps.write_csv(path)
    if comm.rank == 0:
        with open(path) as file:
            rows = list(csv.DictReader(file))
        assert [float(row["ball force y"]) for row in rows] == forces
    comm.Barrier()
    tool = tfeti.RigidBody(ball(2), force=lambda t: (0.0, -t * forces[-1]), free=("y",), name="b")
    problem = tfeti.ContactProblem(**scene, contacts=[tfeti.Obstacle("top", tool)])
    back = tfeti.LoadSteps(problem, lambda problem, t: None, [0.25, 0.5, 1.0]).run()
    counts = [[r.figures["F_multiplications"] for r in run] for run in (records, back)]
    assert sum(counts[1]) < sum(counts[0])  # products with multiples of a solution are known
    assert np.isclose(back[-1].tools["b displacement y"], -0.04, rtol=1e-5)


def test_a_tool_that_hits_is_a_body_that_falls():
    """Galilei: a plane, by a law or far heavier, and a square that has the opposite velocity."""
    scene, speed, found = {**block(2, n=4), "bcs": []}, 0.2, []
    V = scene["a"].arguments()[0].ufl_function_space()
    for moves in ("tool", "body", "hammer"):
        begin = fem.Function(V)
        begin.x.array.reshape(-1, 2)[:, 1] = speed if moves == "body" else 0.0
        law = (lambda t: (0.0, -speed * t)) if moves == "tool" else (0.0, 0.0)
        heavy = {"mass": 1e12, "velocity": (0, -speed), "free": ("y",)} if moves == "hammer" else {}
        tool = tfeti.RigidBody(top(2, 1.05), displacement=law, **heavy)
        given = {"mass": 1.0, "velocity": begin, "stabilised": True, "petsc_options": TIGHT}
        given["contacts"] = [tfeti.Obstacle("top", tool, reach=0.01)]
        problem = tfeti.ContactDynamics(**scene, **given)
        records = tfeti.LoadSteps(problem, lambda problem, t: None, np.linspace(0.1, 1.0, 10)).run()
        assert max(abs(r.tools["tool of surface 'top' force y"]) for r in records) > 0.0
        shift = 0.0 if moves == "body" else speed * 1.0
        forces = [record.contact_forces[0] for record in records]
        found.append(np.vstack((problem.u.x.array.reshape(-1, 2) + (0.0, shift), forces)))
    assert all(np.abs(x - found[1]).max(initial=0.0) <= 1e-9 for x in found)


def test_poses_are_rigid():
    rng = np.random.default_rng(0)
    for gdim in (2, 3):
        x, point = rng.standard_normal((5, gdim)), rng.standard_normal(gdim)
        q = rng.standard_normal(3 if gdim == 2 else 6)
        pose = Pose(point, q, finite=True)
        moved = x + pose.displacement(x)
        sizes = [np.linalg.norm(y[:, None] - y[None], axis=2) for y in (x, moved)]
        assert np.allclose(*sizes)
        assert np.allclose(moved - pose.way_to(moved), x)
        step = 1e-7 * rng.standard_normal(len(q))
        way = pose.moved(step).displacement(x) - pose.displacement(x)
        fields = motion_fields(moved - pose.centre)
        assert np.allclose(way, np.einsum("nkg,k->ng", fields, step), atol=1e-12)
        small = Pose(point, step, finite=False).displacement(x)
        fields = motion_fields(x - point)
        assert np.allclose(small, np.einsum("nkg,k->ng", fields, step), rtol=1e-12, atol=1e-20)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"force": (0, -1)}, "no free motion"),
        ({"force": (0, -1), "free": ("w",)}, "free="),
        ({"force": (1, -1), "free": ("y",)}, "part along x"),
        ({"displacement": (0, -1), "free": ("y",)}, "part along y"),
        ({"displacement": (0, -1, 0)}, "2 finite"),
        ({"displacement": lambda t: "down"}, "displacement"),
        ({"free": ("rx",)}, "in 2D"),
        ({"displacement": (0, np.nan)}, "2 finite"),
        ({"point": (0, 0, 0)}, "2 components"),
        ({"free": ("y",), "large": True}, "large=True"),
        ({"free": ("y",), "mass": 1.0}, "a mass in a problem without"),
        ({"free": ("y", "rz"), "mass": 1.0}, "rz is free and has no moment of inertia"),
        ({"free": ("y",), "mass": 1.0, "velocity": (1, 0)}, "a part along x, which is not free"),
        ({"free": ("y",), "velocity": (0, 1)}, "and no mass; expected mass="),
        ({"mass": 1.0}, "a mass, and no free motion"),
    ],
)
def test_what_does_not_fit_is_named(given, words):
    with pytest.raises(tfeti.InputError, match=words):
        body = tfeti.RigidBody(top(2), name="punch", **given)
        solved(block(2, n=2), tfeti.Obstacle("top", body))


def test_tools_inside_of_a_body_or_of_one_name_are_named():
    tool = tfeti.RigidBody(top(2, 0.9), displacement=(0, 0), name="punch")
    with pytest.raises(tfeti.InputError, match="punch is inside of 'top'.*in small strain gap="):
        solved(block(2, n=2), tfeti.Obstacle("top", tool))
    solved(block(2, n=2), tfeti.Obstacle("top", tool, gap=-0.1))  # meant
    tools = [tfeti.RigidBody(top(2), displacement=(0, 0), name="punch") for _ in range(2)]
    with pytest.raises(tfeti.InputError, match="different"):
        solved(block(2, n=2), *(tfeti.Obstacle("top", tool) for tool in tools))


def nonlinear(finite, tool, friction=None):
    """Problem of a tool on a block: J2 in small strain, neo-Hooke in finite strain."""
    decomposition = decomposed("triangle", 6, 4)
    V, u, v, _ = unknowns(decomposition)
    if finite:
        residual = ufl.derivative(neo_hooke(u, 1.0, 0.3) * DX, u, v)
    else:
        elastic = tfeti.Elasticity(decomposition, E=1.0, nu=0.3, model="plane_strain")
        residual = tfeti.J2Plasticity(elastic, u, yield_stress=0.05, hardening=0.1).residual(v)
    contacts = [tfeti.Obstacle("top", tool, friction=friction)]
    given = u, clamped(decomposition, "bottom")(V), contacts, decomposition
    more = {"finite": finite, "petsc_options": {"rtol": 1e-9}}
    return tfeti.NonlinearContactProblem(residual, *given, **more)


def pressed(finite, shape, **given):
    """Solution of one load step, whose tool acts about the middle of the top."""
    tool = tfeti.RigidBody(shape, name="tool", **{"point": (0.5, 1.0), **given})
    problem = nonlinear(finite, tool)
    tfeti.LoadSteps(problem, lambda problem, t: None, [1.0]).run()
    assert problem.report.newton_steps > 1
    return problem, problem.solution.tool("tool")


@pytest.mark.parametrize("finite", [False, True])
@pytest.mark.parametrize(
    ("shape", "free", "x"), [(ball(2, radius=0.8), ("y",), 0.5), (top(2), ("y", "rz"), 0.6)]
)
def test_nonlinear_bodies_under_a_tool_by_force_and_by_displacement(shape, free, x, finite):
    """A plate finds its tilt: no moment about the force, off the middle, is left."""
    given = {"point": (x, 1.0)}
    one, by_force = pressed(finite, shape, force=(0.0, -0.06), free=free, **given)
    assert np.isclose(by_force.resultant.force[1], 0.06, rtol=1e-7)
    if "rz" in free:
        assert by_force.rotation[2] < -0.02
        assert abs(by_force.resultant.moment[2]) <= 1e-8
    given |= {"displacement": lambda t: t * by_force.displacement[:2]}
    other, by_law = pressed(finite, shape, rotation=by_force.rotation[2], **given)
    assert same(one, other, 1e-6)
    assert np.isclose(by_law.resultant.force[1], 0.06, rtol=1e-7)


@pytest.mark.parametrize("finite", [False, True])
def test_a_tool_that_no_nonlinear_body_balances_is_named(finite):
    """And rows that were looked for in vain go, with their friction."""
    law = {"displacement": (0.02, 0.0), "force": lambda t: (0.0, 0.01 - t)}
    tool = tfeti.RigidBody(ball(2), name="punch", free=("y",), **law)
    problem, fresh = (nonlinear(finite, tool, tfeti.Tresca(0.01)) for _ in range(2))
    with pytest.raises(tfeti.NoSolutionError, match="punch.*translation in y"):
        problem.solve()
    for p in (problem, fresh):
        p.time = 0.06
        p.solve()
    assert same(problem, fresh, 1e-7)


@pytest.mark.parametrize("way", [0.55, 0.6])
def test_a_ball_that_rolls_off_a_block_in_a_step_asks_for_smaller_ones(way):
    law = {"displacement": lambda t: (way * t, 0.0), "force": (0.0, -0.2), "free": ("y",)}
    accepted(problem := nonlinear(True, tfeti.RigidBody(ball(2, 0.5), **law)))
    problem.time = 1.0
    with pytest.raises(tfeti.ConvergenceError, match="only contact.*; or smaller load"):
        problem.solve()


@pytest.mark.parametrize("finite", [False, True])
@pytest.mark.parametrize("weight", [0.0, 1e-14, 0.01])
@pytest.mark.parametrize("reach", [None, 5.0])
def test_a_body_that_was_pushed_stays_when_tools_go_back(reach, weight, finite):
    """Nothing else drives it: its motion counts from where it is, beside what another tool does."""
    decomposition = decomposed("triangle", 6, 4)
    V, u, v, _ = unknowns(decomposition)
    law = neo_hooke(u, 1.0, 0.3) if finite else 0.5 * ufl.inner(hooke()(u), strain(u))
    energy = law + fem.Constant(decomposition.mesh, weight) * u[1]
    ways = [fem.Constant(decomposition.mesh, (0.0, 0.0)) for _ in range(2)]
    tools = [
        tfeti.Obstacle(side, tfeti.Plane((0, 0), normal), displacement=way, reach=reach)
        for side, normal, way in zip(("left", "bottom"), np.eye(2), ways, strict=True)
    ]
    F = ufl.derivative(energy * DX, u, v)
    problem = tfeti.NonlinearContactProblem(F, u, [], tools, decomposition, finite=finite)
    for right, up, x, y in ((0.5, 0, 0.5, 0), (1, 0, 1, 0), (0.8, 0.2, 1, 0.2), (0, 0, 1, 0.2)):
        ways[0].value[0], ways[1].value[1] = right, up
        accepted(problem)
        assert np.allclose(u.x.array.reshape(-1, 2), (x, up if weight else y), atol=0.02)


def test_a_tool_without_mass_is_named_in_dynamics():
    scene, named = {**block(2, n=2), "mass": 1.0}, "in a problem of bodies with mass; expected its"
    contacts = [tfeti.Obstacle("top", tfeti.RigidBody(top(2), force=(0, -1), free=("y",)))]
    with pytest.raises(tfeti.InputError, match=named):
        tfeti.ContactDynamics(**scene, contacts=contacts)
    v, _ = scene.pop("a").arguments()[0], scene.pop("L")
    u = fem.Function(v.ufl_function_space())
    F = ufl.derivative(neo_hooke(u, 1.0, 0.3) * DX, u, v)
    with pytest.raises(tfeti.InputError, match=named):
        tfeti.NonlinearContactDynamics(F, u, contacts=contacts, finite=True, **scene)


def test_a_tool_that_is_lifted_leaves_an_elastic_body_at_rest():
    """u = 0 has no size that an increment could be small beside; nearly 0 has rounding of X + u."""
    ways = [(0.0, 0.0), (0.02, -0.08), (0.01, 1e-3), (0.0, 0.0), (0.01, 1e-3)]
    tool = tfeti.RigidBody(top(2), displacement=lambda t: ways[int(t)], name="punch")
    problem = nonlinear(True, tool, tfeti.Coulomb(0.2))
    tfeti.LoadSteps(problem, lambda problem, t: None, [1.0, 2.0, 3.0, 4.0]).run()
    assert largest([*problem.u.x.array, *problem.solution.tool("punch").resultant.force]) < 1e-12
    fy = (0.0, -1e-2, -1e-9, -1e-2, -1e-12, -1e-2)
    tool = tfeti.RigidBody(ball(2), force=lambda t: (0.0, fy[int(t)]), free=("y",), name="b")
    records = tfeti.LoadSteps(nonlinear(True, tool), lambda problem, t: None, range(1, 6)).run()
    y = [record.tools["b displacement y"] for record in records]
    assert np.allclose((y[1], y[0]), (1e3 * y[3], y[4]), rtol=1e-3, atol=0.0)


def test_a_free_body_that_friction_has_held_is_let_go():
    """Pressed by a lid, drawn along, let go beside one with a load, pressed again; and resumed."""
    ways, floor = [(0.0, -0.1), (0.02, -0.1), (0.02, 0.1), (0.0, -0.1)], tfeti.Plane((0, 0), (0, 1))
    for cell, mu, shape in (("triangle", 0.5, top(2)), ("quadrilateral", 0.2, ball(2, offset=0.2))):
        parts = [("a", (0.0, 0.0), (1.0, 1.0), (6, 6)), ("b", (2.0, 0.0), (3.0, 1.0), (3, 3))]
        d = torn_boxes(cell, parts, 5)
        V, _, v = vectors(d)
        u, law, states, let_go = fem.Function(V), {"friction": tfeti.Coulomb(mu)}, {}, []
        lid = tfeti.RigidBody(shape, displacement=lambda t: ways[int(t)], name="lid")
        tools = [tfeti.Obstacle("a bottom", floor, **law), tfeti.Obstacle("a top", lid, **law)]
        tools.append(tfeti.Obstacle("b bottom", floor))
        F = ufl.derivative(neo_hooke(u, 1.0, 0.3) * DX, u, v)
        F -= drawn(d, "b top", (0.0, -1e-6))(v, ufl.Measure("ds", subdomain_data=d.facet_tags))
        for begin in (0, 2):
            problem = tfeti.NonlinearContactProblem(F, u, [], tools, d, finite=True)
            problem.time = begin - 1.0
            if begin:
                problem.restore(states[begin - 1])
            for t in range(begin, 4):
                problem.time = float(t)
                accepted(problem)
                states[t] = problem.state()
                *forces, light = (problem.solution.contact(i).resultant.force for i in range(3))
                assert largest(np.add(*forces)) <= 1e-9
                assert largest(light[:2] - (0.0, 1e-6)) <= 1e-12
                assert (largest(forces) <= 1e-12) == (t == 2)
                if t == 2:
                    let_go.append(np.array(u.x.array))
                    assert largest([*let_go[-1], problem.report.F_multiplications / 1e4]) < 0.05
        assert max(apart(other, let_go[0]) for other in let_go) <= 1e-6


def test_what_jaws_have_carried_stays_where_they_let_it_go():
    """But for the turn that an uneven mesh springs back by; in small and in finite strain."""
    ways, jaws, states = [(0.05, 0.0, 0.0), (0.05, 0.05, 0.0), (-0.05, 0.05, 0.0)], [], {}
    V, u, v = vectors(d := decomposed("hexahedron", 3, 4))
    for name, side in (("left", 1.0), ("right", -1.0)):
        motion = {"displacement": lambda t, side=side: ways[int(t)] * np.array((side, 1, 1))}
        plane = tfeti.Plane((0.5 - 0.5 * side, 0, 0), (side, 0, 0))
        jaw = tfeti.RigidBody(plane, **motion, name=name)
        jaws.append(tfeti.Obstacle(name, jaw, friction=tfeti.Coulomb(0.4)))
    a, w = elastic(u, v), fem.Function(V)
    F = ufl.derivative(neo_hooke(w, 1.0, 0.3) * DX, w, v)
    small = tfeti.ContactProblem(a, ufl.ZeroBaseForm((v,)), [], jaws, d, petsc_options=TIGHT)
    for problem in (small, tfeti.NonlinearContactProblem(F, w, [], jaws, d, finite=True)):
        for begin in (0, 1):
            for problem.time in range(begin, 3):
                accepted(problem)
                states[problem.time] = problem.state()
            assert apart(problem.u.x.array.reshape(-1, 3), [[0, 0.05, 0]]) <= 0.02
            assert problem.report.F_multiplications <= 60
            problem.restore(states[0])  # laws still are those of the last step


SIDES = {2: polygon([(0, 0), (1, 0), (1, 1), (0, 1)], 1), 3: SPACE["cube"](1)}  # of unit bodies


def test_distance_from_a_mesh_is_that_of_its_body():
    """Of a square and a cube exactly, next to sides, edges and corners too; of a ball with h²."""
    rng, step = np.random.default_rng(0), 1e-6
    for gdim, panels in SIDES.items():
        a, b, c = *panels.nodes[0, :2], len(panels.x)  # facets as thin as rounding do not count
        corners = np.vstack((panels.x, panels.x[[a, b]].mean(axis=0) + 1e-10))
        flat = [(a, a)] if gdim == 2 else [(a, a, b), (a, b, c)]
        mesh = tfeti.SurfaceMesh(corners, [*panels.nodes, *flat])
        p = rng.uniform(-0.6, 1.6, (3, 400))
        x = p[:gdim]
        out = np.maximum(np.maximum(-x, x - 1.0), 0.0)
        inside = np.min(np.minimum(x, 1.0 - x), axis=0)
        expected = np.where(inside > 0.0, -inside, np.linalg.norm(out, axis=0))
        assert np.allclose(mesh.distance(p), expected, atol=1e-12)
        ways = step * np.eye(3)[:, :, None]
        slope = [(mesh.distance(p + d) - mesh.distance(p - d)) / (2 * step) for d in ways]
        assert np.median(np.abs(mesh.gradient(p) - slope)) <= 1e-8
        assert mesh.gradient(p[:, :0]).shape == (3, 0)
    ball = tfeti.SurfaceMesh((panels := SPACE["ball"](12)).x, panels.nodes)
    p = rng.standard_normal((3, 200))
    assert np.abs(ball.distance(p) - np.linalg.norm(p, axis=0) + 1.0).max() <= 0.02
    # inside, below a vertex of a disc, no side is chosen
    turn = np.stack((np.cos(angle := np.arange(60) * np.pi / 30), np.sin(angle)), axis=1)
    lines = np.stack((np.arange(60), np.roll(np.arange(60), -1)), axis=1)
    found = tfeti.SurfaceMesh(turn, lines).gradient(0.97 * np.pad(turn, ((0, 0), (0, 1))).T)
    assert np.allclose(found[:2].T, turn, atol=1e-12)


def test_a_mesh_presses_as_its_shape_does(tmp_path, comm):
    """A tool from an STL file, beside the sphere that it stands for."""
    scene = block(3, n=4)
    panels, path, forces = SPACE["ball"](24), comm.bcast(tmp_path / "ball.stl"), []
    if comm.rank == 0:
        vertices = 3 * "vertex {:.12g} {:.12g} {:.12g}\n"
        facet = f"facet normal 0 0 0\nouter loop\n{vertices}endloop\nendfacet\n"
        triangles = (panels.x + (0.5, 0.5, 2.0))[panels.nodes].reshape(-1, 9)
        facets = "".join(facet.format(*triangle) for triangle in triangles)
        path.write_text(f"solid ball\n{facets}endsolid ball\n")
    comm.Barrier()
    for shape in (tfeti.read_surface(str(path), comm), ball(3)):
        tool = tfeti.RigidBody(shape, displacement=(0, 0, -0.05))
        forces.append(solved(scene, tfeti.Obstacle("top", tool)).solution.tool(0).resultant.force)
    assert np.isclose(forces[0][2], forces[1][2], rtol=0.03)


@pytest.mark.parametrize("gdim", [2, 3])
def test_a_tool_whose_edges_lie_on_nodes_presses_along_the_normal_of_the_body(gdim):
    """As one does that is a little wider: at an edge the normal is that of the side that meets."""
    x, scene, found = SIDES[gdim].x, block(gdim), []
    for width in (1.0 / 3.0, 0.35):
        corners = width * (x - 0.5) + 0.5 - (0.5 + width / 2.0) * DOWN[gdim]
        shape = tfeti.SurfaceMesh(corners, SIDES[gdim].nodes)
        tool = tfeti.Obstacle("top", shape, displacement=0.02 * DOWN[gdim], friction=ROUGH)
        found.append(solved(scene, tool))
    assert same(*found)


def test_meshes_that_do_not_fit_are_named(comm):
    for points, facets, words in (
        ([(0, 0)], [(0, 1)], "not among 1"),
        ([(0, 0, 0)] * 3, [(0, 1, 2)], "no facet has an extent"),
        ([(0, 0, 0)], [(0, 1)], "expected"),
        ([(0, 0), (1, 0)], [(0.0, 1.0)], "expected finite points, and integers"),
    ):
        with pytest.raises(tfeti.InputError, match=words):
            tfeti.SurfaceMesh(points, facets)
    with pytest.raises(tfeti.InputError, match="no such file"):
        tfeti.read_surface("missing.stl", comm)


def test_a_tool_whose_bounds_of_friction_do_not_come_to_rest_is_named():
    scene = block(2)
    heavy = tfeti.RigidBody(ball(2), displacement=0.03 * DOWN[2], name="heavy")
    beside = tfeti.Sphere((2.0, 0.5), 1.0)
    light = tfeti.RigidBody(beside, force=(-1e-3, 0.0), free=("x",), name="light")
    contacts = [tfeti.Obstacle(*on, friction=ROUGH) for on in (("top", heavy), ("right", light))]
    with pytest.raises(tfeti.ConvergenceError, match="least of all on the body 'light'"):
        solved(scene, *contacts, friction_type="fixed_point", friction_max_it=1)
    solved(scene, *contacts)
