"""Mortar conditions in awkward scenes: layers, thin bodies, coarse and curved facets, bad input."""

import sys

import numpy as np
import pytest
from bodies import (
    TO_ROUNDING,
    boxes,
    clamped,
    dofs_on,
    gathered,
    held,
    no_load,
    pressed,
    searched,
    sided,
    two_body_problem,
)
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scenes import decomposed, problem, roller, solved

import tfeti_dolfinx as tfeti
from meshes.cylinder_on_block import build
from meshes.tools import element_options


def decomposed_boxes(parts, subdomains=4, groups=(), cell="quadrilateral"):
    """Boxes; ``groups`` are names of surfaces made of several sides."""
    mesh, tags, names = boxes(cell, parts)
    surfaces = dict(names)
    values = tags.values.copy()
    for name, sides in groups:
        tag = surfaces[name] = len(surfaces) + 1
        values[np.isin(values, [names[side] for side in sides])] = tag
    tags = dmesh.meshtags(mesh, tags.dim, tags.indices, values)
    return tfeti.decompose(mesh, subdomains, facet_tags=tags, surfaces=surfaces)


def flat(name, low, high, n, width=1.0):
    return (name, (0.0, low), (width, high), (n, 2))


@pytest.mark.parametrize(("apart", "radius"), [(0.1, 1.0), (0.5, None)])
def test_only_the_first_of_two_layers_is_met(apart, radius):
    """The primary surface has the lower box's top and, below it, another one's."""
    parts = [flat("base", -apart - 0.7, -apart - 0.2, 3), flat("lower", -apart, 0.0, 3)]
    parts.append(flat("upper", 0.0, 1.0, 4))
    d = decomposed_boxes(parts, 6, [("tops", ["base top", "lower top"])])
    sides = ["base bottom", "base left", "lower left", "lower bottom", "upper left"]
    contact = sided("upper bottom", "tops", reach=radius)
    p = solved(two_body_problem(d, pressed(d), held(d, *sides), [contact], **TO_ROUNDING))
    assert np.allclose(gathered(p.solution.contact().pressure), 0.1, rtol=0, atol=1e-9)
    assert np.isclose(gathered(p.solution.contact().area).sum(), 1.0)


@pytest.mark.parametrize(("thickness", "radius"), [(0.2, None), (0.02, 1.0), (0.02, 1e-3)])
def test_thin_plates_are_not_met_from_behind(thickness, radius):
    """Both faces of both plates are in the surfaces: the outer ones face through the plates."""
    parts = [flat("lower", -thickness, 0.0, 6), flat("upper", 0.0, thickness, 8)]
    groups = [(f"{a} faces", [f"{a} bottom", f"{a} top"]) for a in ("lower", "upper")]
    d = decomposed_boxes(parts, 4, groups)
    records = searched([sided("upper faces", "lower faces", reach=radius)], dofs_on(d))
    assert MPI.COMM_WORLD.allreduce(len(records)) == 9
    assert np.allclose(records.gap, 0.0, atol=1e-14)
    assert np.isclose(MPI.COMM_WORLD.allreduce(records.area.sum()), 1.0)


def disc_on_block(comm, order, pushed=0.02):
    """A disc of radius 1 that touches a block with a vertex, its flat top moved down."""
    model = None
    if comm.rank == 0:
        with element_options(ElementOrder=order):
            model = build(1.0, 2.0, 0.25, 10.0)
    d = tfeti.read_gmsh(model, comm, 4)
    return d, clamped(d, ("load", np.array([0.0, -pushed])), "bottom")


@pytest.mark.parametrize(("order", "sides"), [(1, ("top", "arc")), (2, ("arc", "top"))])
def test_the_reach_does_not_change_the_answer(comm, order, sides):
    """Facets as large as the contact zone, and a load by displacement alone."""
    forces = []
    for radius in (None, 1e-3):
        d, bcs = disc_on_block(comm, order)
        contact = sided(*sides, reach=radius)
        p = solved(two_body_problem(d, no_load, bcs, [contact], rtol=1e-10))
        assert p.report.residuals["penetration"] <= p.report.tolerances["penetration"]
        forces.append(np.abs(p.solution.body_forces.force[:, 1]).max())
    assert min(forces) > 1e-3
    assert np.allclose(forces, forces[0], rtol=1e-6)


def test_facets_of_second_order_touch_without_overlap(comm):
    """The arc lies outside of the chord that touches the block at its vertex: more force."""
    forces = []
    for order in (1, 2):
        d, bcs = disc_on_block(comm, order)
        p = solved(two_body_problem(d, no_load, bcs, [sided("arc", "top")], rtol=1e-10))
        records = searched(p.contacts, p.dofs)
        assert records.gap.min(initial=0.0) > -1e-12
        forces.append(np.abs(p.solution.body_forces.force[:, 1]).max())
    assert np.isclose(*forces, rtol=0.03)


@pytest.mark.parametrize("order", [("lower", "upper"), ("upper", "lower")])
@pytest.mark.parametrize("degree", [1, 2])
def test_whole_boundaries_press_as_their_faces_alone(order, degree):
    """Of a quarter of two cubes on a plane, apart at first, cuts and sides bear nothing."""
    low, high = ((0.0, 0.0, -1.0), (1.0, 1.0, 0.0)), ((0.0, 0.0, 0.05), (1.0, 1.0, 1.0))
    parts = [("lower", *low, (2, 2, 2)), ("upper", *high, (3, 3, 2))]
    sides = {body: ["left", "right", "front", "back", "bottom"] for body in order}
    sides["lower"].append("top")
    skins = [(body, [f"{body} {side}" for side in sides[body]]) for body in order]
    d = decomposed_boxes(parts, 4, skins, "hexahedron")
    cuts = [d.locate_facets(lambda x, k=k: np.isclose(x[k], 0.0)) for k in (0, 1)]
    floor = tfeti.Obstacle("lower", tfeti.Plane((0, 0, -1.02), normal=(0, 0, 1)))
    bcs, pairs = lambda V: [roller(V, *cut) for cut in enumerate(cuts)], [sided(*order), floor]
    p = solved(two_body_problem(d, pressed(d), bcs, pairs, degree, rtol=1e-10))
    pressure = np.append(*(gathered(p.solution.contact(i).pressure) for i in (0, 1)))
    assert np.allclose(pressure[pressure > 0.0], 0.1, rtol=1e-7)
    assert p.report.warnings == []


@pytest.mark.parametrize("one", [True, False])
def test_an_edge_in_a_corner_needs_a_pair_for_each_side(one):
    """A block slides down a wall: as one surface its edge is not stopped by the floor."""
    parts = [("block", (0.0, 0.0), (1.0, 1.0), (2, 2)), ("wall", (-1.0, 0.0), (0.0, 1.0), (2, 3))]
    sides = {"skin": ["block bottom", "block left"], "corner": ["floor top", "wall right"]}
    d = decomposed_boxes([*parts, flat("floor", -1.0, 0.0, 3)], 3, sides.items() if one else ())
    pairs = [sided(*pair) for pair in ([sides] if one else zip(*sides.values(), strict=True))]
    bcs = clamped(d, ("block top", np.array([0.0, -0.01])), "wall left", "floor bottom")
    p = solved(two_body_problem(d, no_load, bcs, pairs))
    assert ["is in a corner" in text for text in p.report.warnings] == [True] * one


def test_options_that_did_not_reach_petsc(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["program", "-tfeti_max_it", "3"])
    d = decomposed("quadrilateral", 2, 2)
    with pytest.raises(tfeti.InputError, match="-tfeti_max_it on the command line did not reach"):
        problem(d)
    problem(d, tfeti_max_it=3)  # the program has read it itself


def test_an_obstacle_is_asked_about_its_surface_only():
    """A block in a hollow sphere, with a node at its centre, where the sphere has no normal."""
    d = decomposed("hexahedron", 2, 4)
    hollow = tfeti.Sphere((0.5, 0.5, 0.5), 2.0, inside=True)
    p = solved(problem(d, contacts=[tfeti.Obstacle("bottom", hollow)], degree=2))
    assert p.report.contact_candidates == 9
    assert p.report.converged_reason == "CONVERGED_RTOL"
