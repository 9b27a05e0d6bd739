"""GetFEM: integral contact with a rigid obstacle, augmented Lagrangian (Alart's and Curnier's).

    benchmarks/peers/run python3 benchmarks/peers/getfem_hertz.py MESH.npz FILE.json [r]

Newton's method on displacements and multipliers at once, with MUMPS, from a rigid shift in which
the surfaces overlap where they will touch. Displacements of the mesh's order, multipliers of
degree 1 on the contact surface; r times E/a is the augmentation parameter.
"""

import sys

import getfem as gf
import numpy as np
from judged import best, length, write

CONTACT, TOP = 1, 2
RESIDUAL = 1e-6  # over the load
# gmsh's order of nodes to that of Lagrange elements row by row, by degree
TO_ROWS = {1: [0, 1, 2], 2: [0, 3, 1, 5, 4, 2]}


def mesh_of(data):
    """GetFEM's mesh, with its regions; face k of a triangle is opposite of its corner k."""
    order, mesh = int(data["order"]), gf.Mesh("empty", 2)
    corners = data["points"][data["cells"][:, TO_ROWS[order]]]  # cells, nodes, dim
    trans = gf.GeoTrans(f"GT_PK(2,{order})")
    ids = mesh.add_convex(trans, np.ascontiguousarray(corners.transpose(2, 1, 0)))
    for name, region in (("contact", CONTACT), ("top", TOP)):
        cell, opposite = data[f"{name} cells"].T
        mesh.set_region(region, np.stack((ids[cell], opposite)).astype(np.int32))
    return mesh


def solve(data, mesh, r):
    """Places, pressures there, unknowns, steps and whether they converged."""
    degree, fem_u, fem_1 = int(data["order"]), gf.MeshFem(mesh, 2), gf.MeshFem(mesh, 1)
    fem_u.set_fem(gf.Fem(f"FEM_PK(2,{degree})"))
    fem_1.set_fem(gf.Fem("FEM_PK(2,1)"))
    im = gf.MeshIm(mesh, gf.Integ(f"IM_TRIANGLE({2 if degree == 1 else 5})"))
    on_surface = gf.MeshIm(mesh, gf.Integ("IM_TRIANGLE(6)"))
    E, nu, a, R = (float(data[name]) for name in ("E", "nu", "a", "R"))
    model = gf.Model("real")
    model.add_fem_variable("u", fem_u)
    model.add_initialized_data("lambda", [E * nu / (1 + nu) / (1 - 2 * nu)])
    model.add_initialized_data("mu", [E / 2 / (1 + nu)])
    model.add_isotropic_linearized_elasticity_brick(im, "u", "lambda", "mu")
    model.add_initialized_data("traction", [0.0, -float(data["load"]) / length(data)])
    model.add_source_term_brick(im, "u", "traction", TOP)
    # the axis does not move to the side: no force is needed for that
    first = np.arange(0, fem_u.nbdof(), 2)
    x = fem_u.basic_dof_nodes()[0, first]
    fixed = first[np.abs(x) < 1e-9 * np.abs(x).max()]
    rows = gf.Spmat("empty", len(fixed), fem_u.nbdof())
    for k, dof in enumerate(fixed):
        rows.add(k, int(dof), 1.0)
    model.add_variable("held", len(fixed))
    model.add_constraint_with_multipliers("u", "held", rows, np.zeros(len(fixed)))
    surface = fem_1.basic_dof_on_region(CONTACT)
    model.add_fem_variable("pressure", gf.MeshFem("partial", fem_1, surface))
    model.add_initialized_fem_data("obstacle", fem_1, fem_1.basic_dof_nodes()[1])
    model.add_initialized_data("r", [r * E / a])
    model.add_integral_contact_with_rigid_obstacle_brick(
        on_surface, "u", "pressure", "obstacle", "r", CONTACT, 1
    )
    shift = np.zeros(fem_u.nbdof())
    shift[1::2] = -(a**2) / (2 * R)
    model.set_variable("u", shift)
    tolerance = RESIDUAL * float(data["load"])
    steps, converged = model.solve("max_res", tolerance, "max_iter", 100, "lsolver", "mumps")
    if not converged:
        raise RuntimeError(f"no convergence in {steps} steps")
    return (
        fem_1.basic_dof_nodes()[0, surface],
        -model.variable("pressure"),
        fem_u.nbdof() + len(surface),
        int(steps),
    )


def main(argv):
    """Solve, and write the pressure with what it took; the mesh is read before."""
    data = np.load(argv[0])
    mesh, r = mesh_of(data), float(argv[2]) if len(argv) > 2 else 10.0
    run = best(lambda: solve(data, mesh, r))
    write(argv[1], f"GetFEM {gf.getfem_env('version')}", run, *run["found"][2:])


if __name__ == "__main__":
    main(sys.argv[1:])
