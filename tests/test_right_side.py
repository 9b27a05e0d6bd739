"""Other prescribed values and gaps: c alone changes, to what assembling anew would give."""

import numpy as np
import pytest
from bodies import dofs_on, searched, sided, stacked, unit_blocks
from mpi4py import MPI
from scenes import clamp, decomposed, roller

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.constraints.gluing import glue
from tfeti_dolfinx.contact.search import ContactSearch
from tfeti_dolfinx.errors import InputError, NoSolutionError
from tfeti_dolfinx.forms.dirichlet import prescribe

PAIR = sided("upper bottom", "lower top", reach=0.5)


class Scene:
    """A box on a box, on an obstacle; some nodes in contact are held in one direction."""

    def __init__(self, cell="tetrahedron", degree=1):
        self.d = d = stacked(cell, 3, 4, 6)
        gdim = d.mesh.geometry.dim
        self.dofs = dofs_on(d, degree)
        up = np.eye(gdim)[-1] + 0.3 * np.eye(gdim)[0]
        plane = tfeti.Plane(tuple(-1.1 * np.eye(gdim)[-1]), tuple(up))
        contacts = [PAIR, tfeti.Obstacle("lower bottom", plane, reach=np.inf)]
        self.search = ContactSearch(contacts, self.dofs, unit_blocks(self.dofs))
        self.weights = 1.0 + np.arange(self.dofs.num_nodes * gdim) % 5

    def bcs(self, side, across, top):
        """Values: of the x component at a side, of the last at the lower box's right, on top."""
        V, d, last = self.dofs.V, self.d, self.dofs.bs - 1
        made = [roller(V, 0, d.facets("lower left"), side)]
        made += [roller(V, last, d.facets("lower right"), across)]
        return [*made, clamp(V, d.facets("upper top"), top)]

    def glued(self, bcs, records=None):
        records = self.search.records if records is None else records
        return glue(self.dofs, prescribe(self.dofs, bcs), records, 1.0, self.weights)


@pytest.mark.parametrize(("cell", "degree"), [("triangle", 2), ("hexahedron", 1)])
def test_other_values_and_gaps_cost_a_vector(cell, degree):
    scene = Scene(cell, degree)
    old, new = scene.bcs(0.01, 0.02, -0.03), scene.bcs(-0.04, 0.1, 0.2)
    gluing = scene.glued(old)
    B, c = gluing.constraints.B, gluing.constraints.c
    entries, state = [np.array(part) for part in B.getValuesCSR()], B.stateGet()
    first = np.array(c)
    scene.search.set_gaps({0: lambda x: 0.1 + 0.01 * x[0]})
    anew = scene.glued(new)
    values, gaps = prescribe(scene.dofs, new).value, scene.search.records.gap
    expected = np.array(anew.constraints.c)
    assert np.array_equal(gluing.right_side(), first)
    updated = gluing.with_right_side(values, gaps)
    assert updated.constraints.B is B
    assert np.allclose(updated.constraints.c, expected, rtol=1e-14, atol=1e-15)
    assert MPI.COMM_WORLD.allreduce(int(np.sum(expected != first))) > 0
    assert B.stateGet() == state
    others = B.getValuesCSR(), anew.constraints.B.getValuesCSR()
    for before, now, other in zip(entries, *others, strict=True):
        assert np.array_equal(before, now)
        assert np.array_equal(before, other)
    assert np.array_equal(updated.records.gap, gaps)
    assert np.allclose(updated.prescribed.value, anew.prescribed.value)
    assert not np.array_equal(gluing.records.gap, gaps) or np.all(gluing.records.contact == 1)


def test_values_that_push_a_held_face_into_an_obstacle_leave_c_as_it_was():
    d = decomposed("hexahedron", 3, 4)
    dofs = dofs_on(d)
    wall = tfeti.Obstacle("left", tfeti.Plane((-0.5, 0, 0), (1, 0, 0)))
    records = searched([wall], dofs)
    held, ones = prescribe(dofs, [clamp(dofs.V, d.facets("left"))]), np.ones(dofs.num_nodes * 3)
    gluing = glue(dofs, held, records, 1.0, ones)
    assert d.comm.allreduce(len(gluing.constraints.contact.decided)) == 0
    far = searched([tfeti.Obstacle("left", wall.shape, reach=np.inf)], dofs)
    near = glue(dofs, held, far, 1.0, ones)
    assert d.comm.allreduce(len(near.constraints.contact.decided)) == 16
    c = np.array(near.constraints.c)
    values = np.array(near.prescribed.value)
    values[:, 0] -= 0.75
    with pytest.raises(NoSolutionError, match=r"prescribed: .* nodes penetrate by up to 0\.25 "):
        near.with_right_side(values, near.records.gap)
    assert np.array_equal(near.constraints.c, c)
    values[:, 0] += 0.5
    near.with_right_side(values, near.records.gap)
    with pytest.raises(NoSolutionError, match=r"prescribed: .* nodes penetrate by up to 1\.75 "):
        near.with_right_side(values, near.records.gap - 2.0)


def test_another_gap_is_that_of_a_search():
    scene = Scene("triangle")
    search = scene.search
    geometry = search.records
    ramp = searched([sided("upper bottom", "lower top", reach=0.5, gap=0.01)], scene.dofs)
    search.set_gaps({0: 0.01})
    own = search.records.contact == 0
    assert np.allclose(search.records.gap[own], ramp.gap, rtol=0, atol=1e-15)
    assert np.array_equal(search.records.gap[~own], geometry.gap[~own])
    assert np.array_equal(search.records.geometric_gap, geometry.geometric_gap)
    assert np.array_equal(search.records.within_reach, geometry.within_reach)
    assert search.contacts[0].gap == 0.01
    for gap in (np.nan, "geometric", lambda x: np.nan + x[0]):
        with pytest.raises(InputError, match="gap"):
            search.set_gaps({0: gap})
        assert search.contacts[0].gap == 0.01
    search.set_gaps({1: lambda x: x[0]})
    search.set_gaps({0: "geometry"})
    assert np.array_equal(search.records.gap[own], geometry.gap[own])
    search.set_gaps({1: "geometry"})
    assert np.array_equal(search.records.gap, geometry.gap)


def test_a_geometry_that_overlaps_too_deep_is_not_gone_back_to():
    d = stacked("triangle", 3, 4, 4, gap=-0.1)
    dofs = dofs_on(d)
    pair = sided("upper bottom", "lower top", gap=0.0)
    search = ContactSearch([pair], dofs, unit_blocks(dofs))
    with pytest.raises(InputError, match=r"the surfaces overlap by up to 0\.1, more than"):
        search.set_gaps({0: "geometry"})
    assert np.array_equal(search.records.gap, np.zeros(len(search.records)))
