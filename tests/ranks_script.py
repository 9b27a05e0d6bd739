"""Solve small contact scenes and let rank 0 write points and displacements: see test_ranks."""

import sys
from functools import partial
from pathlib import Path

import numpy as np
import ufl
from bodies import held, sided, stacked, two_body_problem
from mpi4py import MPI
from scenes import by_point, curved_obstacle, decomposed, displacement, problem, solved

import tfeti_dolfinx as tfeti


def obstacle_scene(cell, subdomains, friction=None, **options):
    """A clamped box on a curved obstacle: some nodes get their rows late."""
    gdim = 2 if cell in ("triangle", "quadrilateral") else 3
    d = decomposed(cell, 12 if gdim == 2 else 6, subdomains)
    obstacle = tfeti.Obstacle("bottom", curved_obstacle(gdim), reach=0.022, friction=friction)
    return problem(d, (0.0,) * (gdim - 1) + (-0.05,), [obstacle], **options)


def pair_scene(cell, subdomains, **options):
    """A box with its left and front held on another one, pressed where x is large."""
    gdim = 2 if cell in ("triangle", "quadrilateral") else 3
    n = (9, 12) if gdim == 2 else (4, 5)
    d = stacked(cell, *n, subdomains)

    def load(v, ds):
        x = ufl.SpatialCoordinate(d.mesh)
        return (0.05 - 0.2 * x[0]) * v[gdim - 1] * ds(d.surface("upper top"))

    sides = ["lower bottom", "lower left", "upper left", "upper right"]
    sides += ["lower front", "upper front"] if gdim == 3 else []
    pair = sided("upper bottom", "lower top")
    return two_body_problem(d, load, held(d, *sides), [pair], **options)


# the rough one sticks, or slips
rough = partial(obstacle_scene, friction=tfeti.Coulomb(0.3))
SCENES = {"obstacle": obstacle_scene, "pair": pair_scene, "rough": rough}


def write(path, p):
    """What test_ranks compares, in an order that no rank decides."""
    x, u = displacement(p)
    data = p.solution.contact(0)
    found = {"force": data.force, "gap": data.gap, "traction": data.tangential_traction}
    _, *parts = by_point(MPI.COMM_WORLD, data.points, *found.values())
    contact = dict(zip(found, parts, strict=True))
    contact |= {"sticking": p.report.sticking, "sliding": p.report.sliding}
    if MPI.COMM_WORLD.rank == 0:
        np.savez(
            path,
            x=x,
            u=u,
            active=p.report.active_contacts,
            late=p.report.late_contact_rows,
            **contact,
        )


if __name__ == "__main__":
    folder, rtol, *cases = sys.argv[1:]
    for case in cases:
        scene, cell, subdomains = case.split("-")
        p = solved(SCENES[scene](cell, int(subdomains), tfeti_rtol=float(rtol)))
        write(Path(folder) / f"{case}.npz", p)
        p.destroy()
