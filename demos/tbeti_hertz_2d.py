# # Hertz contact of boundary elements in 2D
#
# A half cylinder on a block in plane strain, both with boundary elements, one subdomain each:
# only their surfaces have unknowns. Or one of them has finite elements: `--finite block`.
#
#     ./run mpirun -n 2 python3 demos/tbeti_hertz_2d.py --plot
#     ./run mpirun -n 2 python3 demos/tbeti_hertz_2d.py --finite block

"""Hertz contact in 2D of two bodies with boundary elements, or with boundary and finite ones."""

import sys
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv)  # before DOLFINx, which would initialise PETSc without options

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from demos.demo_tools import Demo
from demos.hertz import LineContact, compare
from meshes.cylinder_on_block import build

BODIES = ("cylinder", "block")
R, a, nu = 1.0, 0.03, 0.3
young = {"cylinder": 1.0, "block": 0.5}


def closed_form():
    """Hertz' line contact of the two bodies."""
    return LineContact.from_half_width(a, R, 1 / sum((1 - nu**2) / E for E in young.values()))


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD

    # ## Mesh
    #
    # Each body is a subdomain. Boundary elements use nothing but the edges of its mesh.
    elements = arguments.elements or (8 if arguments.quick else 20)
    model = None
    if comm.rank == 0:
        growth = 0.3 if arguments.quick else 0.15
        model = build(R, 4 * R, a / elements, 1.5 * a, growth, coarser=1.1)
    decomposition = tfeti.read_gmsh(model, comm, subdomains=lambda x: (x[1] < 0).astype(int))
    mesh = decomposition.mesh

    # ## Elasticity
    #
    # The forms are those of all bodies; boundary elements read their moduli from them.
    elastic = tfeti.Elasticity(decomposition, E=young, nu=nu, model="plane_strain")
    V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

    # ## Load, conditions, contact
    #
    # Inside boundary elements nothing can be prescribed: two nodes of the cylinder's axis, on
    # its surface, stay on x = 0. By symmetry no force acts there.
    hertz = closed_form()
    traction = fem.Constant(mesh, (0.0, -hertz.load / (2 * R)))
    ends = fem.locate_dofs_topological(V.sub(0), 1, decomposition.facets("arc"))
    x = V.tabulate_dof_coordinates()
    middle = fem.locate_dofs_topological(V.sub(0), 1, decomposition.facets("load"))
    held = np.concatenate((ends, middle))
    held = held[np.abs(x[held // 2, 0]) < 1e-9 * R]
    bottom = fem.locate_dofs_topological(V, 1, decomposition.facets("bottom"))
    bcs = [
        fem.dirichletbc(0.0, held.astype(np.int32), V.sub(0)),
        fem.dirichletbc(np.zeros(2), bottom, V),
    ]

    # ## Boundary elements
    names = [name for name in BODIES if name not in (arguments.finite or ())]
    problem = tfeti.ContactProblem(
        elastic.a(u, v),
        ufl.dot(traction, v) * ds(decomposition.surface("load")),
        bcs,
        [tfeti.Contact("arc", "top", reach=a**2 / R)],
        decomposition,
        stress=elastic.stress,
        petsc_options=demo.petsc_options,
        boundary_elements=tfeti.BoundaryElements(*names) if names else None,
    )
    problem.solve()

    # ## Comparison with the closed form
    #
    # On the axis of the block, a depth of z below the contact, Somigliana's identity gives the
    # stress; that of Hertz is σ_y = −p₀ / √(1 + z²/a²).
    contact = problem.solution.contact(0)
    errors = compare(comm, contact, contact.points[:, 0], hertz)
    depth = a * np.array([0.5, 1.0, 2.0])
    found = problem.solution.at(np.stack((0 * depth, -depth), axis=1)).stress[:, 1, 1]
    exact = -hertz.peak / np.sqrt(1 + (depth / a) ** 2)
    errors["stress_below"] = float(np.abs(found / exact - 1).max())
    problem.report.errors.update(errors)
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed, plot_pressure

        folder, solution = demo.folder, problem.solution
        zoom = {"focus": (0.0, 0.0, 0.0), "zoom": 25.0, "show_edges": False}
        plot_deformed(folder / "tbeti_hertz_2d.png", solution, factor=1.0, **zoom)
        plot_pressure(
            folder / "tbeti_hertz_2d_pressure.png",
            solution,
            lambda points: points[:, 0],
            hertz.pressure,
            limit=2 * a,
        )
    return demo.finish(problem, "tbeti_hertz_2d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--elements", type=int, help="elements along the half width a")
    parser.add_argument(
        "--finite", nargs="+", choices=BODIES, metavar="BODY", help="bodies of finite elements"
    )


if __name__ == "__main__":
    main(sys.argv[1:])
