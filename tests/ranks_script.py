"""Solve a small contact scene and let rank 0 write points and displacements: see test_ranks."""

import sys

import numpy as np
from mpi4py import MPI
from scenes import curved_obstacle, decomposed, displacement, problem

import tfeti_dolfinx as tfeti

cell, subdomains, path = sys.argv[1], int(sys.argv[2]), sys.argv[3]
gdim = 2 if cell in ("triangle", "quadrilateral") else 3
d = decomposed(cell, 12 if gdim == 2 else 6, subdomains)
obstacle = tfeti.Obstacle("bottom", curved_obstacle(gdim), reach=0.05)
p = problem(d, (0.0,) * (gdim - 1) + (-0.05,), [obstacle], tfeti_rtol=float(sys.argv[4]))
p.solve()
x, u = displacement(p)
if MPI.COMM_WORLD.rank == 0:
    np.savez(path, x=x, u=u, active=p.report.active_contacts)
