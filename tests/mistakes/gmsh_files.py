"""Mistakes in what read_gmsh is given."""

import numpy as np
import pytest

import tfeti_dolfinx as tfeti

BARE = """$MeshFormat
2.2 0 8
$EndMeshFormat
"""


def gmsh_of(s):
    return pytest.importorskip("gmsh")


def file(name, text, says):
    """Read a file with this text."""

    def read(s):
        gmsh_of(s)
        path = s.folder / name
        if s.comm.rank == 0:
            path.write_bytes(text if isinstance(text, bytes) else text.encode())
        s.comm.barrier()
        return tfeti.read_gmsh(path, s.comm)

    return read, says


def model(says, build, subdomains=1):
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

    return read, says


def source(says, make):
    """Read something that is no mesh."""
    return lambda s: tfeti.read_gmsh(make(gmsh_of(s)), s.comm), says


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


def without_groups(gmsh, square):
    gmsh.model.mesh.generate(2)


def group_of_curves(gmsh, square):
    gmsh.model.addPhysicalGroup(1, [1], name="edge")
    gmsh.model.mesh.generate(2)


def two_groups(gmsh, square):
    in_group(gmsh, square)
    gmsh.model.addPhysicalGroup(2, [square], name="again")
    gmsh.model.mesh.generate(2)


SOURCES = {
    "a file that is not there": (
        lambda s: tfeti.read_gmsh(s.folder / "none.msh", s.comm),
        r"none.msh: no such file; expected a gmsh mesh",
    ),
    "a folder": (
        lambda s: tfeti.read_gmsh(s.folder, s.comm),
        r": no such file; expected a gmsh mesh",
    ),
    "an empty name": (lambda s: tfeti.read_gmsh("", s.comm), r"no such file; expected a gmsh mes"),
    "no source": source(
        r"source is None; expected a .msh file, or a gmsh model", lambda gmsh: None
    ),
    "gmsh itself": source(
        r"source is a module; expected a .msh file, or a gmsh", lambda gmsh: gmsh
    ),
    "a mesh of DOLFINx": (
        lambda s: tfeti.read_gmsh(gmsh_of(s) and s.mesh, s.comm),
        r"source is a Mesh; expected a .msh file, or a gmsh model",
    ),
    "no communicator": (
        lambda s: tfeti.read_gmsh("ring.msh", None),
        r"comm is None; expected a communicator such as MPI.COMM_WORLD",
    ),
    "subdomains for the communicator": (
        lambda s: tfeti.read_gmsh("ring.msh", 8),
        r"comm is 8; expected a communicator",
    ),
    "file and communicator exchanged": (
        lambda s: tfeti.read_gmsh(s.comm, "ring.msh"),
        r"comm is 'ring.msh'; expected a communicator",
    ),
    "a text that is no mesh": file("text.msh", "this is not a mesh\n", r"text.msh: "),
    "an empty file": file("empty.msh", "", r"empty.msh: "),
    "bytes that are no mesh": file("bytes.msh", bytes(range(256)), r"bytes.msh: "),
    "a file that ends early": file("cut.msh", BARE + "$Nodes\n4\n1 0 0", r"cut.msh: "),
    "a mesh without nodes": file("bare.msh", BARE, r"bare.msh: not a mesh, gmsh finds no nodes"),
    "geometry that is not meshed": file("square.geo", "Point(1) = {0, 0, 0};\n", r"square.geo: "),
    "a model when gmsh is not initialised": source(
        r"gmsh.model \(is gmsh initialised, with a model in it\?\)", closed
    ),
    "a model that is not meshed": model(r"the mesh has no physical groups of cells", in_group),
    "a model without groups": model(r"the mesh has no physical groups of cells", without_groups),
    "a model with groups of curves alone": model(r".*", group_of_curves),
    "cells in two groups": model(
        r"elements of dimension 2 lie in several physical groups, \['again', 'plate'\]", two_groups
    ),
    "True subdomains of a model": model(r"array subdomains: .*got True", meshed, True),
    "subdomains of a model that are too many": model(
        r"subdomains=1000: expected between 1 and \d+", meshed, 1000
    ),
    "ids of a model that are too few": model(
        r"array subdomains: expected one id for each of the \d+ cells", meshed, np.zeros(1, int)
    ),
}

TABLES = ("SOURCES",)
