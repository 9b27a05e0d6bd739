"""GGᵀ where bodies differ by many orders of magnitude, and where rows leave motions free."""

import numpy as np
import pytest
import ufl
from bodies import boxes, held, pressed, stacked, two_body_problem
from dolfinx import fem
from mpi4py import MPI
from scenes import hooke
from scipy.sparse import csr_array, diags_array
from test_solvable_lp import dual_of

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.errors import FactorError
from tfeti_dolfinx.feti.projectors import SemidefiniteFactor
from tfeti_dolfinx.feti.rigid_bodies import null_basis, unresisted, unsprung


def stiff_upper(d, E):
    """Stress of bodies of which those above z = 0 have the modulus E."""
    gdim = d.mesh.geometry.dim

    def stress(u):
        x = ufl.SpatialCoordinate(d.mesh)
        return ufl.conditional(ufl.gt(x[gdim - 1], 0.0), E, 1.0) * hooke()(u)

    return stress


@pytest.fixture(params=["quadrilateral", "hexahedron"])
def stiff_on_soft(request):
    """A body of several subdomains that is held only by one that is 1e16 times softer."""
    d = stacked(request.param, 2, 2, 4)
    contact = tfeti.Contact("lower top", "upper bottom")
    stress = stiff_upper(d, 1e16)
    sides = held(d, "lower bottom", "lower left", "upper left")
    p = two_body_problem(d, pressed(d, 1e-4), sides, [contact], stress=stress)
    dual = dual_of(p)
    yield dual
    p.destroy()


def test_a_stiff_body_that_contact_with_a_soft_one_holds(stiff_on_soft):
    """Gluing rows of the stiff body are 1e8 times as large as the rows that hold it."""
    coarse = stiff_on_soft.coarse
    mu = np.random.default_rng(0).standard_normal(coarse.dimension)
    size = np.sqrt(coarse.grams.whole.diagonal())
    mu = coarse.null.removed(mu / np.where(size > 0.0, size, 1.0))
    x = stiff_on_soft.d.duplicate()
    coarse.combine(mu, x)
    error = size * (coarse.coordinates(x) - mu)
    assert np.abs(error).max() <= 1e-9 * np.abs(size * mu).max()


def test_motions_of_bodies_know_nothing_of_gluing(stiff_on_soft):
    """In kernel coordinates that are motions of bodies G is exactly zero on gluing rows."""
    coarse = stiff_on_soft.coarse
    moves = abs(coarse.J).sum(axis=1) > 0.0
    motions = coarse.Gt[:, : len(coarse._basis.pins)]
    assert np.array_equal(moves, abs(motions).sum(axis=1) > 0.0)
    gluing = coarse.comm.allreduce(int(np.sum(~moves)))
    assert gluing > 0


def test_the_basis_spans_the_kernel(stiff_on_soft):
    """T T⁻¹ = I, and Tᵀ is what products takes."""
    coarse = stiff_on_soft.coarse
    basis, bodies = coarse._basis, coarse.bodies
    back = [basis.kernel(column) for column in coarse.motions.toarray().T]
    assert np.allclose(np.transpose(back), bodies.motions.toarray(), atol=1e-12)
    rng = np.random.default_rng(0)
    x, y = rng.standard_normal((2, coarse.dimension))
    assert basis.products(x) @ y == pytest.approx(x @ basis.kernel(y))


def test_a_motion_that_contact_holds_by_next_to_nothing_is_free():
    """Equalities leave one direction, along which the contact rows have 1e-7 of their size."""
    rng = np.random.default_rng(3)
    free = rng.standard_normal(3)
    free /= np.linalg.norm(free)
    equalities = rng.standard_normal((4, 3))
    equalities -= np.outer(equalities @ free, free)
    contact = rng.standard_normal((5, 3))
    contact -= np.outer(contact @ free - 1e-7, free)
    held_by = [csr_array(rows.T @ rows) for rows in (equalities, contact)]
    unheld = unresisted(held_by[0], unsprung(np.zeros((1, 3, 3))))
    assert unheld.count == 1
    assert unresisted(held_by[1], unheld).count == 1
    assert unresisted(csr_array(np.eye(3)), unheld).count == 0


def test_a_body_that_slides_along_all_that_it_meets():
    """A block between walls in x, held in y: it slides in z, whatever rounding says."""
    parts = [("block", (0.1, 0.2, 0.3), (1.3, 0.9, 1.1), (2, 2, 2))]
    mesh, tags, names = boxes("tetrahedron", parts)
    d = tfeti.decompose(mesh, 3, facet_tags=tags, surfaces=names)
    wall = tfeti.Obstacle("block right", tfeti.Plane((1.4, 0.0, 0.0), (-1, 0, 0)))

    def load(v, ds):
        push = fem.Constant(d.mesh, (1e-3, 0.0, 0.0))
        return ufl.dot(push, v) * ds(d.surface("block left"))

    p = two_body_problem(d, load, held(d, "block left", "block front"), [wall])
    assert dual_of(p).coarse.num_free_motions == 1
    p.destroy()


def test_gluing_far_from_the_origin_holds_nothing():
    """Coordinates are rounded to 1e-11 of the body, and so are its motions on interfaces."""
    far = 2.0**16
    parts = [("block", (0.0, 0.0), (1.0, 1.0), (3, 3))]
    mesh, tags, names = boxes("triangle", parts)
    mesh.geometry.x[:, :2] = (mesh.geometry.x[:, :2] + far) / 3.0
    d = tfeti.decompose(mesh, 4, facet_tags=tags, surfaces=names)
    p = two_body_problem(d, pressed(d, 0.0, "block top"), lambda V: [], [])
    assert dual_of(p).coarse.num_free_motions == 3
    p.destroy()


NO_NULL = null_basis(np.empty(0, dtype=np.int64), csr_array((4, 0)))
LAPLACIAN = np.diag([1.0, 2.0, 2.0, 1.0]) - np.diag(np.ones(3), 1) - np.diag(np.ones(3), -1)


def test_a_pivot_that_is_lost_to_rounding_is_no_error():
    """A null vector nobody knew of: solutions for right sides in the range are right still."""
    sizes = diags_array([1e-8, 1.0, 1e5, 1e-3])
    A = csr_array(sizes @ (LAPLACIAN - 1e-16 * np.eye(4)) @ sizes)
    factor = SemidefiniteFactor(A, NO_NULL, MPI.COMM_WORLD, "A")
    b = sizes @ (LAPLACIAN @ np.array([1.0, -2.0, 0.5, 3.0]))
    left = (A @ factor.solve(b) - b) / sizes.diagonal()
    factor.destroy()
    assert np.abs(left).max() <= 1e-9


def test_an_indefinite_matrix_is_named_on_all_ranks():
    A = csr_array(LAPLACIAN - 0.1 * np.eye(4))
    with pytest.raises(FactorError, match="A of the test: not positive definite"):
        SemidefiniteFactor(A, NO_NULL, MPI.COMM_WORLD, "A of the test")


def test_pins_are_chosen_in_the_units_of_the_matrix():
    """The null vector is largest where the matrix is smallest."""
    sizes = np.array([1e-4, 1.0, 1.0, 1.0])
    A = csr_array(np.diag(sizes) @ (np.eye(4) - np.full((4, 4), 0.25)) @ np.diag(sizes))
    vector = 1.0 / sizes
    null = null_basis(np.empty(0, dtype=np.int64), csr_array(vector[:, None]))
    factor = SemidefiniteFactor(A, null, MPI.COMM_WORLD, "A")
    b = A @ np.array([1.0, 2.0, 3.0, 4.0])
    x = factor.solve(b)
    factor.destroy()
    assert np.allclose(A @ x, b, rtol=1e-9, atol=1e-12)
    assert abs(x @ vector) <= 1e-9 * np.linalg.norm(vector)
