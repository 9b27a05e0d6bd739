# # Two elastic bodies of equal subdomains in contact
#
# The Hertz table of the benchmarks, in plane strain: a body with a curved lower side is pressed
# on a block. Both are squares of N × N subdomains, and a subdomain has 100 × 100 nodes.
#
#     ./run mpirun -n 2 python3 demos/talk_hertz_2d.py --subdomains 32

"""Hertz contact of two elastic bodies in 2D, each a square of equal subdomains."""

import sys
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv)  # before DOLFINx, which would initialise PETSc without options

import basix.ufl
import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from demos.demo_tools import Demo
from demos.hertz import LineContact, compare
from tfeti_dolfinx.common.compat import create_mesh_in_place

SIDES = {"lower bottom": 1, "lower top": 2, "upper bottom": 3, "upper top": 4}


def flat_squares(comm, n):
    """Unit squares of n × n cells above y = 0 and y = 2; each rank makes a share of them."""
    body, row, column = share_of_grid(comm, (2, n, n))
    first = column + (n + 1) * (row + (n + 1) * body)
    cells = np.stack((first, first + 1, first + n + 1, first + n + 2), axis=1)
    body, row, column = share_of_grid(comm, (2, n + 1, n + 1))
    points = np.stack((column / n - 0.5, row / n + 2 * body), axis=1)
    element = basix.ufl.element("Lagrange", "quadrilateral", 1, shape=(2,))
    return create_mesh_in_place(comm, cells, points, element)


def share_of_grid(comm, shape):
    """Indices of this rank's share of a grid's entries."""
    size = np.prod(shape)
    share = np.arange(size * comm.rank // comm.size, size * (comm.rank + 1) // comm.size)
    return np.unravel_index(share, shape)


def tags_of_sides(mesh):
    """Tags of the sides y = 0, 1, 2, 3 of the flat squares."""
    facets = [
        dmesh.locate_entities_boundary(mesh, 1, lambda x, y=y: np.isclose(x[1], y))
        for y in range(4)
    ]
    values = np.repeat(np.array(list(SIDES.values()), dtype=np.int32), [len(f) for f in facets])
    order = np.argsort(np.concatenate(facets))
    return dmesh.meshtags(mesh, 1, np.concatenate(facets)[order], values[order])


def subdomains_of_cells(mesh, N):
    """Subdomain of each cell of this rank: N × N equal ones in each flat square."""
    cells = np.arange(mesh.topology.index_map(2).size_local, dtype=np.int32)
    x, y, _ = dmesh.compute_midpoints(mesh, 2, cells).T
    return ((x + 0.5) * N).astype(int) + N * (y * N).astype(int)


def put_into_place(mesh, R):
    """Lower square below y = 0; upper one above it, its lower side bent to y = x²/2R."""
    x, y, _ = mesh.geometry.x.T  # views
    upper = y > 1.5
    y -= np.where(upper, 2, 1)
    y[upper] += (1 - y[upper]) * x[upper] ** 2 / (2 * R)


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD
    N = round((arguments.subdomains / 2) ** 0.5)
    cells = arguments.cells or (12 if arguments.quick else 99)

    # ## Mesh
    #
    # Tags and subdomains are found on flat squares, which are then bent. `decompose` moves the
    # cells to their ranks.
    R, E, nu = 2.0, 1.0, 0.3
    squares = flat_squares(comm, N * cells)
    facet_tags = tags_of_sides(squares)
    subdomains = subdomains_of_cells(squares, N)
    put_into_place(squares, R)
    decomposition = tfeti.decompose(squares, subdomains, facet_tags=facet_tags, surfaces=SIDES)
    mesh = decomposition.mesh

    # ## Elasticity in plane strain
    #
    # Its stress is a 3×3 tensor, so that σ_zz is in von Mises' stress.
    elastic = tfeti.Elasticity(decomposition, E=E, nu=nu, model="plane_strain")

    V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    degree = {"quadrature_degree": 2}
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags, metadata=degree)

    # ## Load, conditions, contact
    #
    # The load on the top is the one that presses half planes together over the half width a. The
    # top stays on its place in x; in y the contact alone holds the upper body.
    a = 0.15
    hertz = LineContact.from_half_width(a, R, E / (1 - nu**2) / 2)
    traction = fem.Constant(mesh, (0.0, -hertz.load))
    fixed = fem.locate_dofs_topological(V, 1, decomposition.facets("lower bottom"))
    guided = fem.locate_dofs_topological(V.sub(0), 1, decomposition.facets("upper top"))
    problem = tfeti.ContactProblem(
        elastic.a(u, v),
        ufl.dot(traction, v) * ds(decomposition.surface("upper top")),
        [fem.dirichletbc(np.zeros(2), fixed, V), fem.dirichletbc(0.0, guided, V.sub(0))],
        [tfeti.Contact("upper bottom", "lower top", secondary="upper bottom", reach=a / 3)],
        decomposition,
        stress=elastic.stress,
        petsc_options=demo.petsc_options,
    )
    problem.solve()

    # ## Comparison with the closed form
    contact = problem.solution.contact(0)
    problem.report.errors.update(compare(comm, contact, contact.points[:, 0], hertz))
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        view = {"focus": (0.0, -0.15, 0.0), "zoom": 0.9, "show_edges": False}
        plot_deformed(demo.folder / "talk_hertz_2d.png", problem.solution, factor=1.0, **view)
    return demo.finish(problem, "talk_hertz_2d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--subdomains", type=int, default=2, help="twice a square: 2, 32, 512")
    parser.add_argument("--cells", type=int, help="quadrilaterals along an edge of a subdomain")


if __name__ == "__main__":
    main(sys.argv[1:])
