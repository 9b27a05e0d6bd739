"""Springs in the stiffness: the preconditioner knows what they hold softly."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from scenes import clamp, curved_obstacle, decomposed, displacement, forms
from scipy.sparse import csr_array

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.feti import deflation as soft_modes
from tfeti_dolfinx.feti.deflation import SoftModes
from tfeti_dolfinx.feti.projectors import FaceFactors
from tfeti_dolfinx.qp.sets import Status, face_of
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock

SUBDOMAINS = 8


def cubes(x):
    """Eight subdomains."""
    i, j, k = np.minimum((2 * x).astype(int), 1)
    return i + 2 * j + 4 * k


def foundation(stiffness, contact=True, along=(1.0, 1.0, 1.0), **options):
    """A block of 8 cubes, clamped on the left, with springs in each of its points."""
    d = decomposed("hexahedron", 6, cubes)
    V, a, L = forms(d.mesh, d.facet_tags, (0.0, 0.0, -0.1), d.surface("top"))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    spring = fem.Constant(d.mesh, stiffness * np.array(along))
    dx = ufl.Measure("dx", domain=d.mesh, metadata={"quadrature_degree": 2})
    a += sum(spring[i] * u[i] * v[i] for i in range(3)) * dx
    return tfeti.ContactProblem(
        a,
        L,
        [clamp(V, d.facets("left"))],
        [tfeti.Obstacle("bottom", curved_obstacle(3), reach=0.2)] if contact else [],
        d,
        petsc_options={f"tfeti_{name}": value for name, value in options.items()},
    )


def multiplications(stiffness, **options):
    """Those by F, and how many motions were soft."""
    p = foundation(stiffness, **options)
    p.solve()
    counted, soft = p.report.F_multiplications, p.report.soft_modes
    p.destroy()
    return counted, soft


@pytest.mark.parametrize(
    "options",
    [
        {"contact": False},
        {"qp_type": "newton"},
    ],
)
def test_springs_cost_little(options):
    """From next to nothing to stiffer than the body."""
    without, none = multiplications(0.0, **options)
    assert none == 0
    for stiffness in (1e-6, 1e-3, 1.0, 1e4):
        counted, soft = multiplications(stiffness, **options)
        assert soft == (6 * SUBDOMAINS if stiffness <= 1.0 else 0)
        assert counted <= 2 * without


@pytest.mark.parametrize("stiffness", [1.0, 3.0, 10.0, 30.0])
def test_springs_as_stiff_as_subdomains_cost_nothing(monkeypatch, stiffness):
    """Where M_f is better alone, it is left alone: at most one more than with all, or none."""
    counted, _ = multiplications(stiffness)
    for decided in (True, False):
        monkeypatch.setattr(soft_modes, "_stands_out", lambda *args, answer=decided: answer)
        assert counted <= multiplications(stiffness)[0] + 1


@pytest.mark.parametrize("largest", [1.0, 1.8, 6.0])
def test_the_largest_eigenvalue_decides(monkeypatch, largest):
    """That of ĜM_fĜᵀ for motions of energy 1, here by a dense matrix; from below, by 3 steps."""
    p = foundation(0.1)
    p.solve()
    M, x = p.dual.preconditioner, p.dual.d.duplicate()
    rows = np.arange(*x.getOwnershipRange())
    columns = np.random.default_rng(5).standard_normal((x.getSize(), 4))
    Gt, y = csr_array(columns[rows]), x.duplicate()
    MGt = np.empty(Gt.shape)
    for j, column in enumerate(columns.T):
        x.array[:] = column[rows]
        M.mult(x, y)
        MGt[:, j] = y.array_r
    dense = x.getComm().tompi4py().allreduce(Gt.T @ MGt)
    Gt = Gt * np.sqrt(largest / np.linalg.eigvalsh(dense)[-1])
    asked = []
    for bound in (0.7 * largest, 1.001 * largest):
        monkeypatch.setattr(soft_modes, "LARGE", bound)
        asked.append(soft_modes._stands_out(M, csr_array(Gt), x.duplicate()))
    assert asked == [True, False]
    assert M.count["soft motions"] == 2 * soft_modes.STEPS
    p.destroy()


def test_springs_in_clusters():
    """Their motions are among those of subdomains, which the preconditioner has in clusters."""
    without, _ = multiplications(0.0)
    for stiffness in (1e-3, 1.0, 1e4):
        u, v = (displaced(foundation(stiffness, rtol=1e-8, clusters=count)) for count in (0, 4))
        assert np.abs(u - v).max(initial=0.0) <= 1e-6 * largest(u)
        counted, motions = multiplications(stiffness, clusters=4)
        assert motions == 6 * SUBDOMAINS
        assert counted <= 1.5 * without


def displaced(p):
    """The displacement, on this rank."""
    p.solve()
    u = p.solution.u.copy()
    p.destroy()
    return u


def largest(u):
    """The largest displacement of all ranks."""
    return MPI.COMM_WORLD.allreduce(np.abs(u).max(initial=0.0), op=MPI.MAX)


def test_springs_along_one_axis():
    """As a bearing's cage: a translation and two rotations of each subdomain are left."""
    without, _ = multiplications(0.0)
    counted, soft = multiplications(1e-3, along=(1.0, 0.0, 0.0))
    assert soft == 3 * SUBDOMAINS
    assert counted <= 2 * without


def test_they_do_not_change_the_answer():
    p, q = (foundation(1e-3, pc_type=kind, rtol=1e-10) for kind in ("dirichlet", "none"))
    for each in (p, q):
        each.solve()
    assert (p.report.soft_modes, q.report.soft_modes) == (6 * SUBDOMAINS, 0)
    u, other = displacement(p)[1], displacement(q)[1]
    assert np.abs(u - other).max() <= 1e-8 * np.abs(other).max()
    p.destroy()
    q.destroy()


@pytest.mark.parametrize("held", [True, False])
def test_the_preconditioner_is_symmetric_and_positive(held):
    """Also on a face without contact rows."""
    p = foundation(1e-3)
    p.solve()
    dual = p.dual
    rows = dual.constraints.sets.normals
    free = np.ones(dual.constraints.num_rows, dtype=bool)
    free[rows] = held
    status = np.where(free, Status.TOUCHING, Status.OPEN)
    M, vectors = dual.qp().preconditioner_on(face_of(free, status)), []
    for seed in range(2):
        x, y = dual.d.duplicate(), dual.d.duplicate()
        x.array[:] = np.where(free, np.random.default_rng(seed).standard_normal(len(free)), 0.0)
        M.mult(x, y)
        vectors.append((x, y))
    (x, Mx), (z, Mz) = vectors
    assert np.all(Mx.array_r[~free] == 0.0)
    assert x.dot(Mx) > 0.0
    assert x.dot(Mz) == pytest.approx(z.dot(Mx), abs=1e-12 * np.sqrt(x.dot(Mx) * z.dot(Mz)))
    M.destroy()
    p.destroy()


def test_without_springs_nothing_is_made(monkeypatch):
    p = foundation(0.0)
    p.solve()
    dual = p.dual

    def refuse(*arguments):
        raise AssertionError("nothing is to be multiplied or factored")

    monkeypatch.setattr(SparseBlock, "multiply", refuse)
    monkeypatch.setattr(FaceFactors, "factor", refuse)
    soft = SoftModes(dual.constraints.B, dual.coarse, dual.constraints.weights, dual.preconditioner)
    free = np.ones(dual.constraints.num_rows, dtype=bool)
    face = face_of(free, np.full(len(free), Status.FREE))
    assert soft.count == 0
    assert soft.balanced(face, dual.preconditioner) is dual.preconditioner
    p.destroy()
