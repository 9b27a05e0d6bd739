"""The half cylinder and the half ball on a rigid plane, as files that other programs can read.

    ./run python3 benchmarks/peers/meshes.py "half ball" 6 1 FILE.npz

Scene, elements along a, order of the elements. The file has points, cells in gmsh's order of
nodes, facets of the surfaces with their cells, nodes on the axis, and the data of the scene.
"""

import sys
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv[:1])

import gmsh
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.error_scenes import GRADED, SCENES
from demos import adaptive_2d, hertz_3d
from meshes.tools import element_options

LOADS = {"half cylinder": adaptive_2d.hertz.load, "half ball": hertz_3d.HERTZ.load}
DATA = {"half cylinder": adaptive_2d, "half ball": hertz_3d}


def group(dim, name):
    """Nodes of the elements of a physical group."""
    tags = {gmsh.model.getPhysicalName(*pair): pair[1] for pair in gmsh.model.getPhysicalGroups()}
    kinds = []
    for entity in gmsh.model.getEntitiesForPhysicalGroup(dim, tags[name]):
        kinds += gmsh.model.mesh.getElements(dim, entity)[2]
        (kind,) = gmsh.model.mesh.getElementTypes(dim, entity)
    nodes_each = gmsh.model.mesh.getElementProperties(kind)[3]
    return np.concatenate(kinds).reshape(-1, nodes_each).astype(np.int64)


def cells_of(cells, facets, dim):
    """For each facet its cell, and the corner of that cell that is not on it."""
    corners = dim + 1
    lookup = {}
    for opposite in range(corners):
        rest = [k for k in range(corners) if k != opposite]
        for cell, key in enumerate(map(tuple, np.sort(cells[:, rest], axis=1).tolist())):
            lookup[key] = cell, opposite
    keys = map(tuple, np.sort(facets[:, :dim], axis=1).tolist())
    return np.array([lookup[key] for key in keys])


def main(argv):
    """Mesh a scene and write it."""
    name, size, order, file = argv[0], float(argv[1]), int(argv[2]), Path(argv[3])
    with element_options(ElementOrder=order):
        SCENES[name]().build(size, GRADED)
    dim = gmsh.model.getDimension()
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    x = coordinates.reshape(-1, 3)[:, :dim]
    cells = group(dim, "body")
    used = np.unique(cells)
    number = np.zeros(int(tags.max()) + 1, dtype=np.int64)
    number[used] = np.arange(len(used))
    place = np.zeros(int(tags.max()) + 1, dtype=np.int64)
    place[tags.astype(np.int64)] = np.arange(len(tags))
    cells, points = number[cells], x[place[used]]
    # gmsh's plane cells may turn either way
    found = {"points": points, "cells": cells, "order": order}
    for surface in ("contact", "top"):
        facets = number[group(dim - 1, surface)]
        found[surface] = facets
        found[f"{surface} cells"] = cells_of(cells, facets, dim)
    axis = np.unique(number[group(1, "axis")]) if dim == 2 else np.zeros(0, dtype=np.int64)
    scene = DATA[name]
    data = {"load": LOADS[name], "a": scene.a, "R": scene.R, "E": scene.E, "nu": scene.nu}
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez(file, axis=axis, **found, **data)


if __name__ == "__main__":
    main(sys.argv[1:])
