"""Mistakes with what a solve has found: fields, contacts, files and pictures."""

import numpy as np

from tfeti_dolfinx.io.output import write_vtx
from tfeti_dolfinx.io.plot import plot_deformed, plot_pressure

SOLUTION = r"solution is .*; expected the solution of a ContactProblem"


def occupied(s):
    """A folder with something of the user's in it, and a file where one expects a folder."""
    folder = s.folder
    if s.comm.rank == 0:
        (folder / "file").write_text("mine")
        (folder / "mine.bp").mkdir(exist_ok=True)
        (folder / "mine.bp" / "notes.txt").write_text("mine")
    s.comm.barrier()
    return folder


def contact(index):
    """Ask for a contact of the solution."""
    return lambda s: s.solved.contact(index)


def picture(**arguments):
    """A picture of the deformed body."""
    return lambda s: plot_deformed(s.folder / "a.png", s.solved, **arguments)


def curve(coordinate, *others, **arguments):
    """A picture of the pressure."""
    return lambda s: plot_pressure(s.folder / "a.png", s.solved, coordinate, *others, **arguments)


FIELDS = {
    r"there is no solution yet; expected a call of solve\(\) before": lambda s: (
        s.problem().solution
    ),
    r"contact 'bottom': there is none; .*, of 0: obstacle of surface 'bottom'": contact("bottom"),
    r"contact .*bottom.*: several have this name; .*, of 0: .*, 1: obstacle": lambda s: (
        s.twice.contact("obstacle of surface 'bottom'")
    ),
    r"no stress: give ContactProblem\(..., stress=sigma\)": lambda s: s.bare.stress,
}

FILES = {
    r"x.vtu: expected a name that ends with .bp": lambda s: write_vtx(s.folder / "x.vtu", s.solved),
    r"cannot write .*x.bp: ": lambda s: write_vtx(occupied(s) / "file" / "x.bp", s.solved),
    r"mine.bp is a directory that VTX has not written": lambda s: write_vtx(
        occupied(s) / "mine.bp", s.solved
    ),
}

PICTURES = {
    SOLUTION: lambda s: plot_deformed(s.folder / "a.png", s.problem()),
    r"zoom=0: expected a positive number": picture(zoom=0),
    r"focus=\(0, 0\): expected three finite numbers": picture(focus=(0, 0)),
    r"cut=\(0, 0, 0\): expected a point and a normal": picture(cut=(0, 0, 0)),
    r"coordinate of points of shape \(3, \d\) has the shape \(3, \d\); expected \(\d,\)": curve(
        lambda x: x
    ),
    r"closed_form is an array of shape \(3,\); expected a callable": curve(
        lambda x: x[0], np.zeros(3)
    ),
    r"unit is 3; expected a string": curve(lambda x: x[0], unit=3),
}

TABLES = ("FIELDS", "FILES", "PICTURES")
