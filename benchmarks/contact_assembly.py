"""Contact search and mortar assembly beside the assembly of K, over a factor of 16 in facets.

    ./run mpirun -n 2 python3 benchmarks/contact_assembly.py [--quick] [--cells 12]

Two unit cubes lie one on the other, of n³ and (5n/4)³ hexahedra or six times as many tetrahedra,
so that their facets do not match; n is doubled twice. Nothing is solved. Results go to
results/contact_assembly.md, .json and .png.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv[:1])

import basix.ufl
import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from benchmarks.pictures import column, curves, picture
from benchmarks.tables import slope
from benchmarks.tools import command_line, finish
from tfeti_dolfinx.common.arrays import node_blocks
from tfeti_dolfinx.common.compat import create_mesh_in_place
from tfeti_dolfinx.contact.search import ContactSearch
from tfeti_dolfinx.forms.assembly import Forms
from tfeti_dolfinx.mesh.dofs import TornDofs

SURFACES = {"lower top": 1, "upper bottom": 2}
CELLS = ("hexahedron", "tetrahedron")
# six tetrahedra around a cube's diagonal; its corners are numbered x + 2y + 4z
TETRAHEDRA = [
    [0, 1, 3, 7],
    [0, 1, 5, 7],
    [0, 2, 3, 7],
    [0, 2, 6, 7],
    [0, 4, 5, 7],
    [0, 4, 6, 7],
]


def two_cubes(comm, cell, counts):
    """Unit cubes above z = 0 and z = 2 with counts cells per edge; each rank makes a share."""
    counts = np.array(counts)
    nodes = counts + 1
    body, index = share(comm, counts**3)
    n, m = counts[body], nodes[body]
    first = body * nodes[0] ** 3 + index % n + m * (index // n % n + m * (index // n**2))
    x, y, z = np.unravel_index(np.arange(8), (2, 2, 2), order="F")
    cells = first[:, None] + x + m[:, None] * (y + m[:, None] * z)
    if cell == "tetrahedron":
        cells = cells[:, TETRAHEDRA].reshape(-1, 4)
    body, index = share(comm, nodes**3)
    m = nodes[body]
    points = np.stack((index % m, index // m % m, index // m**2), axis=1) / (m - 1.0)[:, None]
    points[:, 2] += 2 * body
    element = basix.ufl.element("Lagrange", cell, 1, shape=(3,))
    return create_mesh_in_place(comm, cells, points, element)


def share(comm, sizes):
    """Body and index of this rank's share of the entries of both bodies."""
    ends = np.cumsum(sizes)
    chosen = ends[-1] * comm.rank // comm.size, ends[-1] * (comm.rank + 1) // comm.size
    entry = np.arange(*chosen)
    body = np.searchsorted(ends, entry, side="right")
    return body, entry - (ends - sizes)[body]


def scene(cell, counts):
    """The torn cubes, one on the other."""
    mesh = two_cubes(MPI.COMM_WORLD, cell, counts)
    facets = [
        dmesh.locate_entities_boundary(mesh, 2, lambda x, z=z: np.isclose(x[2], z)) for z in (1, 2)
    ]
    values = np.repeat(np.array([1, 2], dtype=np.int32), [len(f) for f in facets])
    order = np.argsort(np.concatenate(facets))
    tags = dmesh.meshtags(mesh, 2, np.concatenate(facets)[order], values[order])
    mesh.geometry.x[mesh.geometry.x[:, 2] > 1.5, 2] -= 1
    N = max(1, counts[0] // 12)

    def subdomain(x):
        i, j, k = (x * N).astype(int)
        return i + N * j + N * N * k

    return tfeti.decompose(mesh, subdomain, facet_tags=tags, surfaces=SURFACES)


def elasticity(decomposition):
    """Compiled forms, and the maps of their unknowns."""
    mesh = decomposition.mesh
    V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    elastic = tfeti.Elasticity(decomposition, E=1.0, nu=0.3)
    down = ufl.dot(fem.Constant(mesh, (0.0, 0.0, -1.0)), v) * ufl.dx
    forms = Forms(elastic.a(u, v), down, V, decomposition, {}, {})
    return forms, TornDofs(V, decomposition)


def best_time(work):
    """Least wall seconds of three runs, of the slowest rank, and the last run's result."""
    comm, least = MPI.COMM_WORLD, np.inf
    for _ in range(3):
        comm.barrier()
        start = time.perf_counter()
        result = work()
        least = min(least, comm.allreduce(time.perf_counter() - start, op=MPI.MAX))
    return least, result


def measure(cell, counts):
    """A row: facets of both surfaces, seconds of the contact stage and of the assembly of K."""
    comm = MPI.COMM_WORLD
    decomposition = scene(cell, counts)
    forms, dofs = elasticity(decomposition)
    contacts = [tfeti.Contact("upper bottom", "lower top", secondary="upper bottom")]
    assembly, K = best_time(forms.stiffness)
    blocks = node_blocks(K, dofs.bs)[dofs.dolfinx_node]
    contact, search = best_time(lambda: ContactSearch(contacts, dofs, decomposition, blocks))
    return {
        "facets": sum(comm.allreduce(len(decomposition.facets(name))) for name in SURFACES),
        "conditions": comm.allreduce(len(search.records)),
        "unknowns": comm.allreduce(dofs.num_nodes) * dofs.bs,
        "contact": contact,
        "assembly": assembly,
        "contact/assembly": contact / assembly,
    }


def study(cell, cells):
    """Rows for n = cells, 2 cells, 4 cells, and the slopes of time over facets."""
    measure(cell, (2, 3))  # compiles the forms
    rows = [measure(cell, (n, 5 * n // 4)) for n in (cells, 2 * cells, 4 * cells)]
    facets = [row["facets"] for row in rows]
    slopes = {name: slope(facets, [row[name] for row in rows]) for name in ("contact", "assembly")}
    return rows, slopes


def configure(parser):
    parser.add_argument("--cells", type=int, help="n of the smallest scene: 12, --quick 4")


def draw(path, tables):
    """Seconds over facets."""
    with picture(path, len(CELLS)) as axes:
        for panel, cell in zip(axes, CELLS, strict=True):
            rows = tables[f"Contact and assembly, {cell}"]
            lines = {
                name: (column(rows, "facets"), column(rows, name))
                for name in ("contact", "assembly")
            }
            curves(panel, cell, ("facets", "seconds"), lines)


def main(argv):
    """Run the tables and write them; returns them."""
    arguments, _ = command_line(__doc__, argv, configure)
    cells = arguments.cells or (4 if arguments.quick else 12)
    tables = {}
    for cell in CELLS:
        rows, slopes = study(cell, cells)
        tables[f"Contact and assembly, {cell}"] = rows
        tables[f"Slopes over facets, {cell}"] = [slopes]
    return finish(arguments.output, "contact_assembly", tables, draw, MPI.COMM_WORLD.rank)


if __name__ == "__main__":
    main(sys.argv[1:])
