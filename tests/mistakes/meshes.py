"""Mistakes in meshes, tags, names and subdomains that DOLFINx's mesh comes with."""

import numpy as np
from dolfinx import fem
from dolfinx import mesh as dmesh

import tfeti_dolfinx as tfeti
from mistakes.gmsh_files import meshed, model
from mistakes.scene import raising


def submesh(s, dim, number):
    s.mesh.topology.create_connectivity(dim, s.mesh.topology.dim)
    count = min(number, s.mesh.topology.index_map(dim).size_local)
    return dmesh.create_submesh(s.mesh, dim, np.arange(count, dtype=np.int32))[0]


def single(s):
    return dmesh.create_unit_square(s.comm, 2, 2, dtype=np.float32)


def torn(s, *arguments, **names):
    return tfeti.decompose(s.mesh, *arguments, **names)


def parts(subdomains):
    """Decomposition into what is given, for a number of cells."""
    return lambda s: torn(s, subdomains)


def cells(s):
    return s.mesh.topology.index_map(2).size_local


MESHES = {
    r"partitioner='metis': expected one of round, bisection": lambda s: torn(
        s, 2, partitioner="metis"
    ),
    r"partitioner='bisection' with the subdomain of each cell; expected the number": lambda s: torn(
        s, lambda x: x[0] > 0.5, partitioner="bisection"
    ),
    r"mesh is None; expected a dolfinx.mesh.Mesh": lambda s: tfeti.decompose(None, 2),
    r"mesh of intervals in 1D: expected one of triangle": lambda s: tfeti.decompose(
        dmesh.create_unit_interval(s.comm, 4), 2
    ),
    r"mesh is torn already; expected the one before": lambda s: tfeti.decompose(s.d.mesh, 2),
    r"the mesh has no cells": lambda s: tfeti.decompose(submesh(s, 2, 0)),
    r"mesh with coordinates of type float32; expected float64": lambda s: tfeti.decompose(
        single(s), 2
    ),
}

SUBDOMAINS = {
    r"subdomains=0: expected between 1 and 4, the number of cells": parts(0),
    r"^subdomains: expected a number of subdomains, .*, got 4.0": parts(4.0),
    r"array subdomains: expected whole .*, got -1": lambda s: torn(s, np.full(cells(s), -1)),
    r"callable subdomains: expected one id for each .*got an array of shape \(3, \d\)": parts(
        lambda x: (x > 0.5).astype(int)
    ),
    r"callable subdomains: ZeroDivisionError: no such place": parts(raising),
    r"callable subdomains: expected whole numbers from 0 up, got nan": parts(
        lambda x: np.full(x.shape[1], np.nan)
    ),
}

TAGS = {
    r"cell_tags are tags of entities of dimension 1, not 2": lambda s: torn(
        s, 2, s.facet_tags, s.cell_tags
    ),
    r"facet_tags are tags of another mesh; expected the facet_tags of the mesh given": lambda s: (
        torn(s, 2, facet_tags=s.d.facet_tags)
    ),
    r"surfaces has 1: 'top'; expected a name and its tag": lambda s: torn(
        s, 2, facet_tags=s.facet_tags, surfaces={1: "top"}
    ),
    r"surfaces={'top': 1} without facet_tags": lambda s: torn(s, 2, surfaces={"top": 1}),
}

NAMES = {
    r"no surface 'lid' in the mesh; its surfaces are: 'left' \(1\)": lambda s: s.d.surface("lid"),
    r"surface a Sphere: .*; a shape is met": lambda s: s.d.surface(tfeti.Sphere((0, 0), 1)),
}

MARKERS = {
    r"marker: expected flags of shape .* for points of shape \(3, \d+\), got bool of": lambda s: (
        s.d.locate_facets(lambda x: True)
    ),
}


ORIGINALS = {
    r"f is an array of shape \(3,\); expected a dolfinx.fem.Function on the mesh that": lambda s: (
        s.d.from_original(np.zeros(3))
    ),
    r"f is on another mesh; expected a function on the mesh that was given to": lambda s: (
        s.d.from_original(fem.Function(s.space("Lagrange", 1)))
    ),
    r"f is from .*, whose unknowns depend on the directions of edges and facets;": lambda s: (
        s.d.from_original(fem.Function(s.untorn_space("RTCF", 1)))
    ),
    r"there is no mesh before it was torn: read_gmsh makes none; expected a": lambda s: model(
        meshed, 2
    )(s).from_original(fem.Function(s.untorn_space("Lagrange", 1))),
}

TABLES = ("MESHES", "SUBDOMAINS", "TAGS", "NAMES", "MARKERS", "ORIGINALS")
