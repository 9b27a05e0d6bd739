# # A body held only by contact
#
# A block lies in a corner of two rigid planes. No Dirichlet condition holds it: the load presses
# it into the corner, and contact alone finds the balance. Without the wall (`--no-wall`) it could
# slide along the floor; as long as no load drives it that way, the problem is solved and the
# motion reported as a free mode.
#
#     ./run mpirun -n 2 python3 demos/semicoercive_2d.py --plot

"""A block in a corner of two rigid planes, held only by contact."""

import sys
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv)  # before DOLFINx, which would initialise PETSc without options

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from demos.demo_tools import Demo


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD

    # ## Mesh
    n = arguments.cells or (16 if arguments.quick else 64)
    square = dmesh.create_rectangle(comm, [(0, 0), (1, 1)], [n, n], dmesh.CellType.quadrilateral)
    names = {"wall": 1, "floor": 2, "top": 3}
    facets = [
        dmesh.locate_entities_boundary(square, 1, lambda x: np.isclose(x[0], 0)),
        dmesh.locate_entities_boundary(square, 1, lambda x: np.isclose(x[1], 0)),
        dmesh.locate_entities_boundary(square, 1, lambda x: np.isclose(x[1], 1)),
    ]
    values = np.repeat(np.array(list(names.values()), dtype=np.int32), [len(f) for f in facets])
    order = np.argsort(np.concatenate(facets))
    facet_tags = dmesh.meshtags(square, 1, np.concatenate(facets)[order], values[order])
    decomposition = tfeti.decompose(
        square, arguments.subdomains, facet_tags=facet_tags, surfaces=names
    )
    mesh = decomposition.mesh

    # ## Elasticity in plane strain
    elastic = tfeti.Elasticity(decomposition, E=1.0, nu=0.3, model="plane_strain")

    V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    dx = ufl.Measure("dx", domain=mesh, metadata={"quadrature_degree": 2})
    ds = ufl.Measure(
        "ds",
        domain=mesh,
        subdomain_data=decomposition.facet_tags,
        metadata={"quadrature_degree": 3},
    )

    # ## Load and contacts
    #
    # Gravity, and a traction on the left part of the top, with a push towards the wall if there is
    # one. The resultant is so far to the left that the block lifts off the floor on the right.
    # Wall and floor are a small gap away: the block first has to get there.
    push = 0.0 if arguments.no_wall else -0.003
    x = ufl.SpatialCoordinate(mesh)
    gravity = fem.Constant(mesh, (0.0, -0.003))
    traction = ufl.as_vector((push, -0.045 * ufl.max_value(1 - 3 * x[0], 0)))
    contacts = [tfeti.Obstacle("floor", tfeti.Plane((0, -0.01), normal=(0, 1)), name="floor")]
    if not arguments.no_wall:
        wall = tfeti.Plane((-0.01, 0), normal=(1, 0))
        contacts.append(tfeti.Obstacle("wall", wall, name="wall"))
    problem = tfeti.ContactProblem(
        elastic.a(u, v),
        ufl.dot(gravity, v) * dx + ufl.dot(traction, v) * ds(decomposition.surface("top")),
        [],
        contacts,
        decomposition,
        stress=elastic.stress,
        petsc_options=demo.petsc_options,
    )
    problem.solve()

    # ## Balance
    #
    # Each contact carries the load that points at it.
    load = fem.assemble_scalar(fem.form(traction[1] * ds(decomposition.surface("top"))))
    loads = {"floor": 0.003 - comm.allreduce(load), "wall": -push}
    for name in (contact.name for contact in contacts):
        force = comm.allreduce(problem.solution.contact(name).force.sum())
        problem.report.errors[f"force_{name}"] = force / loads[name] - 1
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        plot_deformed(demo.folder / "semicoercive_2d.png", problem.solution, factor=1.0)
    return demo.finish(problem, "semicoercive_2d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--subdomains", type=int, default=16, help="their number")
    parser.add_argument("--cells", type=int, help="cells along an edge of the block")
    parser.add_argument("--no-wall", action="store_true", help="let the block slide freely")


if __name__ == "__main__":
    main(sys.argv[1:])
