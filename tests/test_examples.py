"""The examples of public docstrings run, on any number of ranks."""

import doctest
from importlib import import_module

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

import tfeti_dolfinx as tfeti

NAMES = {"np": np, "ufl": ufl, "fem": fem, "dmesh": dmesh, "MPI": MPI, "tfeti": tfeti}
WITH_EXAMPLES = {
    "tfeti_dolfinx": tfeti,
    **{
        name: getattr(tfeti, name)
        for name in (
            "Contact",
            "Cylinder",
            "Elasticity",
            "Obstacle",
            "Plane",
            "SignedDistance",
            "Sphere",
            "decompose",
            "read_gmsh",
        )
    },
}


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_example(name, comm):
    finder = doctest.DocTestFinder(recurse=False)
    (example,) = finder.find(WITH_EXAMPLES[name], name, globs=dict(NAMES))
    said = []
    result = doctest.DocTestRunner().run(example, out=said.append)
    assert result.attempted > 0
    assert comm.allgather(result.failed) == [0] * comm.size, "".join(said)


@pytest.mark.parametrize(
    "name",
    ["qp.mprgp", "qp.krylov", "qp.smalse", "qp.sets", "qp.projection", "qp.newton"],
)
def test_examples_of_solvers(name):
    failed, tried = doctest.testmod(import_module(f"tfeti_dolfinx.{name}"))
    assert tried > 0
    assert failed == 0
