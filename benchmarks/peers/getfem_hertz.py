"""GetFEM: integral contact with a rigid obstacle, augmented Lagrangian (Alart's and Curnier's).

    benchmarks/peers/run python3 benchmarks/peers/getfem_hertz.py MESH.npz FILE.json [r]

Newton's method on displacements and multipliers at once, with MUMPS, from a rigid shift in which
the surfaces overlap where they will touch. Displacements of the mesh's order, multipliers of
degree 1 on the contact surface; r times E/a is the augmentation parameter.
"""

import sys

import getfem as gf
import numpy as np
from judged import best, write

CONTACT, TOP = 1, 2
RESIDUAL = 1e-6  # over the load
# gmsh's order of nodes to that of Lagrange elements row by row, by dimension and degree
TO_ROWS = {
    (2, 1): [0, 1, 2],
    (3, 1): [0, 1, 2, 3],
    (2, 2): [0, 3, 1, 5, 4, 2],
    (3, 2): [0, 4, 1, 6, 5, 2, 7, 9, 8, 3],
}


def mesh_of(data):
    """GetFEM's mesh, with its regions; face k of a simplex is opposite of its corner k."""
    points, cells, order = data["points"], data["cells"], int(data["order"])
    dim = points.shape[1]
    mesh = gf.Mesh("empty", dim)
    corners = points[cells[:, TO_ROWS[dim, order]]]  # cells, nodes, dim
    trans = gf.GeoTrans(f"GT_PK({dim},{order})")
    ids = mesh.add_convex(trans, np.ascontiguousarray(corners.transpose(2, 1, 0)))
    for name, region in (("contact", CONTACT), ("top", TOP)):
        cell, opposite = data[f"{name} cells"].T
        mesh.set_region(region, np.stack((ids[cell], opposite)).astype(np.int32))
    return mesh


def held(model, fem_u, data):
    """Rigid motions that the plane does not hold: no force is needed for that."""
    x, dim = fem_u.basic_dof_nodes(), data["points"].shape[1]
    first = np.arange(0, x.shape[1], dim)
    nodes = x[:, first].T
    if dim == 2:
        scale = np.abs(nodes).max()
        fixed = first[np.abs(nodes[:, 0]) < 1e-9 * scale]
    else:
        R = float(data["R"])
        near = [np.argmin(np.linalg.norm(nodes - p, axis=1)) for p in ((0, 0, R), (R, 0, R))]
        fixed = np.array([first[near[0]], first[near[0]] + 1, first[near[1]] + 1])
    n = fem_u.nbdof()
    rows = gf.Spmat("empty", len(fixed), n)
    for k, dof in enumerate(fixed):
        rows.add(k, int(dof), 1.0)
    model.add_variable("held", len(fixed))
    model.add_constraint_with_multipliers("u", "held", rows, np.zeros(len(fixed)))


def solve(data, mesh, r):
    """Points, pressures there, unknowns and iterations."""
    dim, degree = data["points"].shape[1], int(data["order"])
    fem_u, fem_1 = gf.MeshFem(mesh, dim), gf.MeshFem(mesh, 1)
    fem_u.set_fem(gf.Fem(f"FEM_PK({dim},{degree})"))
    fem_1.set_fem(gf.Fem(f"FEM_PK({dim},1)"))
    name = {2: "IM_TRIANGLE({})", 3: "IM_TETRAHEDRON({})"}[dim]
    im = gf.MeshIm(mesh, gf.Integ(name.format(2 if degree == 1 else 5)))
    on_surface = gf.MeshIm(mesh, gf.Integ(name.format(5 if dim == 3 else 6)))
    E, nu, a, R = (float(data[name]) for name in ("E", "nu", "a", "R"))
    model = gf.Model("real")
    model.add_fem_variable("u", fem_u)
    model.add_initialized_data("lambda", [E * nu / (1 + nu) / (1 - 2 * nu)])
    model.add_initialized_data("mu", [E / 2 / (1 + nu)])
    model.add_isotropic_linearized_elasticity_brick(im, "u", "lambda", "mu")
    area = gf.asm_generic(im, 0, "1", TOP)
    traction = np.zeros(dim)
    traction[-1] = -float(data["load"]) / area
    model.add_initialized_data("traction", traction)
    model.add_source_term_brick(im, "u", "traction", TOP)
    held(model, fem_u, data)
    partial = gf.MeshFem("partial", fem_1, fem_1.basic_dof_on_region(CONTACT))
    model.add_fem_variable("pressure", partial)
    heights = fem_1.basic_dof_nodes()[-1]
    model.add_initialized_fem_data("obstacle", fem_1, heights)
    model.add_initialized_data("r", [r * E / a])
    model.add_integral_contact_with_rigid_obstacle_brick(
        on_surface, "u", "pressure", "obstacle", "r", CONTACT, 1
    )
    shift = np.zeros(fem_u.nbdof())
    shift[dim - 1 :: dim] = -(a**2) / (2 * R)
    model.set_variable("u", shift)
    tolerance = RESIDUAL * float(data["load"])
    done = model.solve("max_res", tolerance, "max_iter", 100, "lsolver", "mumps")
    points = fem_1.basic_dof_nodes()[:, fem_1.basic_dof_on_region(CONTACT)].T
    return points, -model.variable("pressure"), fem_u.nbdof() + len(points), done


def main(argv):
    """Solve, and write the pressure with what it took; the mesh is read before."""
    data = np.load(argv[0])
    mesh = mesh_of(data)
    r = float(argv[2]) if len(argv) > 2 else 10.0
    run = best(lambda: solve(data, mesh, r))
    _, _, unknowns, (steps, converged) = run["found"]
    if not converged:
        raise RuntimeError(f"no convergence in {steps} steps")
    version = gf.getfem_env("version")
    write(argv[1], f"GetFEM {version}", run, unknowns=unknowns, steps=int(steps))


if __name__ == "__main__":
    main(sys.argv[1:])
