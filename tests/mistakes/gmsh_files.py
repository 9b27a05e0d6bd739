"""Mistakes in what read_gmsh is given."""

import gmsh

import tfeti_dolfinx as tfeti


def without_nodes(s):
    """Read a file that has a header alone."""
    path = s.folder / "bare.msh"
    if s.comm.rank == 0:
        path.write_text("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n")
    s.comm.barrier()
    return tfeti.read_gmsh(path, s.comm)


def closed(s):
    """The model when gmsh is not initialised; an earlier test may have left it open."""
    if gmsh.isInitialized():
        gmsh.finalize()
    return tfeti.read_gmsh(gmsh.model, s.comm)


def model(build, subdomains=1):
    """Read a model that rank 0 builds of a square."""

    def read(s):
        if s.comm.rank == 0:
            gmsh.initialize(interruptible=False)
            gmsh.option.setNumber("General.Terminal", 0)
            gmsh.option.setNumber("Mesh.MeshSizeMin", 0.5)
            gmsh.model.add("square")
            square = gmsh.model.occ.addRectangle(0, 0, 0, 1, 1)
            gmsh.model.occ.synchronize()
            build(square)
        try:
            return tfeti.read_gmsh(gmsh.model, s.comm, subdomains)
        finally:
            if s.comm.rank == 0:
                gmsh.finalize()

    return read


def in_group(square):
    gmsh.model.addPhysicalGroup(2, [square], name="plate")


def meshed(square):
    in_group(square)
    gmsh.model.mesh.generate(2)


def twice(square):
    gmsh.model.addPhysicalGroup(2, [square], name="again")
    meshed(square)


def sides(*tags):
    """Sides of the square, or of a cube, in a group, and no body."""
    gmsh.model.occ.addBox(0, 0, 0, 1, 1, 1)
    gmsh.model.occ.synchronize()
    gmsh.model.addPhysicalGroup(1 if 1 in tags else 2, tags, name="sides")
    gmsh.model.mesh.generate(2)


SOURCES = {
    r"none.msh: no such file; expected a gmsh mesh": lambda s: tfeti.read_gmsh(
        s.folder / "none.msh", s.comm
    ),
    r"comm is None; expected a communicator such as MPI.COMM_WORLD": lambda s: tfeti.read_gmsh(
        "ring.msh", None
    ),
    r"bare.msh: not a mesh, gmsh finds no nodes": without_nodes,
    r"gmsh.model \(is gmsh initialised, with a model in it\?\)": closed,
    r"the mesh has no physical groups of cells": model(in_group),
    r"no physical groups of cells; give the bodies": model(lambda square: sides(1, 2)),
    r"surfaces that do not lie .* no volumes": model(lambda square: sides(2, 3)),
    r"elements of dimension 2 lie in several physical groups, \['again', 'plate'\]": model(twice),
    r"subdomains=1000: expected between 1 and \d+": model(meshed, 1000),
}

TABLES = ("SOURCES",)
