"""GGᵀ where rows leave motions free, and where it is indefinite."""

import numpy as np
import pytest
from bodies import drawn, held, pressed, stacked, stiffer_above, torn_boxes, two_body_problem
from mpi4py import MPI
from scipy.sparse import csr_array
from test_solvability import dual_of

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.errors import FactorError
from tfeti_dolfinx.feti.projectors import Grams, NullModes, SemidefiniteFactor
from tfeti_dolfinx.qp.sets import Face, Status


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_a_stiff_body_that_contact_with_a_soft_one_holds(cell):
    """Gluing rows of the stiff body are 1e8 times as large as the rows that hold it."""
    d = stacked(cell, 2, 2, 4)
    sides = held(d, "lower bottom", "lower left", "upper left")
    contact = tfeti.Contact("lower top", "upper bottom")
    p = two_body_problem(d, pressed(d, 1e-4), sides, [contact], stress=stiffer_above(d, 1e16))
    dual = dual_of(p)
    coarse = dual.coarse
    mu = np.random.default_rng(0).standard_normal(coarse.dimension)
    size = np.sqrt(coarse.grams.whole.diagonal())
    mu = mu / np.where(size > 0.0, size, 1.0)
    mu -= coarse.null @ (coarse.null.T @ mu)
    error = size * (coarse.coordinates(coarse.combined(mu)) - mu)
    assert np.abs(error).max() <= 1e-9 * np.abs(size * mu).max()


def test_a_body_that_slides_along_all_that_it_meets():
    """A block between walls in x, held in y: it slides in z, whatever rounding says."""
    parts = [("block", (0.1, 0.2, 0.3), (1.3, 0.9, 1.1), (2, 2, 2))]
    d = torn_boxes("tetrahedron", parts, 3)
    wall = tfeti.Obstacle("block right", tfeti.Plane((1.4, 0.0, 0.0), (-1, 0, 0)))
    load = drawn(d, "block left", (1e-3, 0.0, 0.0))
    p = two_body_problem(d, load, held(d, "block left", "block front"), [wall])
    assert dual_of(p).coarse.free_motions.count == 1


def test_gluing_far_from_the_origin_holds_nothing():
    """Coordinates are rounded to 1e-11 of the body, and so are its motions on interfaces."""
    far = 2.0**16
    parts = [("block", (0.0, 0.0), (1.0, 1.0), (3, 3))]
    d = torn_boxes("triangle", parts, 4)
    d.mesh.geometry.x[:, :2] = (d.mesh.geometry.x[:, :2] + far) / 3.0
    p = two_body_problem(d, pressed(d, 0.0, "block top"), held(d), [])
    assert dual_of(p).coarse.free_motions.count == 3


NO_NULL = NullModes(csr_array((4, 0)))
LAPLACIAN = np.diag([1.0, 2.0, 2.0, 1.0]) - np.diag(np.ones(3), 1) - np.diag(np.ones(3), -1)


def test_an_indefinite_matrix_is_named_on_all_ranks():
    A = csr_array(LAPLACIAN - 0.1 * np.eye(4))
    with pytest.raises(FactorError, match="A of the test: not positive definite"):
        SemidefiniteFactor(A, NO_NULL, MPI.COMM_WORLD, "A of the test")


def test_what_cancels_along_a_tangent_leaves_no_rounding(comm):
    """GZ(GZ)ᵀ of two rows a rank that differ by 1e-5, along (1, −1)/√2: what is left, squared."""
    Gt, way = np.array([[1 / 3, 0.7], [1 / 3 + 1e-5, 0.2]]), np.array([[1.0, -1.0]]) / np.sqrt(2.0)
    slips = Face(np.zeros(2, bool), np.full(2, Status.SLIP), np.array([[0, 1]]), way, np.zeros(1))
    gram = Grams(csr_array(Gt), np.arange(2), comm).of_face(slips).toarray()
    expected = comm.size * (way @ Gt).T @ (way @ Gt)
    assert np.all(np.abs(gram - expected) <= 1e-10 * np.abs(expected))


def test_what_rounding_of_slipping_rows_holds_is_free(comm):
    """A motion that a free row and a tangent hold by rounding, a row that is not free by 1."""
    Gt = np.array([[1.0, 1e-17], [0.5, 1e-17], [0.2, 0.0], [0.0, 1.0]])
    way, status = np.array([[1.0, 0.0]]), np.array([Status.FREE, *2 * [Status.SLIP], Status.OPEN])
    slips = Face(status == Status.FREE, status, np.array([[1, 2]]), way, np.zeros(1))
    gram = Grams(csr_array(Gt), np.arange(1, 4), comm).of_face(slips).toarray()
    assert np.allclose(gram, comm.size * np.diag([1.25, 0.0]), rtol=1e-15, atol=0.0)
