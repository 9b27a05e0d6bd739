"""Clusters: K̃⁺ against a dense saddle-point problem, and scenes against the same without them."""

import numpy as np
import pytest
import ufl
from bodies import held, pressed, sided, stacked, two_body_problem
from mpi4py import MPI
from scenes import apart, curved_obstacle, decomposed, elastic, grid, problem

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.clusters.subdomains import ClusteredSubdomains, Saddle
from tfeti_dolfinx.errors import FactorError, InputError

COMM = MPI.COMM_WORLD


def square(cells=16, parts=4, cell="quadrilateral", **options):
    """A square or cube of equal subdomains, clamped on the left, pressed on a curved obstacle."""
    d = decomposed(cell, cells, grid(parts))
    gdim = d.mesh.geometry.dim
    obstacle = tfeti.Obstacle("bottom", curved_obstacle(gdim), reach=0.2)
    return problem(d, (0.0,) * (gdim - 1) + (-0.1,), [obstacle], **options)


def solved(p):
    p.solve()
    u, report = p.solution.u, p.report
    p.destroy()
    return u, report


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
    n, r = len(K), subdomains.kernel_rows.shape[1]
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


@pytest.mark.parametrize(
    ("parts", "clusters", "options"),
    [(4, 1, {"qp_type": "smalse"}), (4, 3, {"pc_type": "lumped"}), (4, 16, {}), (1, 1, {})],
)
def test_the_answer_is_the_same(parts, clusters, options):
    u, plain = solved(square(8, parts, rtol=1e-9, **options))
    v, report = solved(square(8, parts, rtol=1e-9, clusters=clusters, **options))
    assert apart(v, u) <= 1e-7
    assert report.converged_reason == "CONVERGED_RTOL"
    assert report.kernel_dim <= plain.kernel_dim


def test_two_bodies():
    """A cluster is of one body."""

    def stack(**options):
        d = stacked("quadrilateral", subdomains=12)
        bcs = held(d, "lower bottom", "lower left")
        contact = [sided("upper bottom", "lower top")]
        return two_body_problem(d, pressed(d), bcs, contact, rtol=1e-9, **options)

    u, _ = solved(stack())
    v, report = solved(stack(clusters=2))
    assert 2 <= report.clusters < report.subdomains
    assert apart(v, u) <= 1e-7


def test_a_new_stiffness():
    """Glue is made anew from the new factors."""
    found = []
    for clusters in (0, 4):
        p = square(8, 4, clusters=clusters, rtol=1e-9)
        p.solve()
        V = p.dofs.V
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        p.update(stiffness=elastic(u, v, 3.0))
        p.solve()
        found.append(p.solution.u.copy())
        p.destroy()
    assert apart(*found) <= 1e-7


def test_more_clusters_than_subdomains_and_dependent_averages_are_named():
    p = square(8, 2, clusters=5)
    with pytest.raises(InputError, match="5 clusters of 4 subdomains; expected at most"):
        p.solve()
    with pytest.raises(FactorError, match="-tfeti_clusters 0"):
        Saddle(np.ones((2, 2)), np.eye(2), np.zeros((2, 0)))
