"""A ring shrunk on another one, meshed independently, and its closed form."""

import gmsh
import numpy as np

from meshes.tools import started_model, torn

INNER, MIDDLE, OUTER = 0.5, 1.0, 1.6


def build(cells, overlap=0.0, turn=0.1, triangles=False, radii=(INNER, MIDDLE, OUTER)):
    """Mesh two rings on this rank and return gmsh's model.

    Physical groups: the surfaces "inner" and "outer"; the curves "bore" and "shaft" of the inner
    ring, "hub" and "rim" of the outer one.

    Args:
        cells: Facets around the shaft (outside of the inner ring) and the hub.
        overlap: How much larger the shaft's radius is than the hub's.
        turn: Angle between the meshes.
        triangles: Halves of the quadrilaterals instead of them.
        radii: Of the bore, the contact and the rim.
    """
    model = started_model("rings")
    inner, middle, outer = radii
    shaft, hub = middle + overlap / 2, middle - overlap / 2
    _ring("inner", {"bore": inner, "shaft": shaft}, cells[0], 0.0, triangles)
    _ring("outer", {"hub": hub, "rim": outer}, cells[1], turn, triangles)
    gmsh.model.mesh.generate(2)
    return model


def rings(comm, cells, order=1, *, subdomains=4, **options):
    """Two rings with their contact, torn; ``options`` are those of ``build``.

    Args:
        comm: Communicator.
        cells: Facets around the shaft and the hub.
        order: Degree of the geometry.
        subdomains: Their number.
        options: Further arguments of ``build``.
    """
    return torn(comm, lambda: build(cells, **options), subdomains, order)


def _ring(name, radii, cells, turn, triangles):
    """Quarters of a structured mesh, as square as it can be."""
    geo = gmsh.model.geo
    centre = geo.addPoint(0, 0, 0)
    angles = turn + np.arange(4) * np.pi / 2
    points = [
        [geo.addPoint(r * np.cos(t), r * np.sin(t), 0) for t in angles] for r in radii.values()
    ]
    arcs = [[geo.addCircleArc(p[k], centre, p[(k + 1) % 4]) for k in range(4)] for p in points]
    spokes = [geo.addLine(points[0][k], points[1][k]) for k in range(4)]
    layers = max(1, round(cells / (2 * np.pi) * (max(radii.values()) - min(radii.values()))))
    quarters = []
    for k in range(4):
        loop = geo.addCurveLoop([arcs[0][k], spokes[(k + 1) % 4], -arcs[1][k], -spokes[k]])
        quarters.append(geo.addPlaneSurface([loop]))
        geo.mesh.setTransfiniteCurve(spokes[k], layers + 1)
        for arc in arcs:
            geo.mesh.setTransfiniteCurve(arc[k], cells // 4 + 1)
        geo.mesh.setTransfiniteSurface(quarters[k])
        if not triangles:
            geo.mesh.setRecombine(2, quarters[k])
    geo.synchronize()
    gmsh.model.addPhysicalGroup(2, quarters, name=name)
    for surface, arc in zip(radii, arcs, strict=True):
        gmsh.model.addPhysicalGroup(1, arc, name=surface)


def lame_pressure(overlap, E=1.0, nu=0.3):
    """Pressure between the rings, in plane strain (Lamé)."""
    a, b, c = INNER**2, MIDDLE**2, OUTER**2
    modulus, ratio = E / (1 - nu**2), nu / (1 - nu)
    inwards, outwards = (b + a) / (b - a) - ratio, (c + b) / (c - b) + ratio
    return overlap * modulus / (MIDDLE * (inwards + outwards))
