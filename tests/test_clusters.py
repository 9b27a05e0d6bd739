"""Clusters: K̃⁺ against a dense saddle-point problem, and scenes against the same without them."""

from dataclasses import replace

import numpy as np
import pytest
import ufl
from bodies import held, pressed, sided, stacked, two_body_problem
from mpi4py import MPI
from scenes import clamp, curved_obstacle, decomposed, forms, hooke, strain

import tfeti_dolfinx as tfeti
from benchmarks.stability_scenes import LADDERS
from benchmarks.stress.judge import run_scene
from tfeti_dolfinx.clusters.subdomains import ClusteredSubdomains, Saddle
from tfeti_dolfinx.errors import FactorError, InputError
from tfeti_dolfinx.qp.sets import Status, face_of

COMM = MPI.COMM_WORLD


def grid(n):
    """Subdomains of a unit square or cube, n along each axis."""

    def subdomain(x):
        i, j, k = np.minimum((n * x).astype(int), n - 1)
        return i + n * j + n * n * k

    return subdomain


def square(cells=16, parts=4, cell="quadrilateral", **options):
    """A square or cube of equal subdomains, clamped on the left, pressed on a curved obstacle."""
    d = decomposed(cell, cells, grid(parts))
    gdim = d.mesh.geometry.dim
    traction = (0.0,) * (gdim - 1) + (-0.1,)
    V, a, L = forms(d.mesh, d.facet_tags, traction, d.surface("top"))
    return tfeti.ContactProblem(
        a,
        L,
        [clamp(V, d.facets("left"))],
        [tfeti.Obstacle("bottom", curved_obstacle(gdim), reach=0.2)],
        d,
        petsc_options={f"tfeti_{name}": value for name, value in options.items()},
    )


def solved(problem):
    problem.solve()
    u, report = problem.solution.u, problem.report
    problem.destroy()
    return u, report


def difference(u, v):
    """Largest difference over the largest displacement, over all ranks."""
    parts = (np.abs(u - v).max(initial=0.0), np.abs(v).max(initial=0.0))
    most, size = (COMM.allreduce(part, op=MPI.MAX) for part in parts)
    return most / size


@pytest.fixture(scope="module")
def clustered():
    p = square(8, 4, clusters=4)
    p.solve()
    yield p
    p.destroy()


def dense(p):
    """K, B_c, K̃⁺f by the saddle-point problem, and null(B_c) ∩ null(K), of this rank."""
    subdomains = p.dual.subdomains
    B, n = subdomains._clusters.averages.toarray(), p.dofs.num_nodes * p.dofs.bs
    K = np.zeros((n, n))
    for block, part in zip(subdomains.blocks, subdomains.dof_parts, strict=True):
        columns = [block.multiply(e) for e in np.eye(part.stop - part.start)]
        K[part, part] = np.array(columns).T
    return K, B


def test_the_inverse_is_that_of_the_saddle_point_problem(clustered):
    subdomains, (K, B) = clustered.dual.subdomains, dense(clustered)
    n, r = len(K), subdomains.kernel_size
    R = np.array([subdomains.kernel_motion(alpha) for alpha in np.eye(r)]).reshape(r, n).T
    assert np.allclose(R.T @ R, np.eye(r), atol=1e-12)
    assert np.abs(K @ R).max(initial=0.0) <= 1e-12
    assert np.abs(B @ R).max(initial=0.0) <= 1e-12
    f = np.random.default_rng(COMM.rank).standard_normal(n)
    f -= R @ (R.T @ f)
    u = subdomains.solve(f)
    saddle = np.block([[K, B.T], [B, np.zeros((len(B), len(B)))]])
    expected = np.linalg.lstsq(saddle, np.append(f, np.zeros(len(B))), rcond=None)[0][:n]
    u, expected = (v - R @ (R.T @ v) for v in (u, expected))
    assert np.abs(B @ u).max(initial=0.0) <= 1e-11 * np.abs(u).max(initial=1.0)
    assert np.allclose(u, expected, atol=1e-9 * np.abs(expected).max(initial=1.0))


def test_kernels_are_those_of_whole_clusters(clustered):
    report = clustered.report
    assert report.clusters == 4 or COMM.size > 2
    assert report.kernel_dim == 3 * report.clusters
    assert isinstance(clustered.dual.subdomains, ClusteredSubdomains)


def test_the_local_operator_is_the_inverse_on_the_trace(clustered):
    subdomains = clustered.dual.subdomains
    w = np.random.default_rng(COMM.rank).standard_normal(len(subdomains.trace))
    operator, out = subdomains.local_operator("pinv"), np.empty_like(w)
    operator.prepare()
    operator.mult(w, out)
    f = np.zeros(subdomains.dof_parts[-1].stop if subdomains.dof_parts else 0)
    f[subdomains.trace] = w
    u = subdomains.solve(f)[subdomains.trace]
    assert np.allclose(out, u, atol=1e-11 * np.abs(u).max(initial=1.0))
    assert operator.traffic >= 0.0


def columns_of(multiply, like):
    """A dense matrix, on all ranks, of an operator on vectors of rows."""
    x, y, start = like.duplicate(), like.duplicate(), like.getOwnershipRange()[0]
    columns = []
    for i in range(like.getSize()):
        x.set(0.0)
        if 0 <= i - start < like.getLocalSize():
            x.array[i - start] = 1.0
        multiply(x, y)
        columns.append(np.concatenate(COMM.allgather(y.array_r)))
    x.destroy()
    y.destroy()
    return np.array(columns).T


def spectrum(p):
    """M, and the eigenvalues of M F on the range of PF, all rows being on the face."""
    dual, rows = p.dual, p.dual.constraints.num_rows
    face = face_of(np.ones(rows, dtype=bool), np.full(rows, Status.FREE))
    on_face = dual._preconditioner_on(face)
    M, F = columns_of(on_face.mult, dual.d), columns_of(dual.F.mult, dual.d)
    on_face.destroy()
    Gt = np.concatenate(COMM.allgather(dual.coarse.Gt.toarray()))
    P = np.eye(len(F)) - Gt @ np.linalg.pinv(Gt)
    values, V = np.linalg.eigh(P @ F @ P)
    kept = values > 1e-9 * values[-1]
    root = V[:, kept] * np.sqrt(values[kept])
    return M, np.linalg.eigvalsh(root.T @ M @ root)


@pytest.mark.parametrize("options", [{}, {"pc_type": "lumped"}])
def test_the_preconditioner_is_as_near_to_the_inverse_as_without_clusters(clustered, options):
    """No eigenvalue of M F is below 1, and the largest is about that of plain TFETI."""
    p, plain = (square(8, 4, clusters=count, **options) for count in (4, 0))
    found = []
    for problem in (p, plain):
        problem.solve()
        M, values = spectrum(problem)
        assert np.allclose(M, M.T, atol=1e-10 * np.abs(M).max())
        assert values[0] >= 1.0 - 1e-8
        found.append(values[-1])
        problem.destroy()
    assert found[0] <= 1.3 * found[1]


@pytest.mark.parametrize("options", [{}, {"qp_type": "smalse"}, {"pc_type": "lumped"}])
def test_the_answer_is_the_same(options):
    u, _ = solved(square(8, 4, rtol=1e-9, **options))
    for clusters in (1, 3, 16):
        v, report = solved(square(8, 4, rtol=1e-9, clusters=clusters, **options))
        assert difference(v, u) <= 1e-7
        assert report.converged_reason == "CONVERGED_RTOL"


def test_two_bodies():
    """A cluster is of one body."""

    def problem(**options):
        d = stacked("quadrilateral", subdomains=12)
        bcs = held(d, "lower bottom", "lower left")
        contact = [sided("upper bottom", "lower top")]
        return two_body_problem(d, pressed(d), bcs, contact, rtol=1e-9, **options)

    u, _ = solved(problem())
    v, report = solved(problem(clusters=2))
    assert 2 <= report.clusters < report.subdomains
    assert difference(v, u) <= 1e-7


@pytest.mark.parametrize(
    ("cell", "counts"),
    [
        ("quadrilateral", (1, 2, 4, 8)),
        pytest.param("hexahedron", (1, 2, 8, 32), marks=pytest.mark.slow),
    ],
)
def test_clusters_cost_hardly_more(cell, counts, serial_only):
    """Many small ones and few large ones: three rows of the coarse problem each, or six."""
    cells = 16 if cell == "quadrilateral" else 8
    modes = 3 if cell == "quadrilateral" else 6
    _, plain = solved(square(cells, 4, cell))
    for count in counts:
        _, report = solved(square(cells, 4, cell, clusters=count))
        assert report.kernel_dim == modes * count
        assert report.F_multiplications <= 1.3 * plain.F_multiplications + 1


def test_without_them_nothing_is_paid():
    p = square(8, 2)
    p.solve()
    assert not isinstance(p.dual.subdomains, ClusteredSubdomains)
    assert p.report.clusters == p.report.soft_modes == 0
    p.destroy()


def test_a_new_load_and_a_second_solve():
    p = square(8, 4, clusters=4, rtol=1e-9)
    p.solve()
    first = p.solution.u.copy()
    p.solve()
    assert p.report.factorizations == 0
    assert p.report.F_multiplications <= 2
    assert difference(p.solution.u, first) <= 1e-8
    p.destroy()


def test_a_new_stiffness():
    """Glue is made anew from the new factors."""
    found = []
    for clusters in (0, 4):
        p = square(8, 4, clusters=clusters, rtol=1e-9)
        p.solve()
        V = p.dofs.V
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        p.update(stiffness=ufl.inner(hooke(3.0)(u), strain(v)) * ufl.dx)
        p.solve()
        found.append(p.solution.u.copy())
        p.destroy()
    assert difference(*found) <= 1e-7


def test_more_clusters_than_subdomains():
    p = square(8, 2, clusters=5)
    with pytest.raises(InputError, match="5 clusters of 4 subdomains; expected at most"):
        p.solve()
    p.destroy()


def ladder_scene(name, cell, value, clusters):
    ladder = next(ladder for ladder in LADDERS if ladder.name == name)
    scene = ladder.rung(cell, value)
    return replace(scene, options={**scene.options, "tfeti_clusters": clusters})


def test_thin_clusters_are_glued_as_exactly_as_subdomains():
    """F_c has condition numbers like (L/t)⁴: its inverse, as a matrix, would lose these digits."""
    row = run_scene(ladder_scene("flat block", "hexahedron", 100.0, 2), COMM)
    if COMM.rank == 0:
        assert row["class"] == "right", row


def test_averages_that_rounding_makes_dependent_are_named():
    with pytest.raises(FactorError, match="-tfeti_clusters 0"):
        Saddle(np.ones((2, 2)), np.eye(2), np.zeros((2, 0)))


def test_averages_have_no_part_in_what_clusters_give_way_to(clustered):
    """K̃⁺B_cᵀ = 0 and B_cK̃⁺ = 0, to rounding of what is left."""
    subdomains = clustered.dual.subdomains
    B, rng = subdomains._clusters.averages, np.random.default_rng(COMM.rank)
    free = np.asarray(B.T @ rng.standard_normal(B.shape[0]))
    some = rng.standard_normal(len(free))
    u = subdomains.solve(some)
    size = np.abs(u).max(initial=1.0)
    assert np.abs(B @ u).max(initial=0.0) <= 1e-14 * size
    assert np.abs(subdomains.solve(free)).max(initial=0.0) <= 1e-14 * size


def test_a_cluster_that_no_row_holds_stays_where_it_is():
    """NᵀAN is rounding there, of any sign."""
    d = decomposed("tetrahedron", 6, grid(3))
    V, a, L = forms(d.mesh, d.facet_tags, (0.0, 0.0, 0.0), d.surface("top"))
    obstacles = [tfeti.Obstacle("bottom", curved_obstacle(3, gap=0.1), reach=np.inf)]
    p = tfeti.ContactProblem(a, L, [], obstacles, d, petsc_options={"tfeti_clusters": 1})
    u, report = solved(p)
    assert np.abs(u).max(initial=0.0) <= 1e-12
    assert any("rigid motions are free" in warning for warning in report.warnings)
