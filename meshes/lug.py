"""A pin in the bore of a lug, with a clearance, meshed independently."""

import gmsh
import numpy as np

from meshes.tools import started_model, torn

CORE, PIN, EDGE = 4.0, 10.0, 20.0


def build(sizes, clearance=0.05, turn=0.1, thickness=0.0, layers=1, half=False, thin=1.0):
    """Mesh pin and lug on this rank and return gmsh's model.

    Physical groups: the bodies "pin" and "lug"; the surfaces "pin side" (radius 10) and "core" of
    the pin, "bore" and "edge" of the lug; in 3D "ends" of both; of a half "middle" of both.

    Args:
        sizes: Of the elements of the pin and of the lug.
        clearance: How much larger the bore's radius is.
        turn: Angle between the points where the arcs of both begin.
        thickness: Of pin and lug along z; 0 for a plane mesh.
        layers: Prisms across it, each cut into tetrahedra.
        thin: Share of the thickness that the lug has.
        half: The right half alone, x ≥ 0; ``turn`` does not count.
    """
    model, geo = started_model("lug"), gmsh.model.geo
    bore, at, parts = PIN + clearance, 0.0 if half else turn, 2 if half else 4
    sides, radii = {}, {"pin": {"core": CORE, "pin side": PIN}, "lug": {"bore": bore, "edge": EDGE}}
    dim = 3 if thickness else 2
    thick = thickness, thin * thickness
    for name, size, begin, along in zip(radii, sizes, (0.0, at), thick, strict=True):
        first = len(model.getEntities(0))
        bodies = _body(radii[name], begin - np.pi / 2, parts, along, layers, sides)
        geo.synchronize()
        model.mesh.setSize(model.getEntities(0)[first:], size)
        model.addPhysicalGroup(dim, bodies, name=name)
    for name, tags in sides.items():
        model.addPhysicalGroup(dim - 1, tags, name=name)
    model.mesh.generate(dim)
    return model


def lug(comm, sizes, order=1, *, subdomains=4, **options):
    """The pin and the lug, torn; ``options`` are those of ``build``."""
    return torn(comm, lambda: build(sizes, **options), subdomains, order)


def _body(radii, begin, parts, thickness, layers, sides):
    """Quarters of a ring, their tags; adds those of its sides."""
    geo = gmsh.model.geo
    centre, angles = geo.addPoint(0, 0, 0), begin + np.arange(parts + 1) * np.pi / 2
    if parts == 4:
        angles = angles[:4]
    points = [
        [geo.addPoint(r * np.cos(t), r * np.sin(t), 0) for t in angles] for r in radii.values()
    ]
    ends = [(k, (k + 1) % len(angles)) for k in range(parts)]
    arcs = [[geo.addCircleArc(p[a], centre, p[b]) for a, b in ends] for p in points]
    spokes = [geo.addLine(inner, outer) for inner, outer in zip(*points, strict=True)]
    bodies = []
    for k, (a, b) in enumerate(ends):
        loop = [spokes[a], arcs[1][k], -spokes[b], -arcs[0][k]]
        bodies.append(geo.addPlaneSurface([geo.addCurveLoop(loop)]))
        around = [spokes[a], arcs[1][k], spokes[b], arcs[0][k]]
        if thickness:
            front = bodies[-1]
            (_, back), (_, bodies[-1]), *walls = geo.extrude(
                [(2, front)], 0, 0, thickness, [layers]
            )
            around = [tag for _, tag in walls]
            sides.setdefault("ends", []).extend((front, back))
        for name, tag in zip(radii, (around[3], around[1]), strict=True):
            sides.setdefault(name, []).append(tag)
        if parts == 2:
            sides.setdefault("middle", []).append(around[0 if k == 0 else 2])
    return bodies
