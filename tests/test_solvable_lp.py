"""Verdicts on solvability against plain linear programs, and where scales differ much."""

import numpy as np
import pytest
import ufl
from bodies import boxes, two_body_problem
from dolfinx import fem
from dolfinx.mesh import meshtags
from scenes import box, hooke, strain
from scipy.optimize import linprog
from scipy.sparse import csr_array

import tfeti_dolfinx as tfeti
from tfeti_dolfinx import NoSolutionError
from tfeti_dolfinx.feti.rigid_bodies import unresisted, unsprung
from tfeti_dolfinx.feti.solvability import RigidScene, minimiser


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


def escape(count, k, E, N, load):
    """A motion of the bodies that escapes, by the package."""
    size = np.linalg.norm(load.reshape(count, k), axis=1)
    unheld = unresisted(csr_array(E.T @ E), unsprung(np.zeros((count, k, k))))
    Z, body = unheld.alone, np.repeat(np.arange(count), unheld.free.sum(axis=1))
    noise = np.maximum(1e-9 * size, 1e-14 * size.max())[body]
    none = csr_array((0, len(body)))
    y = RigidScene(Z.T @ load, noise, body, csr_array(csr_array(N) @ Z), none).escape()
    return None if y is None else Z @ y


def test_random_rigid_scenes_against_a_plain_program():
    """Gλ = e, λ_N ≥ 0 is feasible or not; loads of 1e-9 to 1e9 in whatever units."""
    verdicts = []
    for seed in range(150):
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

    for given in (False, True):
        assert held(0.999 * mu, given)
        assert not held(1.001 * mu, given)


def test_a_program_that_presolving_spoils():
    """HiGHS 1.11 does not know the status of what it makes of this one's presolved optimum."""
    A = np.zeros((9, 8))
    A[:3, :3] = [[0.028, -0.97, 0.81], [0, -1, 0], [-0.028, -0.97, -0.81]]
    A[3:5, 1:5] = [[0.49, -0.39, -0.49, 0.33], [0.5, 0.4, -0.5, -0.45]]
    A[5:7, 3:6] = [[0.5, -0.45, -0.5], [0.5, -0.28, -0.5]]
    A[7:, 5:] = [[0.4, -0.4, 0.34], [0.33, -0.33, 0]]
    load = np.array([0, 0, 0, -1, 0.905070269816, -0.458141638602, -0.725973378359, 0])
    noise = np.array([1.8e-14, 1.8e-14, 1.8e-14, 1.8e-9, 1.8e-9, 8.4e-10, 1.3e-9, 1.3e-9])
    cost, A = np.concatenate((noise - load, noise + load)), csr_array(np.hstack([A, -A]))
    y = minimiser(cost, A, bounds=(0, 1))
    expected = linprog(cost, A_ub=A, b_ub=np.zeros(9), bounds=(0, 1)).fun
    assert np.all(A @ y <= 1e-9)
    assert cost @ y == pytest.approx(expected, rel=1e-6)


def test_a_load_that_is_rounding_hides_no_escape():
    """A body falls away from its contact; on another one a load that is held leaves 1e-21."""
    count, k = 2, 3
    E, N, load = np.zeros((2, 6)), np.zeros((2, 6)), np.zeros(6)
    E[[0, 1], [3, 4]] = 1.0  # of the second body only the last mode is free
    N[0, 0], N[1, 0], N[1, 2] = 1.0, 1.0, 0.5
    load[[0, 3, 5]] = -1e-3, 1.0, 1e-21
    assert escape(count, k, E, N, load)[0] < 0.0
    load[0] = 1e-3
    assert escape(count, k, E, N, load) is None


def block_on_floor(scale, E, load, subdomains=2):
    """A block of edge ``scale`` over a plane, pressed or pushed by a traction on its top."""
    mesh, tags, names = box("quadrilateral", 3)
    mesh.geometry.x[:] *= scale
    d = tfeti.decompose(mesh, subdomains, facet_tags=tags, surfaces=names)
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    L = ufl.dot(fem.Constant(d.mesh, E * np.array(load)), v) * ds(d.surface("top"))
    floor = tfeti.Obstacle("bottom", tfeti.Plane((0, -0.01 * scale), (0, 1)))
    return tfeti.ContactProblem(ufl.inner(hooke(E)(u), strain(v)) * ufl.dx, L, [], [floor], d)


@pytest.mark.parametrize(("scale", "E"), [(1e-9, 2e11), (1e6, 2e-1), (1.0, 1e9)])
def test_units_do_not_matter(scale, E):
    pressed = block_on_floor(scale, E, (0.0, -1e-3))
    pressed.solve()
    assert pressed.report.free_modes == 1
    with pytest.raises(NoSolutionError, match=r"translation in y\): only contact"):
        block_on_floor(scale, E, (0.0, 1e-3)).solve()
    with pytest.raises(NoSolutionError, match=r"translation in x\): nothing resists"):
        block_on_floor(scale, E, (1e-9, -1e-3)).solve()


@pytest.mark.parametrize("subdomains", [1, 4])
def test_a_spring_of_1e_10_holds_a_body(subdomains):
    mesh, tags, names = box("quadrilateral", 12)
    d = tfeti.decompose(mesh, subdomains, facet_tags=tags, surfaces=names)
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    spring = fem.Constant(d.mesh, 1e-10)
    a = ufl.inner(hooke()(u), strain(v)) * ufl.dx + spring * ufl.inner(u, v) * ds(
        d.surface("bottom")
    )
    L = ufl.dot(fem.Constant(d.mesh, np.array([0.0, -1e-12])), v) * ds(d.surface("top"))
    p = tfeti.ContactProblem(a, L, [], [], d)
    down = p.solve().x.array.reshape(-1, 2)[:, 1]
    assert p.report.free_modes == 0
    assert np.allclose(down, -0.01, rtol=0.02)  # what rounding leaves of the stiffness


def test_a_body_pinned_at_neighbouring_nodes_beside_a_stiff_one():
    """The pins are a mesh size apart, and the other body is 1e8 times as stiff."""
    parts = [
        ("soft", (0.0, 0.0), (1.0, 1.0), (16, 16)),
        ("stiff", (0.2, 1.0), (0.8, 2.0), (4, 4)),
    ]
    mesh, tags, names = boxes("quadrilateral", parts)
    d = tfeti.decompose(mesh, 3, facet_tags=tags, surfaces=names)

    def pins(V):
        at = {(0.0, 0.0): (0, 1), (1 / 16, 0.0): (1,)}
        made = []
        for point, axes in at.items():
            for axis in axes:
                W, _ = V.sub(axis).collapse()

                def near(x, point=point):
                    return np.isclose(x[0], point[0]) & np.isclose(x[1], point[1])

                dofs = fem.locate_dofs_geometrical((V.sub(axis), W), near)
                made.append(fem.dirichletbc(fem.Function(W), dofs, V.sub(axis)))
        return made

    def load(v, ds):
        return ufl.dot(fem.Constant(d.mesh, (0.0, -1e-6)), v) * ds(d.surface("stiff top"))

    def stress(u):
        x = ufl.SpatialCoordinate(d.mesh)
        E = ufl.conditional(ufl.gt(x[1], 1.0), 1e8, 1.0)
        return E * hooke()(u)

    contact = tfeti.Contact("soft top", "stiff bottom", reach=0.1)
    p = two_body_problem(d, load, pins, [contact], stress=stress)
    dual = dual_of(p)
    assert dual.coarse.num_free_motions == 1  # the stiff one slides
    p.destroy()


def dual_of(p):
    """The dual problem of a scene, not solved."""
    p._system.look_for_changes()
    return p._system.make(p.report)


def in_a_slot(width):
    """A block all of whose skin must stay between two walls, ``width`` apart."""
    mesh, tags, _ = box("quadrilateral", 3)
    skin = meshtags(mesh, 1, tags.indices, np.full_like(tags.values, 1))
    d = tfeti.decompose(mesh, 2, facet_tags=skin, surfaces={"skin": 1})
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    left = tfeti.Obstacle("skin", tfeti.Plane((0.5 - width / 2, 0), (1, 0)))
    right = tfeti.Obstacle("skin", tfeti.Plane((0.5 + width / 2, 0), (-1, 0)))
    L = ufl.dot(fem.Constant(d.mesh, np.zeros(2)), v) * ufl.dx
    a = ufl.inner(hooke()(u), strain(v)) * ufl.dx
    return tfeti.ContactProblem(a, L, [], [left, right], d)


def test_the_solver_names_contacts_that_exclude_each_other():
    """A narrow slot compresses the block; walls that have passed each other leave no place."""
    in_a_slot(0.9).solve()
    p = in_a_slot(-0.1)
    with pytest.raises(tfeti.ConvergenceError, match="those of 0: obstacle .* and 1: obstacle"):
        p.solve()
    assert p.report.converged_reason == "DIVERGED_CONTRADICTION"
    assert [text[:12] for text in p.report.excluding_contacts] == ["0: obstacle ", "1: obstacle "]
    p.destroy()


def test_many_loose_bodies_need_no_large_dense_array():
    """Free motions of single bodies are sparse, whatever the number of bodies; rows are few."""
    count, k = 300, 6
    rng = np.random.default_rng(0)
    levers = rng.uniform(-1, 1, (count, 40, 2))
    below = np.zeros((count * 40, count * k))
    rows, body = np.arange(count * 40), np.repeat(np.arange(count), 40)
    for sign, other in ((1.0, body), (-1.0, body - 1)):
        used = other >= 0
        for mode, value in ((2, 1.0), (4, levers[..., 0].ravel()), (5, levers[..., 1].ravel())):
            values = np.broadcast_to(sign * value, rows.shape)[used]
            below[rows[used], other[used] * k + mode] = values
    J = csr_array(below)
    free = unresisted(csr_array(J.T @ J), unsprung(np.zeros((count, k, k))))
    assert free.count == 3 * count
    assert free.joint.shape[1] == 0
    assert free.alone.nnz <= count * k * k
