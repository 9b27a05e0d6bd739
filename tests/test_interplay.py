"""Packages of others beside a torn mesh, where they are installed."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

import tfeti_dolfinx as tfeti


@pytest.fixture
def jumping():
    """A function of degree 1 on two subdomains: (1 + x, y) in the right one, 0 in the left one."""
    square = dmesh.create_unit_square(MPI.COMM_WORLD, 8, 8)
    decomposition = tfeti.decompose(square, lambda x: x[0] > 0.5)
    mesh = decomposition.mesh
    field = fem.Function(fem.functionspace(mesh, ("Lagrange", 1, (2,))))
    right = dmesh.locate_entities(mesh, 2, lambda x: x[0] >= 0.5 - 1e-10)
    field.interpolate(lambda x: np.array([1.0 + x[0], x[1]]), right)
    return field


SQUARED = (8 - 1.5**3) / 3 + 1 / 6  # the integral of its square


def test_io4dolfinx_keeps_what_jumps_at_tears(serial_only, jumping, tmp_path):
    """A mesh and a function are written and read; in its h5py the file is that of one process."""
    io4dolfinx = pytest.importorskip("io4dolfinx")
    pytest.importorskip("h5py")
    path = tmp_path / "field.h5"
    io4dolfinx.write_mesh(path, jumping.function_space.mesh, backend="h5py")
    io4dolfinx.write_function(path, jumping, time=0.0, name="u", backend="h5py")
    mesh = io4dolfinx.read_mesh(path, MPI.COMM_WORLD, backend="h5py")
    again = fem.Function(fem.functionspace(mesh, ("Lagrange", 1, (2,))))
    io4dolfinx.read_function(path, again, name="u", backend="h5py")
    squared = fem.assemble_scalar(fem.form(ufl.inner(again, again) * ufl.dx))
    assert np.isclose(squared, SQUARED, rtol=1e-12)
    assert len(again.x.array) == len(jumping.x.array)


def test_scifem_integrates_on_a_torn_mesh(jumping):
    scifem = pytest.importorskip("scifem")
    squared = scifem.assemble_scalar(ufl.inner(jumping, jumping) * ufl.dx)
    assert np.isclose(squared, SQUARED, rtol=1e-12)
