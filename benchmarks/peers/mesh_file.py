"""The half cylinder on a rigid plane, as a file that other programs can read.

    ./run python3 benchmarks/peers/mesh_file.py 6 1 FILE.npz

Elements along a, order of the elements. The file has points, cells counterclockwise,
facets of the surfaces with their cells, nodes on the axis, and the data of the scene.
"""

import sys

import gmsh
import numpy as np

from benchmarks.error_scenes import GRADED, LINE, NU, SCENES, R
from meshes.tools import element_options


def group(dim, name):
    """Nodes of the elements of a physical group."""
    tags = {gmsh.model.getPhysicalName(*pair): pair[1] for pair in gmsh.model.getPhysicalGroups()}
    kinds = []
    for entity in gmsh.model.getEntitiesForPhysicalGroup(dim, tags[name]):
        kinds += gmsh.model.mesh.getElements(dim, entity)[2]
        (kind,) = gmsh.model.mesh.getElementTypes(dim, entity)
    nodes_each = gmsh.model.mesh.getElementProperties(kind)[3]
    return np.concatenate(kinds).reshape(-1, nodes_each).astype(np.int64)


def on_surface(cells, facets):
    """For each facet its cell and the corner that is not on it, and its nodes, the body left."""
    lookup = {}
    for k in range(3):
        ends = cells[:, [(k + 1) % 3, (k + 2) % 3]]
        for cell, pair in enumerate(np.sort(ends, axis=1).tolist()):
            lookup[tuple(pair)] = cell, k, *ends[cell]
    found = np.array([lookup[tuple(pair)] for pair in np.sort(facets[:, :2], axis=1).tolist()])
    return found[:, :2], np.hstack((found[:, 2:], facets[:, 2:]))


def main(argv):
    """Mesh the scene and write it."""
    size, order = float(argv[0]), int(argv[1])
    with element_options(ElementOrder=order):
        SCENES["half cylinder"]().build(size, GRADED)
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    cells = group(2, "body")
    used = np.unique(cells)
    number, place = np.zeros((2, int(tags.max()) + 1), dtype=np.int64)
    number[used], place[tags.astype(np.int64)] = np.arange(len(used)), np.arange(len(tags))
    cells, points = number[cells], coordinates.reshape(-1, 3)[place[used], :2]
    p, q, r = points[cells[:, :3]].transpose(1, 2, 0)
    turned = (q - p)[0] * (r - p)[1] < (q - p)[1] * (r - p)[0]
    mirrored = [1, 0, 2] if order == 1 else [1, 0, 2, 3, 5, 4]
    cells = np.where(turned[:, None], cells[:, mirrored], cells)
    found = {"points": points, "cells": cells, "order": order, "axis": number[group(1, "axis")]}
    for surface in ("contact", "top"):
        found[f"{surface} cells"], found[surface] = on_surface(cells, number[group(1, surface)])
    data = {"load": LINE.load, "a": LINE.half_width, "R": R, "E": 1.0, "nu": NU}
    np.savez(argv[2], **found, **data)


if __name__ == "__main__":
    main(sys.argv[1:])
