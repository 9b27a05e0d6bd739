"""The wheel, and packages of others beside a torn mesh, where they are installed."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

import tfeti_dolfinx as tfeti

ROOT = Path(__file__).parents[1]


def test_wheel_has_what_it_needs(serial_only, tmp_path):
    """It has every file of the package, and is imported from where it lies."""
    setuptools = pytest.importorskip("setuptools")
    if int(setuptools.__version__.split(".")[0]) < 77:
        pytest.skip("pyproject.toml asks for setuptools >= 77")
    source = tmp_path / "source"
    source.mkdir()
    unseen = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "tfeti_dolfinx", source / "tfeti_dolfinx", ignore=unseen)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation"]
    made = subprocess.run(
        [*command, "--wheel-dir", str(tmp_path), str(source)], capture_output=True, text=True
    )
    assert made.returncode == 0, made.stdout + made.stderr
    (wheel,) = tmp_path.glob("tfeti_dolfinx-*-py3-none-any.whl")
    with zipfile.ZipFile(wheel) as packed:
        names = {name for name in packed.namelist() if ".dist-info/" not in name}
    package = source / "tfeti_dolfinx"
    assert names == {str(path.relative_to(source)) for path in package.rglob("*") if path.is_file()}
    assert "tfeti_dolfinx/py.typed" in names
    place = "import tfeti_dolfinx; print(tfeti_dolfinx.__file__)"
    environment = {**os.environ, "PYTHONPATH": str(wheel)}
    imported = subprocess.run(
        [sys.executable, "-c", place], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert str(wheel) in imported.stdout, imported.stderr


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
