"""Tangential rows: they measure slip, on any ranks, and where the normal is prescribed too."""

import numpy as np
import pytest
from bodies import dofs_on, nodal, searched, sided, stacked
from mpi4py import MPI
from scenes import by_point, curved_obstacle, decomposed, roller

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.constraints.gluing import glue
from tfeti_dolfinx.contact.friction import friction_values
from tfeti_dolfinx.contact.records import slips
from tfeti_dolfinx.forms.dirichlet import EndPlanes, prescribe
from tfeti_dolfinx.mortar.facets import group_points

TRESCA, COULOMB = tfeti.Tresca(0.1), tfeti.Coulomb(0.3)


def times_rows(gluing, u):
    """B u − c of this rank's rows."""
    constraints = gluing.constraints
    return constraints.jumps(u[constraints.trace]) - constraints.c


def weights_of(dofs):
    return 1.0 + np.arange(dofs.num_nodes * dofs.bs) % 7


@pytest.mark.parametrize(
    ("cell", "degree"),
    [("triangle", 1), ("quadrilateral", 2), ("tetrahedron", 2), ("hexahedron", 1)],
)
def test_rows_measure_slips(cell, degree):
    """T u = s_i times the slip of u without jumps; the lower body slides on an obstacle."""
    d = stacked(cell, 3, 4, 6)
    dofs, up = dofs_on(d, degree), np.eye(d.mesh.geometry.dim)[-1]
    smooth = tfeti.Obstacle("lower bottom", tfeti.Plane(-1.01 * up, up), reach=np.inf)
    pair = sided("upper bottom", "lower top", friction=TRESCA)
    records = searched([pair, smooth], dofs)
    gluing = glue(dofs, prescribe(dofs, []), records, 1.0, weights_of(dofs))
    rows, sets = gluing.constraints.contact, gluing.constraints.sets
    assert sets.tangents.shape == (len(rows.points), dofs.bs - 1)
    rough = records.contact[gluing.constraints.contact.normals] == 0
    assert np.array_equal(rows.points, gluing.constraints.contact.normals[rough])
    assert np.array_equal(rows.tangent_scale, gluing.constraints.scale[rough])
    u = nodal(dofs, lambda x: np.cos(2.0 * x) - np.roll(x, 1, axis=1))
    found = times_rows(gluing, u)[sets.tangents] / rows.tangent_scale[:, None]
    expected = slips(records, dofs, u)[rows.points]
    assert MPI.COMM_WORLD.allreduce(expected.size) > 0
    assert np.allclose(found, expected, rtol=0, atol=1e-12)


class Held:
    """A cube on a plane, its left side and its bottom held in some directions."""

    def __init__(self, law, **prescribed):
        self.d = decomposed("hexahedron", 2, 3)
        self.dofs = dofs = dofs_on(self.d)
        plane = tfeti.Plane((0, 0, -0.01), (0, 0, 1))
        contact = tfeti.Obstacle("bottom", plane, friction=law, reach=np.inf)
        self.records = searched([contact], dofs)
        facets = self.d.facets
        bcs = [roller(dofs.V, i, facets(name), value) for name, (i, value) in prescribed.items()]
        self.gluing = glue(dofs, prescribe(dofs, bcs), self.records, 1.0, weights_of(dofs))

    def count(self, flags):
        return self.d.comm.allreduce(int(np.sum(flags)))


@pytest.mark.parametrize("value", [0.0, 0.125])
def test_a_prescribed_tangent_leaves_a_row_without_entries(value):
    """On the left side x is held: the disc becomes an interval, or is whole where x is drawn."""
    held = Held(TRESCA, left=(0, value))
    rows, sets = held.gluing.constraints.contact, held.gluing.constraints.sets
    on_left = group_points(held.dofs)[held.records.group[rows.points], 0] < 1e-9
    assert held.count(on_left) == 3
    assert held.count(~rows.moves) == 3
    along_x = np.abs(held.records.tangents[rows.points, :, 0]) > 0.5
    assert np.array_equal(~rows.moves, along_x & on_left[:, None])
    halves = np.full((len(held.records), 2), 0.5)
    bound = held.gluing.with_friction(halves, held.records.area).constraints.limits
    assert np.all((bound > 0.0) == (rows.moves | (value > 0.0)))
    expected = 0.5 * held.records.area[rows.points] / rows.tangent_scale
    assert np.allclose(bound.max(axis=1, initial=0.0), expected)
    slip = np.abs(held.gluing.constraints.c[sets.tangents]) / rows.tangent_scale[:, None]
    assert np.allclose(slip, np.where(rows.moves, 0.0, value))


@pytest.mark.parametrize(("cell", "counts"), [("hexahedron", (4, 3)), ("tetrahedron", (5, 4))])
def test_no_friction_across_a_plane_of_symmetry(cell, counts):
    """Where both bodies are held across it the rest that other nodes leave has no row.

    Where only the secondary body is held the other one slips there: rows stay.
    """
    d = stacked(cell, *counts, 6)
    dofs = dofs_on(d)
    records = searched([sided("upper bottom", "lower top", friction=COULOMB)], dofs)
    ends = EndPlanes(dofs)
    upper, lower = (roller(dofs.V, 1, d.facets(f"{name} front")) for name in ("upper", "lower"))
    for bcs, kept in (([upper, lower], False), ([upper], True), ([lower], True)):
        given = prescribe(dofs, bcs, ends)
        assert (given.across is None) == kept
        gluing = glue(dofs, given, records, 1.0, weights_of(dofs))
        rows = gluing.constraints.contact
        on_plane = np.abs(group_points(dofs)[records.group[rows.points], 1]) < 1e-9
        assert d.comm.allreduce(int(on_plane.sum())) > 2
        along_y = np.abs(records.tangents[rows.points, :, 1]) > 0.5
        assert np.all(rows.moves[along_y & on_plane[:, None]] == kept)
        assert np.all(rows.moves[~along_y | ~on_plane[:, None]])
        gluing.constraints.B.destroy()
    drawn = roller(dofs.V, 1, d.facets("lower front"), 0.125)
    assert prescribe(dofs, [upper, drawn], ends).across is None


def test_prescribed_values_slip():
    """Where rows see other nodes too, the slip of what is prescribed goes to their right sides."""
    d = stacked("hexahedron", 2, 3, 4)
    dofs = dofs_on(d)
    records = searched([sided("upper bottom", "lower top", friction=TRESCA)], dofs)
    bcs = [roller(dofs.V, 0, d.facets("lower top"), 0.125)]
    gluing = glue(dofs, prescribe(dofs, bcs), records, 1.0, weights_of(dofs))

    def motion(x):
        u = np.sin(3.0 * x)
        u[d_lower(x), 0] = 0.125
        return u

    def d_lower(x):  # nodes of both boxes lie on z = 0: the lower box has other x there
        grid = np.abs(x[:, 0] * 2 - np.rint(x[:, 0] * 2)) < 1e-9
        return (np.abs(x[:, 2]) < 1e-9) & grid

    u = nodal(dofs, motion)
    # corners are on both grids: the upper box moves there as the lower one does
    rows = gluing.constraints.contact
    found = times_rows(gluing, u)[gluing.constraints.sets.tangents] / rows.tangent_scale[:, None]
    whole = slips(records, dofs, u)
    assert np.allclose(found, whole[rows.points], rtol=0, atol=1e-12)
    # a load step that begins elsewhere
    begin = np.cos(1.0 + whole)
    later = gluing.with_right_side(gluing.prescribed.value, records.gap, (begin, begin))
    found = times_rows(later, u)[gluing.constraints.sets.tangents] / rows.tangent_scale[:, None]
    assert np.allclose(found, (whole - begin)[rows.points], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("law", "rows"), [(TRESCA, 9), (COULOMB, 0)])
def test_a_node_whose_normal_motion_is_prescribed(law, rows):
    """A given bound holds there; a pressure that hides in what holds the node bounds nothing."""
    held = Held(law, bottom=(2, 0.0))
    assert held.count(np.ones(len(held.gluing.constraints.contact.normals))) == 0
    assert held.count(np.ones(len(held.gluing.constraints.contact.points))) == rows


def test_the_first_tangent_follows_the_direction():
    d = decomposed("tetrahedron", 3, 4)
    dofs, direction = dofs_on(d), np.array([1.0, 2.0, 0.5])
    law = tfeti.Tresca((0.1, 0.2), direction=tuple(direction))
    contact = tfeti.Obstacle("bottom", curved_obstacle(3), friction=law, reach=np.inf)
    records = searched([contact], dofs)
    first, second = records.tangents[:, 0], records.tangents[:, 1]
    identity = np.eye(3)
    assert np.allclose(records.frame @ records.frame.transpose(0, 2, 1), identity, atol=1e-14)
    assert np.allclose(np.linalg.det(records.frame), 1.0)
    assert np.allclose(second @ direction, 0.0, rtol=0, atol=1e-14)
    assert np.all(first @ direction > 0.0)
    values = friction_values("floor", law, records, dofs)
    assert np.allclose(values, [0.1, 0.2])


def test_frames_along_a_direction_are_the_same_on_any_number_of_ranks():
    law, found = tfeti.Tresca((0.1, 0.2), direction=(1, 2, 0)), []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        d = decomposed("tetrahedron", 4, 5, comm=comm)
        dofs = dofs_on(d)
        contact = tfeti.Obstacle("bottom", curved_obstacle(3), friction=law, reach=np.inf)
        records = searched([contact], dofs)
        found.append(by_point(comm, group_points(dofs)[records.group], records.frame)[1])
    assert np.allclose(*found, rtol=0, atol=1e-13)
