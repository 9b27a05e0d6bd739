"""A pin in the bore of a lug: forces with straight facets, gap="curved", and degree 2.

    ./run python3 benchmarks/curved_gaps.py

Radius 10, clearance 0.05, moduli of steel, plane strain; the pin's core is moved down by 0.1. Force
and highest pressure are compared with those of a mesh of degree 2 and size 0.5. Results go to
results/curved_gaps.md and .json; any number of ranks gives the same.
"""

from __future__ import annotations

import sys

import numpy as np
from mpi4py import MPI

import tfeti_dolfinx as tfeti
from benchmarks.elastic import Elastic
from benchmarks.tools import command_line, finish
from meshes.lug import lug

PUSHED, FINE = 0.1, (0.5, 0.5)
SIZES = [(3, 2), (2, 3), (1.5, 1), (1, 1.5), (0.75, 0.5), (0.5, 0.75)]
KINDS = {
    "straight facets": ("geometry", 1),
    '`gap="curved"`': ("curved", 1),
    "degree 2": ("geometry", 2),
}


def force_and_peak(sizes, gap, order):
    """Force that holds the pin up, and the highest pressure."""
    body = Elastic(lug(MPI.COMM_WORLD, sizes, order), 210e3, 0.3, "plane_strain", order)
    for name, down in (("edge", 0.0), ("core", -PUSHED)):
        body.hold(name, 0)
        body.hold(name, 1, down)
    problem = body.problem([tfeti.Contact("pin side", "bore", gap=gap)], rtol=1e-7)
    problem.solve()
    contact = problem.solution.contact()
    peak = MPI.COMM_WORLD.allreduce(contact.pressure.max(initial=0.0), op=MPI.MAX)
    return np.array([abs(contact.resultant.force[1]), peak])


def percent(error):
    """An error in per cent, with a sign, in two digits."""
    text = f"{error:.0f}" if abs(error) >= 10 else f"{error:.1f}"
    return "0.0 %" if float(text) == 0.0 else f"{float(text):+g} %".replace("-", "−")


def main(argv):
    """Return the table."""
    arguments, _ = command_line(__doc__, argv)
    exact = force_and_peak((1.0, 1.0) if arguments.quick else FINE, "geometry", 2)
    rows = []
    for pair in SIZES[:2] if arguments.quick else SIZES:
        row = {"elements of pin, lug": f"{pair[0]:g}, {pair[1]:g}"}
        for name, (gap, order) in KINDS.items():
            force, peak = 100 * (force_and_peak(pair, gap, order) / exact - 1)
            row[name] = f"{percent(force)}, {percent(peak)}"
        rows.append(row)
    return finish(arguments, "curved_gaps", {"Pin in a lug": rows})


if __name__ == "__main__":
    main(sys.argv[1:])
