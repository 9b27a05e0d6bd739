"""Mistakes in what read_gmsh is given."""

import pytest

import tfeti_dolfinx as tfeti

BARE = """$MeshFormat
2.2 0 8
$EndMeshFormat
"""


def gmsh_of(s):
    return pytest.importorskip("gmsh")


def file(name, text):
    """Read a file with this text."""

    def read(s):
        gmsh_of(s)
        path = s.folder / name
        if s.comm.rank == 0:
            path.write_bytes(text if isinstance(text, bytes) else text.encode())
        s.comm.barrier()
        return tfeti.read_gmsh(path, s.comm)

    return read


def model(build, subdomains=1):
    """Read a model that rank 0 builds of a square."""

    def read(s):
        gmsh = gmsh_of(s)
        if s.comm.rank == 0:
            gmsh.initialize(interruptible=False)
            gmsh.option.setNumber("General.Terminal", 0)
            gmsh.option.setNumber("Mesh.MeshSizeMin", 0.5)
            gmsh.model.add("square")
            square = gmsh.model.occ.addRectangle(0, 0, 0, 1, 1)
            gmsh.model.occ.synchronize()
            build(gmsh, square)
        try:
            return tfeti.read_gmsh(gmsh.model, s.comm, subdomains)
        finally:
            if s.comm.rank == 0:
                gmsh.finalize()

    return read


def source(make):
    """Read something that is no mesh."""
    return lambda s: tfeti.read_gmsh(make(gmsh_of(s)), s.comm)


def closed(gmsh):
    """The model when gmsh is not initialised; an earlier test may have left it open."""
    if gmsh.isInitialized():
        gmsh.finalize()
    return gmsh.model


def in_group(gmsh, square):
    gmsh.model.addPhysicalGroup(2, [square], name="plate")


def meshed(gmsh, square):
    in_group(gmsh, square)
    gmsh.model.mesh.generate(2)


def two_groups(gmsh, square):
    in_group(gmsh, square)
    gmsh.model.addPhysicalGroup(2, [square], name="again")
    gmsh.model.mesh.generate(2)


SOURCES = {
    r"none.msh: no such file; expected a gmsh mesh": lambda s: tfeti.read_gmsh(
        s.folder / "none.msh", s.comm
    ),
    r"comm is None; expected a communicator such as MPI.COMM_WORLD": lambda s: tfeti.read_gmsh(
        "ring.msh", None
    ),
    r"bare.msh: not a mesh, gmsh finds no nodes": file("bare.msh", BARE),
    r"gmsh.model \(is gmsh initialised, with a model in it\?\)": source(closed),
    r"the mesh has no physical groups of cells": model(in_group),
    r"elements of dimension 2 lie in several physical groups, \['again', 'plate'\]": model(
        two_groups
    ),
    r"subdomains=1000: expected between 1 and \d+": model(meshed, 1000),
}

TABLES = ("SOURCES",)
