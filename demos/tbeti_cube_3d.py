# # A cube of boundary elements on a curved obstacle
#
# The scene of `cube_3d.py` with boundary elements in all subdomains, each a cube of 9 × 9 × 9
# cells: 1464 unknowns on its surface, as in the talk's table of Total BETI. S is assembled once,
# since the subdomains are equal.
#
#     ./run mpirun -n 2 python3 demos/tbeti_cube_3d.py --subdomains 64

"""A cube of equal subdomains with boundary elements, pressed on a curved obstacle: Total BETI."""

import sys
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv)  # before DOLFINx, which would initialise PETSc without options

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from demos import cube_3d
from demos.demo_tools import Demo


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments = demo.arguments

    # ## Mesh and forms
    #
    # Those of finite elements. Boundary elements read their moduli from the bilinear form, and
    # the mesh inside serves for pictures alone.
    arguments.cells = arguments.cells or (3 if arguments.quick else 9)
    problem = tfeti.ContactProblem(
        **cube_3d.scene(cube_3d.torn_mesh(arguments)),
        petsc_options=demo.petsc_options,
        boundary_elements=tfeti.BoundaryElements(),
    )
    problem.solve()
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        plot_deformed(demo.folder / "tbeti_cube_3d.png", problem.solution, factor=1.0)
    return demo.finish(problem, "tbeti_cube_3d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--subdomains", type=int, default=8, help="their number: 8, 64, 216")
    parser.add_argument("--cells", type=int, help="hexahedra along an edge of a subdomain")


if __name__ == "__main__":
    main(sys.argv[1:])
