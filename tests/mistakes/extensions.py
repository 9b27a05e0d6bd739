"""Mistakes in parts of one's own."""

import numpy as np

from mistakes.scene import raising
from tfeti_dolfinx import Extensions
from tfeti_dolfinx.qp.sets import Bounds
from tfeti_dolfinx.subdomains.block import Block


def own(says, contact=True, options=None, **parts):
    """Solve with parts of one's own."""

    def do(s):
        contacts, extensions = [s.floor] if contact else [], Extensions(**parts)
        s.problem(contacts=contacts, extensions=extensions, petsc_options=options).solve()

    return do, says


def on_the_last_rank(s, part):
    """Solve with a part that fails on the last rank only."""

    def fails(*_):
        if s.comm.rank == s.comm.size - 1:
            raising()

    s.problem(contacts=[s.floor], extensions=Extensions(**{part: fails})).solve()


class OfThree:
    """A set of vectors of three entries, whatever the rows are."""

    def __getattr__(self, name):
        return getattr(Bounds(), name)

    def project(self, x):
        return np.zeros(len(x) + 1)


GIVEN = {
    "extensions that are a class": (
        lambda s: s.problem(extensions=Extensions),
        r"extensions is the class Extensions; expected tfeti_dolfinx.Extensions",
    ),
    "a block that is a text": own(
        r"extensions: block is 'dense'; expected a callable", block="dense"
    ),
    "a K⁺ that the block does not use": own(
        r"extensions: kplus is given, but only the package's own Block takes it",
        block=Block,
        kplus=raising,
    ),
    "a preconditioner that nobody takes": own(
        r"extensions: a preconditioner is given, but -tfeti_pc_type is none, .* expected lumped",
        options={"qp_type": "smalse"},
        preconditioner=raising,
    ),
}

RUN = {
    "a block that is None": own(
        r"extensions: block gave None without apply_pinv, .*; expected a Block",
        block=lambda data: None,
    ),
    "a law of other rows": own(
        r"extensions: feasible_set projects vectors of shape \(\d+,\) to \(\d+,\); expected a set "
        r"on all rows of this rank",
        feasible_set=lambda constraints: OfThree(),
    ),
    "a monitor that fails on one rank": (
        lambda s: on_the_last_rank(s, "monitor"),
        r"extensions: monitor: ZeroDivisionError: no such place",
    ),
}

TABLES = ("GIVEN", "RUN")
