"""Clusters: K̃⁺ against a dense saddle-point problem, and scenes against the same without them."""

from dataclasses import replace

import numpy as np
import pytest
import ufl
from bodies import held, pressed, sided, stacked, two_body_problem
from mpi4py import MPI
from scenes import clamp, curved_obstacle, decomposed, forms, hooke, strain
from scipy.sparse import csr_array

import tfeti_dolfinx as tfeti
from benchmarks.stability_scenes import LADDERS
from benchmarks.stress.judge import run_scene
from tfeti_dolfinx.errors import FactorError, InputError
from tfeti_dolfinx.subdomains import averages
from tfeti_dolfinx.subdomains.clusters import ClusteredSubdomains
from tfeti_dolfinx.subdomains.glue import Saddle

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


def test_soft_motions_are_what_is_left_of_the_inverse(clustered):
    """K̃⁺ ≥ R̂R̂ᵀ on the trace, R̂ of energy 1: what they hold is a part of the inverse."""
    subdomains = clustered.dual.subdomains
    motions = subdomains.soft_motions()
    assert np.all(motions.energy == 1.0)
    operator, t = subdomains.local_operator("pinv"), len(subdomains.trace)
    operator.prepare()
    columns = np.empty((t, t))
    for e, column in zip(np.eye(t), columns, strict=True):
        operator.mult(e, column)
    R = subdomains.kernel_rows.toarray()
    P = np.eye(t) - R @ np.linalg.pinv(R)
    rest = P @ (columns - (motions.rows @ motions.rows.T).toarray()) @ P
    values = np.linalg.eigvalsh((rest + rest.T) / 2.0)
    assert values.min(initial=0.0) >= -1e-10 * values.max(initial=1.0)


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
    "cell", ["quadrilateral", pytest.param("hexahedron", marks=pytest.mark.slow)]
)
def test_compact_clusters_cost_at_most_half_more(cell, serial_only):
    cells = 16 if cell == "quadrilateral" else 8
    _, plain = solved(square(cells, 4, cell))
    _, report = solved(square(cells, 4, cell, clusters=4 if cell == "quadrilateral" else 8))
    assert report.kernel_dim < plain.kernel_dim / 3
    assert report.F_multiplications <= 1.5 * plain.F_multiplications


def test_hooks_have_soft_motions(serial_only, monkeypatch):
    """Two hooks of 8 of 16 squares hold each other; the preconditioner knows where they bend."""
    hooks = np.array([0, 0, 0, 0, 0, 1, 1, 1, 0, 0, 0, 1, 1, 1, 1, 1])
    monkeypatch.setattr(averages, "_metis_of", lambda graph, count, sizes: hooks)
    _, plain = solved(square(16, 4))
    _, report = solved(square(16, 4, clusters=2))
    monkeypatch.setattr("tfeti_dolfinx.subdomains.glue.SOFT", 1e-9)
    _, without = solved(square(16, 4, clusters=2))
    assert report.clusters == 2
    assert report.soft_modes > without.soft_modes == 0
    assert report.F_multiplications < 0.75 * without.F_multiplications
    assert report.F_multiplications <= 2.5 * plain.F_multiplications


def test_subdomains_of_a_body_that_hang_together_elsewhere(serial_only):
    """Of a fork a rank may have the prongs alone."""
    pairs, nodes = np.array([[0, 1], [2, 3], [4, 5], [6, 7]]), np.full(4, 3)
    whole = np.array([0, 0, 1, 1, 2, 2, 3, 3])
    sizes = np.full(8, 100)
    part = averages._parts(pairs, nodes, sizes, whole, 0.5)
    assert np.array_equal(part, whole)
    finer = averages._parts(pairs, nodes, sizes, whole, 1.0)
    assert all(len(np.unique(whole[finer == one])) == 1 for one in np.unique(finer))


@pytest.mark.parametrize("wanted", [4, 8, 16, 24])
def test_clusters_of_irregular_subdomains_have_about_as_many_each(wanted, serial_only):
    """Subdomains that touch all around, as METIS makes them; not half of all in one cluster."""
    x = np.stack(np.meshgrid(range(4), range(4), range(2)), axis=-1).reshape(-1, 3)
    apart = np.abs(x[:, None] - x).max(axis=2) + np.tri(32)
    pairs = np.argwhere(apart == 1)
    steps = np.abs(x[pairs[:, 0]] - x[pairs[:, 1]]).sum(axis=1)
    nodes, alike = np.array([0, 60, 9, 4])[steps], np.full(32, 500)
    part = averages._parts(pairs, nodes, alike, np.zeros(32, int), wanted / 32)
    sizes = np.bincount(part, minlength=wanted)
    assert sizes.min() >= 1
    assert sizes.max() <= np.ceil(32 / wanted) + 1


@pytest.mark.parametrize("wanted", [1, 2, 4, 6])
def test_crumbs_stay_with_the_neighbour_that_holds_them_best(wanted, serial_only):
    """Of a row of six, a crumb at the end of each, which touches the next one a little, too."""
    row, crumbs = np.arange(6), np.arange(6, 12)
    ends = (row[:-1], row[1:]), (row, crumbs), (row[1:], crumbs[:-1])
    pairs = np.concatenate([np.stack(both, axis=1) for both in ends])
    nodes = np.repeat([60, 20, 4], [5, 6, 5])
    sizes = np.repeat([500, 50], 6)
    part = averages._parts(pairs, nodes, sizes, np.zeros(12, int), wanted / 12)
    assert np.array_equal(part[crumbs], part[row])
    assert len(np.unique(part)) == wanted


def test_parts_hang_together(serial_only):
    """A piece goes to where its faces have most nodes, unless it has none, the smallest first."""
    graph = np.zeros((6, 6))
    for i, j, weight in ((0, 1, 9), (1, 2, 5), (2, 3, 7), (3, 4, 2), (0, 4, 1)):
        graph[i, j] = graph[j, i] = weight
    sizes = np.array([5, 5, 1, 5, 2, 5])
    for given, expected in (
        ([0, 0, 1, 1, 1, 2], [0, 0, 1, 1, 1, 2]),
        ([0, 0, 1, 0, 1, 2], [0, 0, 0, 0, 1, 2]),  # 2, the smaller of 1's, goes to 3; 0 is whole
        ([0, 0, 1, 0, 0, 2], [0, 0, 1, 0, 0, 2]),  # round about by 4
        ([0, 1, 0, 1, 0, 0], [0, 1, 1, 1, 0, 0]),  # 5 has no neighbour
    ):
        found = averages._hanging_together(csr_array(graph), np.array(given), sizes)
        assert found.tolist() == expected


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
