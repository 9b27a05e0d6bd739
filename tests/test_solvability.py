"""Problems without a solution are recognised and explained, not iterated on."""

import numpy as np
import pytest
import ufl
from bodies import boxes, clamped, drawn, two_body_problem
from dolfinx import fem
from dolfinx.mesh import meshtags
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box, decomposed, hooke, problem, solved
from scipy.optimize import linprog
from scipy.sparse import csr_array

import tfeti_dolfinx as tfeti
from tfeti_dolfinx import NoSolutionError
from tfeti_dolfinx.feti.rigid_bodies import BodyRows, unresisted, unsprung
from tfeti_dolfinx.feti.solvability import RigidScene, check_solvable


@pytest.mark.parametrize(
    ("load", "contact", "says"),
    [
        ((0.1, 0, -0.05), True, r"\(volume 'ball'\) is free to move \(translation in x\): nothing"),
        ((0, 0, -0.05), False, r"translation in z\): nothing resists that"),
        ((0, 0, 0.05), True, r"translation in z\): only contact could resist that"),
    ],
)
def test_what_moves_a_body_is_named(load, contact, says):
    mesh, tags, names = box("hexahedron", 2)
    ball = {"ball": lambda x: x[0] > -1}
    d = tfeti.decompose(mesh, 3, facet_tags=tags, surfaces=names, volumes=ball)
    floor = tfeti.Obstacle("bottom", tfeti.Plane((0, 0, -0.01), (0, 0, 1)))
    p = problem(d, load, [floor] if contact else [], clamped=())
    with pytest.raises(NoSolutionError, match=says):
        p.solve()


def test_an_arch_fails_where_blocks_turn_at_its_joints():
    """A load a little beyond what rigid blocks bear: more friction nearly holds it."""
    parts = [(f"{k}", (1.001 * k, 5.0), (1.001 * k + 1, 6.0), (4 + k % 2, 4)) for k in range(7)]
    mesh, tags, names = boxes("quadrilateral", parts)
    angle, r = mesh.geometry.x.T[:2] * [[np.pi / 7.006], [1.0]]
    mesh.geometry.x[:, :2] = np.stack((-r * np.cos(angle), r * np.sin(angle)), axis=1)
    d = tfeti.decompose(mesh, 7, facet_tags=tags, surfaces=names)
    law, floor = {"friction": tfeti.Coulomb(0.7)}, tfeti.Plane((0, 0), (0, 1))
    contacts = [tfeti.Contact(f"{k} right", f"{k + 1} left", gap=0.0, **law) for k in range(6)]
    contacts += [tfeti.Obstacle(end, floor, **law) for end in ("0 left", "6 right")]
    crowd, held = drawn(d, "2 top", (0.0, -0.06)), lambda V: []
    p = two_body_problem(d, lambda v, ds: crowd(v, ds) - 0.02 * v[1] * ufl.dx, held, contacts)
    with pytest.raises(NoSolutionError, match="free to move together"):
        p.solve()


def test_a_load_that_turns_is_looked_at_again_and_one_that_grows_is_not(monkeypatch):
    """A block that a floor alone holds: pressed, three times as hard, then pulled off it."""
    asked = []
    looks = "tfeti_dolfinx.feti.dual.check_solvable"
    monkeypatch.setattr(looks, lambda *given: asked.append(check_solvable(*given)))
    d, weight = decomposed("quadrilateral", 4, 2), (0.0, -0.05)
    force = fem.Constant(d.mesh, weight)
    floor = tfeti.Obstacle("bottom", tfeti.Plane((0, 0), (0, 1)))
    p = solved(two_body_problem(d, drawn(d, None, force), clamped(d), [floor]))
    force.value = (0.0, -0.15)
    before = len(asked)
    p.solve()
    pressed = d.comm.allreduce(p.solution.contact(0).force.sum())
    assert (len(asked), pressed) == (before, pytest.approx(0.15, rel=1e-4))
    force.value = (0.0, 0.05)
    with pytest.raises(NoSolutionError, match="only contact could resist that"):
        p.solve()


@settings(max_examples=10)
@given(st.floats(-0.4, 1.4), st.floats(0.05, 1.0))
def test_solvable_just_if_the_resultant_is_over_the_support(centre, width):
    """A block on a flat floor, loaded by a pressure around ``centre``: it stands or tips."""
    d = decomposed("quadrilateral", 4, 2)
    x = ufl.SpatialCoordinate(d.mesh)
    # a linear pressure on the top of resultant 1 at x = c; its first moment about 0 is c
    c = centre * width + 0.5 * (1 - width)
    at = fem.Constant(d.mesh, c)  # one form for all examples
    pressure = (4 - 6 * at) + (12 * at - 6) * x[0]
    floor = tfeti.Obstacle("bottom", tfeti.Plane((0, 0), (0, 1)))
    # of two points, exact for it times a hat
    p = two_body_problem(
        d, lambda v, ds: -pressure * v[1] * ds(d.surface("top")), clamped(d), [floor]
    )
    if 1e-3 < c < 1 - 1e-3:
        p.solve()
        force = d.comm.allreduce(p.solution.contact(0).force.sum())
        assert force == pytest.approx(1.0, rel=1e-4)
    elif c < -1e-3 or c > 1 + 1e-3:
        with pytest.raises(NoSolutionError, match="only contact could resist that"):
            p.solve()


def rigid_scene(rng):
    """Rows of equalities and contacts between rigid bodies, and a load."""
    count, k = int(rng.integers(1, 6)), int(rng.choice([3, 6]))

    def row(*bodies):
        values = np.zeros((count, k))
        force = rng.integers(-1, 2, k) if rng.random() < 0.5 else rng.standard_normal(k)
        for sign, body in zip((1, -1), bodies, strict=False):
            values[body] = sign * force + (sign < 0) * 0.3 * rng.standard_normal(k)
        return values.ravel()

    E = [row(rng.integers(count)) for _ in range(rng.integers(0, 4))]
    N = [row(*rng.permutation(count)[: rng.integers(1, 3)]) for _ in range(rng.integers(1, 30))]
    E, N = np.array(E).reshape(-1, count * k), np.array(N)
    load = N.T @ np.maximum(rng.standard_normal(len(N)), 0.0) + E.T @ rng.standard_normal(len(E))
    disturbed = rng.choice([0.0, 1e-3, 1.0], p=[0.4, 0.3, 0.3])
    return count, k, E, N, load + disturbed * rng.standard_normal(count * k)


def gram(J, count, k):
    return BodyRows.of(csr_array(J), count, k).gram(np.ones(len(J), dtype=bool))


def escape(count, k, E, N, load):
    """A motion of the bodies that escapes, by the package."""
    size = np.linalg.norm(load.reshape(count, k), axis=1)
    unheld = unresisted([gram(E, count, k)], unsprung(np.zeros((count, k, k))))
    Z, body = unheld.alone, np.repeat(np.arange(count), unheld.free.sum(axis=1))
    noise = np.maximum(1e-9 * size, 1e-14 * size.max())[body]
    none = csr_array((0, len(body)))
    y = RigidScene(Z.T @ load, noise, body, csr_array(csr_array(N) @ Z), none).escape()
    return None if y is None else Z @ y


def test_random_rigid_scenes_against_a_plain_program():
    """Gλ = e, λ_N ≥ 0 is feasible or not; loads of 1e-9 to 1e9 in whatever units."""
    verdicts = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        count, k, E, N, load = rigid_scene(rng)
        A = np.concatenate((N.T, E.T, -E.T), axis=1)
        plain = linprog(np.zeros(A.shape[1]), A_eq=A, b_eq=load, bounds=(0, None)).status == 0
        y = escape(count, k, E, N, load * 10.0 ** rng.uniform(-9, 9))
        assert (y is None) == plain, f"seed {seed}"
        if y is not None:
            assert np.all(N @ y <= 1e-8)
            assert load @ y > 0.0
        verdicts.append(plain)
    assert 0.2 < np.mean(verdicts) < 0.8


def test_rounding_between_pairs_of_bodies_holds_nothing():
    """Each of two pairs moves as one, though a row of 1e-8 links a body of one to the other's."""
    one, zero, tiny = np.eye(3), np.zeros((3, 3)), 1e-8 * np.eye(3)
    J = np.block([[one, zero, zero, -one], [zero, one, -one, zero], [zero, zero, tiny, -tiny]])
    found = unresisted([gram(J, 4, 3)], unsprung(np.zeros((4, 3, 3))))
    assert not found.free.any()
    joint = np.linalg.qr(found.joint.toarray())[0]
    exact = np.block([[one, zero], [zero, one], [zero, one], [one, zero]]) / np.sqrt(2)
    assert np.allclose(joint @ joint.T, exact @ exact.T, atol=1e-12)


@pytest.mark.parametrize("axes", [1, 2])
def test_a_block_on_a_plane_with_friction_slides_or_tips(axes):
    """Pressed by 1 at the corners of a square, pushed along the plane at a height: closed forms."""
    corners = np.array([(x, y) for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
    angle, height, mu = 0.3, 0.5, 0.4
    along = np.array([np.cos(angle), np.sin(angle)]) if axes == 2 else np.array([1.0, 0.0])
    # modes: translations, turns; normals resist motion down at the corners
    normal = np.array([[0, 0, -1, -y, x, 0] for x, y in corners], dtype=float)
    T = [np.array([[1, 0, 0, 0, 0, -y] for _, y in corners], dtype=float)]
    T += [np.array([[0, 1, 0, 0, 0, x] for x, _ in corners], dtype=float)]
    body, none = np.zeros(6, dtype=int), csr_array((0, 6))

    def held(force, given):
        push = np.append(force * along, -1.0)
        load = np.concatenate((push, (-height * push[1], height * push[0], 0.0)))
        if given:  # a bound of mu / 4 at each corner
            W = tuple(csr_array(mu / 4 * A) for A in T)
            scene = RigidScene(load, np.full(6, 1e-9), body, csr_array(normal), none, (), W)
        else:
            M, P = tuple(csr_array(mu * A) for A in T), csr_array(normal)
            scene = RigidScene(load, np.full(6, 1e-9), body, none, P, M)
        return scene.escape() is None

    for bounded in (False, True):
        assert held(0.999 * mu, bounded)
        assert not held(1.001 * mu, bounded)


def block_on_floor(scale, E, load, subdomains=2):
    """A block of edge ``scale`` over a plane, pressed or pushed by a traction on its top."""
    mesh, tags, names = box("quadrilateral", 3)
    mesh.geometry.x[:] *= scale
    d = tfeti.decompose(mesh, subdomains, facet_tags=tags, surfaces=names)
    floor = tfeti.Obstacle("bottom", tfeti.Plane((0, -0.01 * scale), (0, 1)))
    load = drawn(d, "top", E * np.array(load))
    return two_body_problem(d, load, clamped(d), [floor], stress=hooke(E))


@pytest.mark.parametrize(("scale", "E"), [(1e-9, 2e11), (1e6, 2e-1)])
def test_units_do_not_matter(scale, E):
    assert solved(block_on_floor(scale, E, (0.0, -1e-3))).report.free_modes == 1
    for load, says in (((0.0, 1e-3), "y.: only contact"), ((1e-9, -1e-3), "x.: nothing resists")):
        with pytest.raises(NoSolutionError, match=f"translation in {says}"):
            block_on_floor(scale, E, load).solve()


def test_springs_of_1e_10_hold_a_body():
    d = decomposed("quadrilateral", 12, 4)
    p = problem(d, (0.0, -1e-12), clamped=(), springs=1e-10)
    down = p.solve().x.array.reshape(-1, 2)[:, 1]
    assert p.report.free_modes == 0
    assert np.allclose(down, -0.01, rtol=0.02)  # what rounding leaves of the stiffness


def dual_of(p):
    """The dual problem of a scene, not solved."""
    p._system.look_for_changes()
    p._system.make({})
    return p._system.dual


def in_a_slot(width):
    """A block all of whose skin must stay between two walls, ``width`` apart."""
    mesh, tags, _ = box("quadrilateral", 3)
    skin = meshtags(mesh, 1, tags.indices, np.full_like(tags.values, 1))
    d = tfeti.decompose(mesh, 2, facet_tags=skin, surfaces={"skin": 1})
    left = tfeti.Obstacle("skin", tfeti.Plane((0.5 - width / 2, 0), (1, 0)))
    right = tfeti.Obstacle("skin", tfeti.Plane((0.5 + width / 2, 0), (-1, 0)))
    return two_body_problem(d, drawn(d, "skin", (0, 0)), clamped(d), [left, right])


def test_the_solver_names_contacts_that_exclude_each_other():
    """A narrow slot compresses the block; walls that have passed each other leave no place."""
    in_a_slot(0.9).solve()
    p = in_a_slot(-0.1)
    with pytest.raises(tfeti.ConvergenceError, match="those of 0: obstacle .* and 1: obstacle"):
        p.solve()
    assert p.report.converged_reason == "DIVERGED_CONTRADICTION"
    assert [text[:12] for text in p.report.excluding_contacts] == ["0: obstacle ", "1: obstacle "]
