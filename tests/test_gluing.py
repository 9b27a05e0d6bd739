"""Rows of B: orthonormal, blind to continuous fields, right at torn nodes."""

import numpy as np
import pytest
from bodies import (
    dofs_on,
    gathered,
    held,
    nodal,
    pressed,
    sided,
    sides_of,
    stacked,
    stiffer_above,
    two_body_problem,
)
from dolfinx import fem
from scenes import clamp, curved_obstacle, decomposed, roller, solved
from scipy.sparse import csr_array

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.constraints.gluing import glue
from tfeti_dolfinx.contact.records import concatenate
from tfeti_dolfinx.forms.dirichlet import prescribe


class Scene:
    """B of a torn box, as one scipy matrix on every rank."""

    def __init__(self, cell="hexahedron", n=4, degree=1, clamped=True, contacts=(), weights=None):
        self.d = d = decomposed(cell, n, subdomains=lambda x: (x[0] > 0.5) + 2 * (x[1] > 0.5))
        gdim = d.mesh.geometry.dim
        self.dofs = dofs = dofs_on(d, degree)
        bcs = [clamp(dofs.V, d.facets("left"), np.arange(1.0, gdim + 1))] if clamped else []
        none = prescribe(dofs, [])
        found = [c.records(dofs, i, np.inf, np.inf, none) for i, c in enumerate(contacts)]
        self.weights = np.ones(dofs.num_nodes * dofs.bs) if weights is None else weights(dofs)
        self.gluing = glue(dofs, prescribe(dofs, bcs), concatenate(found, gdim), 1.0, self.weights)
        self.constraints = self.gluing.constraints

    @property
    def B(self):
        indptr, indices, data = self.constraints.B.getValuesCSR()
        m, n = len(indptr) - 1, self.constraints.B.getSize()[1]
        return gathered(csr_array((data, indices, indptr), shape=(m, n)).toarray())

    def trace(self, values):
        """Trace values of all ranks from primal values."""
        return gathered(values[self.constraints.trace])

    def rows(self, name):
        """Flags of a named set among all ranks' rows."""
        flags = np.zeros(self.constraints.num_rows, dtype=bool)
        flags[getattr(self.constraints.sets, name)] = True
        return gathered(flags)

    @property
    def rhs(self):
        return gathered(np.array(self.constraints.c))


@pytest.mark.parametrize(
    ("cell", "degree", "clamped"),
    [
        ("triangle", 2, False),
        ("quadrilateral", 1, True),
        ("tetrahedron", 2, True),
        ("hexahedron", 1, False),
    ],
)
def test_equality_rows_are_orthonormal(cell, degree, clamped):
    B = Scene(cell, 4 if degree == 1 else 2, degree, clamped).B
    assert np.allclose(B @ B.T, np.eye(len(B)), atol=1e-13)


def test_rows_are_orthonormal_in_the_inner_product_of_the_stiffness():
    def weights(dofs):
        return 1.0 + 1e4 * (dofs.node_subdomain.repeat(dofs.bs) % 2)

    plane = tfeti.Obstacle("bottom", tfeti.Plane((0, 0, -0.1), (0.1, 0.2, 1.0)))
    scene = Scene(contacts=[plane], weights=weights)
    B, D = scene.B, scene.trace(scene.weights)
    assert np.allclose(B / D @ B.T, np.eye(len(B)), atol=1e-12)
    # without supports they are as many as there are jumps, and blind to continuous fields
    scene = Scene(clamped=False)
    A = np.array([[1.0, 2, 3], [4, 5, 6], [7, 8, 9]])
    assert np.abs(scene.B @ scene.trace(nodal(scene.dofs, lambda x: np.sin(x @ A)))).max() <= 1e-12
    dofs = scene.dofs
    jumps = dofs.comm.allreduce(int(np.sum(dofs.multiplicity - 1))) * dofs.bs
    assert len(scene.B) == np.linalg.matrix_rank(scene.B) == jumps


def test_dirichlet_rows_hold_every_copy_with_its_value():
    scene = Scene()
    u = nodal(scene.dofs, lambda x: np.broadcast_to([1.0, 2.0, 3.0], x.shape))
    assert np.allclose(scene.B @ scene.trace(u), scene.rhs, atol=1e-13)
    dofs = scene.dofs
    left = nodal(scene.dofs, lambda x: np.isclose(x, 0.0)[:, [0, 0, 0]])
    held = np.sum(left)
    ones = np.sum(np.isclose(np.abs(scene.B).max(axis=1), 1.0, rtol=1e-12))
    assert ones == dofs.comm.allreduce(int(held))


def test_a_dirichlet_value_reaches_copies_that_have_no_facet_on_the_surface():
    d = decomposed("triangle", 2, subdomains=lambda x: np.arange(x.shape[1]))
    dofs = dofs_on(d)
    left = fem.locate_dofs_topological(dofs.V.sub(1), 1, d.facets("left"))
    held = prescribe(dofs, [roller(dofs.V, 1, d.facets("left"), 0.5)])
    gluing = glue(dofs, held, concatenate([], 2), 1.0, np.ones(dofs.num_nodes * 2))
    found = d.comm.allreduce(int(np.sum(np.isclose(gluing.constraints.c, 0.5))))
    x = dofs.V.tabulate_dof_coordinates()
    assert found == d.comm.allreduce(int(np.sum(np.isclose(x[:, 0], 0))))
    assert found > d.comm.allreduce(len(left))


def test_contact_rows_are_unit_and_orthogonal_to_the_gluing():
    scene = Scene(contacts=[tfeti.Obstacle("bottom", curved_obstacle(3))])
    B, N = scene.B[scene.rows("equalities")], scene.B[scene.rows("normals")]
    # one for each node however it is torn, but for those that are clamped
    decided = scene.gluing.constraints.contact.decided
    assert len(N) == 5 * 5 - scene.d.comm.allreduce(len(decided)) == 20
    area = scene.gluing.records.area
    assert scene.d.comm.allreduce(area.sum()) == pytest.approx(1.0)
    assert np.allclose(np.linalg.norm(N, axis=1), 1.0)
    assert np.abs(N @ B.T).max() <= 1e-14
    assert np.allclose(N @ N.T, np.eye(len(N)), atol=1e-14)


def test_contact_rows_measure_the_approach_in_scaled_lengths():
    plane = tfeti.Obstacle("bottom", tfeti.Plane((0, 0, -0.1), (0, 0, 2)))
    scene = Scene(contacts=[plane], clamped=False)
    rows = scene.rows("normals")
    u = nodal(scene.dofs, lambda x: np.column_stack((x[:, 0], x[:, 1], -0.3 - x[:, 0])))
    scale = gathered(scene.gluing.constraints.scale)
    approach = (scene.B @ scene.trace(u))[rows] / scale
    assert np.allclose(scene.rhs[rows] / scale, 0.1)
    assert approach.min() == pytest.approx(0.3)
    assert approach.max() == pytest.approx(1.3)


def test_prescribed_components_move_into_the_gap():
    slanted = tfeti.Obstacle("bottom", tfeti.Plane((0, 0, -5), (3, 0, 4)))
    d = decomposed("hexahedron", 2, 2)
    dofs = dofs_on(d)
    records = concatenate([slanted.records(dofs, 0, np.inf, np.inf, prescribe(dofs, []))], 3)
    held = prescribe(dofs, [roller(dofs.V, 0, d.facets("bottom"), 1.0)])
    gluing = glue(dofs, held, records, 1.0, np.ones(dofs.num_nodes * 3))
    rows = gluing.constraints.sets.normals
    gap = gluing.constraints.c[rows] / gluing.constraints.scale
    assert np.allclose(gap, records.gap[gluing.constraints.contact.normals] + 0.6 * 1.0)


# the rows alone matter: no step of the solver is made
ROWS_ONLY = dict(max_it=0, norm_steps=1, error_if_not_converged=False)
UP, DOWN = ("upper bottom", "lower top"), ("lower top", "upper bottom")  # secondary, primary


def extremes(cell, n, subdomains, scaling="stiffness", pair=UP, stiffness=1.0):
    """Of a box on a box, n = (cells of the lower, cells of the upper), the upper one stiffer."""
    d = stacked(cell, *n, subdomains)
    stress = stiffer_above(d, stiffness)
    given = d, pressed(d), held(d, *sides_of(cell)), [sided(*pair)]
    p = solved(two_body_problem(*given, stress=stress, scaling=scaling, **ROWS_ONLY))
    indptr, indices, data = p.dual.constraints.B.getValuesCSR()
    B = csr_array((data, indices, indptr), shape=p.dual.constraints.B.getSize())
    values = np.linalg.eigvalsh(((B / p.dual.constraints.weights) @ B.T).toarray())
    p.destroy()
    return values[0], values[-1]


SCENES = {
    "quadrilateral": [((6, 8), 4), ((12, 16), 4), ((12, 16), 32)],
    "hexahedron": [((2, 3), 4), ((4, 6), 4), ((4, 6), 16)],
}


@pytest.mark.parametrize(
    ("cell", "scaling", "low", "high"),
    [
        ("quadrilateral", "stiffness", 0.55, 1.4),
        ("quadrilateral", "multiplicity", 0.5, 1.5),
        ("hexahedron", "stiffness", 0.64, 1.8),
        ("hexahedron", "multiplicity", 0.38, 2.4),
    ],
)
def test_bounds_depend_neither_on_h_nor_on_H(cell, scaling, low, high, serial_only):
    for scene in SCENES[cell]:
        least, largest = extremes(cell, *scene, scaling)
        assert low <= least <= largest <= high


def test_a_jump_of_stiffness_does_not_matter_where_the_softer_body_is_secondary(serial_only):
    for jump in (1.0, 1e3, 1e6):
        least, largest = extremes("quadrilateral", (6, 8), 8, pair=DOWN, stiffness=jump)
        assert 0.95 <= least <= largest <= 1.1
    # rows of a stiff and fine secondary live on the primary side in D⁻¹, which has fewer nodes
    least, _ = extremes("quadrilateral", (6, 8), 8, stiffness=1e3)
    assert 1e-4 < least < 1e-2
