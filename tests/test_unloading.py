"""Paths of loads that come back to zero, or to next to nothing: right at every step."""

import numpy as np
import pytest
from bodies import (
    clamped,
    drawn,
    held,
    no_load,
    sided,
    stacked,
    stiffer_above,
    torn_boxes,
    two_body_problem,
)
from dolfinx import fem
from reference.untorn import on_plane, untorn_box
from scenes import accepted, decomposed, displacement, hooke

import tfeti_dolfinx as tfeti

SIZES = {"triangle": (6, 3), "quadrilateral": (8, 4), "hexahedron": (3, 4), "tetrahedron": (2, 3)}
# clamped and loaded sides; what is clamped on top is moved
KINDS = {"loaded": ("left", "top"), "driven": ("top", "right")}
LAWS = ("none", "tresca", "coulomb", "orthotropic")
PLAIN = {"none": (None, 0.0), "tresca": (tfeti.Tresca(0.003), 0.003)}
DIRECTION = 0.4  # of the first axis of orthotropic friction, from x
STEPS = ("new", "zero", "same", "turned", "tiny", "less", "other tiny")


def law(name, gdim):
    """The law, its semi-axes or coefficients, and the frame that they hold in."""
    normal = -np.eye(gdim)[-1]
    if gdim == 2 or name != "orthotropic":
        given, value = PLAIN.get(name, (tfeti.Coulomb(0.3), 0.3))
        return given, (value,) * (gdim - 1), np.stack((normal, *np.eye(gdim)[:-1]))
    along = np.array([np.cos(DIRECTION), np.sin(DIRECTION), 0.0])
    given = tfeti.Coulomb((0.4, 0.15), direction=along)
    return given, (0.4, 0.15), np.stack((normal, along, np.cross(normal, along)))


class Scene:
    """A box above a plane, a side clamped or moved, another one loaded."""

    def __init__(self, cell, kind="loaded", friction="none", gap=0.0, **options):
        held, loaded = KINDS[kind]
        d = decomposed(cell, *SIZES[cell])
        gdim = self.gdim = d.mesh.geometry.dim
        self.traction, self.value = (fem.Constant(d.mesh, np.zeros(gdim)) for _ in range(2))
        plane = tfeti.Plane((0,) * gdim, (0,) * (gdim - 1) + (1,))
        rubs = law(friction, gdim)[0]
        obstacle = tfeti.Obstacle("bottom", plane, gap=gap, friction=rubs, reach=0.5)
        given = drawn(d, loaded, self.traction), clamped(d, (held, self.value))
        self.problem = two_body_problem(d, *given, [obstacle], **options)

    def solve(self, traction, value=None):
        """Displacements of the nodes, sorted by point."""
        self.traction.value[:] = traction
        self.value.value[:] = 0.0 if value is None else value
        self.problem.solve()
        return displacement(self.problem)[1]


class Reference:
    """The same box in one piece; the law by Newton's method on its dense natural map."""

    def __init__(self, cell, kind, friction, gap):
        held, loaded = KINDS[kind]
        d = 3 if cell in ("tetrahedron", "hexahedron") else 2
        scene = untorn_box(cell, SIZES[cell][0], np.zeros(d), (held,), loaded=loaded)
        _, axes, frame = law(friction, d)
        coulomb = friction in ("coulomb", "orthotropic")
        self.loads, self.met = scene.loads(loaded), on_plane(scene, axes, frame, gap, coulomb)

    def solve(self, traction, value):
        return self.met.solve(self.loads @ traction, value)


def path(rng, gdim, kind):
    """Tractions and values of ten steps: zero twice at least, and an ordinary load after it."""
    size = np.array([0.03] * (gdim - 1) + [0.06])

    def ordinary():
        traction, value = size * rng.uniform(-1, 1, gdim), 0.3 * size * rng.uniform(-1, 1, gdim)
        traction[-1], value[-1] = -abs(traction[-1]), -abs(value[-1])
        lifted = np.where(np.arange(gdim) == gdim - 1, 1.0 - 2.0 * (rng.uniform() < 0.2), 1.0)
        if kind == "loaded":
            return traction * lifted, np.zeros(gdim)
        return rng.choice([0.0, 0.2]) * traction, value * lifted

    last = ordinary()
    steps = [last, (np.zeros(gdim), np.zeros(gdim)), ordinary()]
    for what in rng.choice(STEPS, 5):
        exponent = {"less": (-9, -1)}.get(what, (-14, -10) if "tiny" in what else (0, 0))
        factor = {"zero": 0.0, "turned": -1.0}.get(what, 10.0 ** rng.uniform(*exponent))
        given = ordinary() if what in ("new", "other tiny") else last
        steps.append((factor * given[0], factor * given[1]))
        if what in ("new", "turned"):
            last = steps[-1]
    return [*steps, (np.zeros(gdim), np.zeros(gdim)), ordinary()]


def follow(seed, qp_type="newton", cells=tuple(SIZES), laws=LAWS):
    """A random path beside the reference; what went wrong."""
    rng = np.random.default_rng(seed)
    cell, friction, kind = rng.choice(cells), rng.choice(laws), rng.choice(list(KINDS))
    gap = rng.choice([0.0, 0.0, 0.01, -0.002 if kind == "driven" else 0.0])
    accepts = bool(rng.uniform() < 0.4)
    rtol = 1e-8 if qp_type == "newton" else 1e-6
    scene = Scene(cell, kind, friction, gap, qp_type=qp_type, rtol=rtol)
    other = Reference(cell, kind, friction, gap)
    about = f"seed {seed}: {cell} {kind} {friction} gap {gap} {qp_type} accepts {accepts}"
    share = (100.0 if friction in ("coulomb", "orthotropic") else 1.0) * 10.0 * rtol
    wrong, most = [], 0.0
    for i, (traction, value) in enumerate(path(rng, scene.gdim, kind)):
        expected = other.solve(traction, value)
        size = np.abs(expected).max()
        try:
            u = scene.solve(traction, value)
        except tfeti.TfetiError as error:
            wrong.append(f"{about}, step {i} {traction} {value}: {error}")
            continue
        apart = np.abs(u - expected).max()
        if not apart <= share * size + (1e-13 * most if accepts and friction != "none" else 0.0):
            wrong.append(f"{about}, step {i} {traction} {value}: {apart:.2e} of {size:.2e}")
        most = max(most, size)
        if accepts:
            scene.problem.accept()
            other.met.accept(u)
    scene.problem.destroy()
    return wrong


@pytest.mark.parametrize(
    ("cell", "kind", "friction", "qp_type"),
    [
        ("triangle", "loaded", "none", "smalse"),
        ("triangle", "driven", "coulomb", "newton"),
        ("quadrilateral", "loaded", "coulomb", "smalse"),
        ("quadrilateral", "loaded", "coulomb", "newton"),
        ("quadrilateral", "driven", "tresca", "newton"),
        ("hexahedron", "loaded", "tresca", "newton"),
        ("hexahedron", "driven", "none", "newton"),
        ("hexahedron", "driven", "coulomb", "smalse"),
    ],
)
def test_the_rest_state_is_found_from_any_load(cell, kind, friction, qp_type):
    scene = Scene(cell, kind, friction, qp_type=qp_type)
    load = np.array([0.01] * (scene.gdim - 1) + [-0.05])

    def solve(factor):
        return scene.solve(*np.outer((kind == "loaded", kind == "driven"), 0.3 * factor * load))

    first = solve(1.0)
    for factor in (0.0, 1.0, -1.0, 0.0):
        u = solve(factor)
        if factor == 0.0:
            assert not np.any(u)
            assert scene.problem.report.F_multiplications <= 2
        elif factor == 1.0:
            assert np.abs(u - first).max() <= 1e-4 * np.abs(first).max()
    # nothing but Tresca's bound has a size of its own
    if friction != "tresca":
        for factor in (1.0, 2.0, 300.0, 1e-10, 1e-14, 1e-30):
            u = solve(factor) / factor
            assert np.abs(u - first).max() <= 1e-4 * np.abs(first).max()
            grows = factor > 1.0 and kind == "loaded" and qp_type == "newton"
            assert not grows or scene.problem.report.F_multiplications <= 2


def check_small_loads(solve, rtol, factors):
    """What is found for small loads that close no gap is linear in them, whatever was before."""
    first, *found = (solve(factor) / factor for factor in factors)
    size = np.abs(found[0]).max()
    assert np.abs(first).max() > 0.0 < size
    assert np.abs(np.array(found[1:]) - found[0]).max() <= 100.0 * rtol * size


@pytest.mark.parametrize(("qp_type", "rtol"), [("newton", 1e-8), ("smalse", 1e-6)])
@pytest.mark.parametrize("first", [1e-3, 1.0])
def test_a_gap_that_stays_open_does_not_limit_what_a_small_load_is_solved_to(qp_type, rtol, first):
    scene, load = Scene("triangle", gap=0.01, qp_type=qp_type, rtol=rtol), np.array([0.01, -0.05])
    check_small_loads(lambda factor: scene.solve(factor * load), rtol, (first, 1e-3, 1e-12, 1e-14))


def test_a_body_that_is_lifted_as_a_whole_has_no_forces():
    """SMALSE-M's forces tend to 0, and what does not balance of them with them."""
    scene = Scene("tetrahedron", "driven", "coulomb", qp_type="smalse")
    lift = np.array([0.003, 0.003, 0.015])
    assert np.abs(scene.solve(0.0, lift) - lift).max() <= 1e-6 * 0.015


@pytest.mark.parametrize(
    ("cell", "gap", "friction"),
    [("triangle", 0.0, None), ("tetrahedron", 1 / 3, tfeti.Coulomb(0.3))],
)
def test_a_body_brought_to_another_only_touches_it(cell, gap, friction):
    """Forces are rounding, for which nothing is solved; what presses them knows of no ‖F‖ yet."""
    d = stacked(cell, 3, 4, 4 if friction is None else 2, upper=(0.1, 0.9), gap=gap)
    value = fem.Constant(d.mesh, np.zeros(d.mesh.geometry.dim))
    bcs = clamped(d, "lower bottom", ("upper top", value))
    pair = sided("upper bottom", "lower top", reach=1.0, friction=friction)
    problem = two_body_problem(d, no_load, bcs, [pair])
    for pressed in (0.0, 0.01, 0.0):
        value.value[0], value.value[-1] = 0.01 * (friction is None), -gap - pressed
        problem.solve()
        assert problem.report.F_multiplications <= (20 if pressed else 2)
        if not pressed:
            assert problem.solution.contact().resultant.force == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("cell", "qp_type", "rtol"), [("hexahedron", "newton", 1e-8), ("triangle", "smalse", 1e-6)]
)
def test_a_series_comes_back_to_rest(cell, qp_type, rtol):
    """Slips count from step to step, but without pressure there is no friction."""
    scene = Scene(cell, "driven", "coulomb", qp_type=qp_type, rtol=rtol)
    value = np.array([0.003, -0.0033, -0.01])[3 - scene.gdim :]
    for factor in (1.0, 0.0, -1.0, 0.0, 1e-12, 1.0, 0.0):
        u = scene.solve(0.0, factor * value)
        assert np.abs(u).max() <= 0.02 * max(abs(factor), 1e-12)
        scene.problem.accept()
    value[-1] = 0.0  # it only touches: what is left of no forces bounds no friction
    for factor in (1.0, 1.000001, 1.000002):  # nor is it solved for
        u = scene.solve(0.0, factor * value)
        assert np.abs(u - factor * value).max() <= 1e-5 * 0.003
        assert qp_type == "smalse" or scene.problem.report.F_multiplications <= 40
        scene.problem.accept()


@pytest.mark.parametrize("mu", [0.5, 0.2, 0.05])
def test_a_wedge_keeps_its_seat_where_friction_locks_it(mu):
    """Between walls that lean by 0.1 it springs out without a load only if μ is less."""
    d = decomposed("quadrilateral", 4, 4)
    x, rubs = d.mesh.geometry.x, {"gap": 0.0, "friction": tfeti.Coulomb(mu)}
    x[:, 0] = (x[:, 0] - 0.5) * (1.0 + 0.2 * x[:, 1])
    contacts = [
        tfeti.Obstacle(side, tfeti.Plane((-0.5 * to, 0), (to, 0.1)), **rubs)
        for side, to in (("left", 1.0), ("right", -1.0))
    ]
    load = fem.Constant(d.mesh, np.zeros(2))
    p = two_body_problem(d, drawn(d, "top", load), lambda V: [], contacts)
    sunk = []
    for pressed in (0.05, 0.1, 0.05, 0.0, 0.0, -0.01, 0.0)[: 7 if mu > 0.1 else 5]:
        load.value[1] = -pressed
        accepted(p)
        force = sum(p.solution.contact(i).resultant.force for i in range(2))
        assert np.allclose(force, (0.0, 1.2 * pressed), rtol=0, atol=1e-6)
        sunk.append(-displacement(p)[1][:, 1].mean())
    if mu < 0.1:
        assert np.allclose(sunk[3:], 0.0, rtol=0, atol=1e-6 * sunk[1])
    else:
        assert np.all(np.array(sunk[3:]) > 0.7 * sunk[1])


@pytest.mark.parametrize(
    ("friction", "degree", "options"),
    [
        (None, 1, {"qp_type": "newton", "rtol": 1e-6}),
        (None, 1, {"qp_type": "smalse", "rtol": 1e-6}),
        (tfeti.Tresca(6e-3), 2, {"qp_type": "newton", "rtol": 1e-8}),
    ],
)
def test_a_body_at_rest_behind_an_open_gap_does_not_limit_that_either(friction, degree, options):
    """Nor friction across it: what is found for a small load is linear in it."""
    d = stacked("triangle", 4, 4, 2, gap=0.05)
    load = fem.Constant(d.mesh, np.zeros(2))
    pair = tfeti.Contact("upper bottom", "lower top", gap=0.01, friction=friction, reach=0.5)
    bcs = clamped(d, "lower bottom", "upper top")
    p = two_body_problem(d, drawn(d, "upper right", load), bcs, [pair], degree, **options)

    def solve(factor):
        load.value[:] = factor * np.array([8.7e-3, -1.6e-2])
        p.solve()
        return displacement(p)[1]

    check_small_loads(solve, options["rtol"], (1.0, 1e-3, 1e-5, 2.8e-11, 1e-13))


def test_given_friction_of_a_load_that_falls():
    """Rows that stick leave an active set with rows that slip one by one, too, where q rose."""
    lower = "lower", (0, 0, -3.4), (5, 2.9, 0), (3, 3, 1)
    upper = "upper", (-0.2, 0.9, 0.2), (2.6, 3.2, 4.6), (3, 1, 1)
    d = torn_boxes("hexahedron", [lower, upper], 2)
    load = fem.Constant(d.mesh, np.zeros(3))
    bcs = held(d, "lower bottom", "lower left", "lower front", "upper front")
    contact = sided("upper bottom", "lower top", friction=tfeti.Tresca(1e-4))
    given = drawn(d, "upper top", load), bcs, [contact]
    p = two_body_problem(d, *given, stress=stiffer_above(d, 20.0), max_it=100)
    for factor in (1.0, 0.4):
        load.value[:] = factor * np.array([2e-5, -3e-5, -2e-4])
        p.solve()
    assert p.report.F_multiplications <= 40


@pytest.mark.parametrize("gap", [0.01, 0.0])
def test_bodies_that_contact_alone_holds_come_to_rest(gap):
    d = stacked("quadrilateral", 4, 4, 2)
    load = fem.Constant(d.mesh, np.zeros(2))
    plane = tfeti.Obstacle("lower bottom", tfeti.Plane((0, -1), (0, 1)), gap=gap, reach=0.5)
    given = drawn(d, "upper top", load), held(d, "lower left", "upper left")
    problem = two_body_problem(d, *given, [plane, sided("upper bottom", "lower top")])
    for pressed in (0.05, 0.0, 1e-13, 0.05, 0.0):
        load.value[1] = -pressed
        problem.solve()
        # ε of plane strain under a pressure: (1 + ν)(1 − 2ν)/(1 − ν)/E would be held at both sides
        low = -2.0 * pressed * (1 - 0.3**2) - (gap if pressed else 0.0)
        found = displacement(problem)[1][:, 1].min()
        assert found == pytest.approx(low, rel=1e-5, abs=1e-18 if gap else 1e-15)
        if gap == 0.0:  # where the next step begins: its rounding is no overlap
            problem.accept()


@pytest.mark.parametrize("qp_type", ["newton", "smalse"])
@pytest.mark.parametrize(("friction", "gap"), [("tresca", 0.05), ("coulomb", 0.0)])
def test_what_sticks_has_not_slipped(friction, gap, qp_type, monkeypatch):
    """The algebraic error of a step is no slip that drives the next one."""
    rough = tfeti.Tresca(1.0) if friction == "tresca" else tfeti.Coulomb(8.76)
    monkeypatch.setitem(globals(), "law", lambda name, gdim: (rough, None, None))
    scene = Scene("hexahedron", "driven", friction, gap, qp_type=qp_type, rtol=1e-6)
    value = np.array([-0.009, 0.0054, -0.015])
    first = scene.solve(0.0, value)
    for factor in (0.0, 1.0, 1e-4, 1e-12, 0.0):
        scene.problem.accept()
        u = scene.solve(0.0, factor * value)
        assert np.abs(u - factor * first).max() <= 1e-4 * factor * np.abs(first).max() + 1e-15 * gap
        assert factor or scene.problem.report.F_multiplications <= 2


SEEDS = [*range(5), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(5, 50))]


@pytest.mark.parametrize("seed", SEEDS)
def test_a_random_path_is_right_at_every_step(seed):
    assert follow(seed) == []


@pytest.mark.parametrize("seed", [8030, 8035])
def test_bounds_of_friction_fall_to_zero_with_the_load(seed):
    """Slips of earlier steps alone drive: forces fall by the same part from problem to problem."""
    assert follow(seed, "smalse", laws=("coulomb", "orthotropic")) == []


@pytest.mark.parametrize("size", [1e-160, 1e160])
def test_loads_and_a_stiffness_whose_squares_leave_the_range_are_named(size):
    scene = Scene("triangle")
    with pytest.raises(tfeti.InputError, match="squares leave the range .* expected units"):
        scene.solve((0.0, -size))
    scene.solve((0.0, -0.05))
    assert not np.any(scene.solve((0.0, 0.0)))
    with pytest.raises(tfeti.InputError, match="stiffness of .* squares leave the range"):
        Scene("triangle", stress=hooke(1e-300)).solve((0.0, -1e-302))


def test_a_body_that_nothing_acts_on_any_more_limits_no_answer():
    """A block that is pressed to a rough wall is lifted off another one, which is at rest then."""
    d = stacked("hexahedron", 3, 4)
    x, rubs = np.eye(3)[0], {"friction": tfeti.Coulomb(0.3)}
    lift = fem.Constant(d.mesh, 0.0)
    contacts = [
        sided("upper bottom", "lower top", **rubs),
        tfeti.Obstacle("upper left", tfeti.Plane(0.0 * x, x), gap=0.0, **rubs),
    ]
    sides = "lower bottom", "lower left", "lower front", "upper front"
    given = drawn(d, "upper right", -0.01 * x), held(d, *sides, ("upper top", lift))
    p = two_body_problem(d, *given, contacts)
    for lift.value in (-0.01, 0.02, 0.03, 0.02, -0.01):
        assert accepted(p).F_multiplications <= 60
        points, u = displacement(p)
        moved = np.abs(u[points[:, -1] < -0.01]).max()
        assert (moved <= 1e-6 * np.abs(u).max()) == (lift.value > 0.0)


def test_a_corner_of_rough_walls_is_unloaded():
    """Nodes on several walls have more rows than unknowns: their forces are not unique."""
    d, rubs = decomposed("hexahedron", 4, 5), {"gap": 0.0, "friction": tfeti.Coulomb(0.6)}
    contacts = [
        tfeti.Obstacle(side, tfeti.Plane((0, 0, 0), normal), **rubs)
        for side, normal in zip(("left", "front", "bottom"), np.eye(3), strict=True)
    ]
    top, right = (fem.Constant(d.mesh, np.zeros(3)) for _ in range(2))
    above, beside = drawn(d, "top", top), drawn(d, "right", right)
    p = two_body_problem(d, lambda v, ds: above(v, ds) + beside(v, ds), lambda V: [], contacts)
    for factor in (1.0, 0.05):
        top.value[:], right.value[:] = factor * np.array([[-0.02, -0.1, -0.1], [-0.1, 0.0, 0.0]])
        assert accepted(p).F_multiplications <= 600
