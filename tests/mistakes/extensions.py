"""Mistakes in parts of one's own."""

from dataclasses import replace

import numpy as np
from mpi4py import MPI

from mistakes.scene import raising
from tfeti_dolfinx import Obstacle, Tresca
from tfeti_dolfinx.extensions import Extensions
from tfeti_dolfinx.qp.sets import Bounds, Product
from tfeti_dolfinx.subdomains.block import Block


def own(options=None, **parts):
    """Solve with parts of one's own."""
    return lambda s: s.problem(
        contacts=[s.floor], extensions=Extensions(**parts), petsc_options=options
    ).solve()


def on_the_last_rank(*_):
    if MPI.COMM_WORLD.rank == MPI.COMM_WORLD.size - 1:
        raising()


class OfThree:
    """A set of vectors of three entries, whatever the rows are."""

    def __getattr__(self, name):
        return getattr(Bounds(), name)

    def project(self, x):
        return np.zeros(len(x) + 1)


class WithoutBeta(Bounds):
    """A set whose faces do not say which rows want to become free."""

    def face(self, x, g):
        return replace(super().face(x, g), beta=np.zeros(len(x) + 1))


def normals_alone(s):
    """A set that forgets friction."""
    rough = Obstacle("bottom", s.floor.shape, friction=Tresca(0.1))
    parts = Extensions(feasible_set=lambda B: Product([(B.sets.normals, Bounds())]))
    return s.problem(contacts=[rough], extensions=parts).solve()


GIVEN = {
    r"extensions is the class Extensions; expected tfeti_dolfinx.Extensions": lambda s: s.problem(
        extensions=Extensions
    ),
    r"extensions: block is 'dense'; expected a callable": own(block="dense"),
    r"extensions: kplus is given, but only the package's own Block takes it": own(
        block=Block, kplus=raising
    ),
    r"extensions: a preconditioner is given, but -tfeti_pc_type is none, .* expected qp_type": own(
        options={"qp_type": "smalse"}, preconditioner=raising
    ),
}

RUN = {
    r"extensions: block gave None without apply_pinv, .*; expected a Block": own(
        block=lambda data: None
    ),
    r"extensions: feasible_set projects vectors of shape \(\d+,\) to \(\d+,\); expected a set "
    r"on all constraints of this rank": own(feasible_set=lambda constraints: OfThree()),
    "beta of WithoutBeta has shape .*; exp": own(feasible_set=lambda B: WithoutBeta()),
    r"extensions: feasible_set leaves multipliers of friction free": normals_alone,
    r"extensions: monitor: ZeroDivisionError: no such place": own(monitor=on_the_last_rank),
}

TABLES = ("GIVEN", "RUN")
