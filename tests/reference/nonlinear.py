"""Nonlinear bodies above rigid planes by PETSc's active set Newton method, on the untorn mesh."""

import inspect

import numpy as np
from dolfinx import fem
from dolfinx import mesh as dmesh
from dolfinx.fem import petsc as fem_petsc
from mpi4py import MPI
from petsc4py import PETSc
from scipy.integrate import solve_bvp
from scipy.spatial import cKDTree


def block(gdim, n, bulge, comm=MPI.COMM_SELF):
    """A block [0, 2] × ([0, 1] ×) [0, 1], whose lower side is a bulge above the plane 0.

    Returns the mesh and tags of its lower (1) and upper (2) side.
    """
    if gdim == 2:
        mesh = dmesh.create_rectangle(
            comm, [[0.0, 0.0], [2.0, 1.0]], (2 * n, n), dmesh.CellType.quadrilateral
        )
    else:
        mesh = dmesh.create_box(
            comm, [[0.0] * 3, [2.0, 1.0, 1.0]], (2 * n, n, n), dmesh.CellType.hexahedron
        )
    x, up = mesh.geometry.x, gdim - 1
    low = bulge * (0.02 + (x[:, 0] - 1.0) ** 2 + (0.5 * x[:, 1] ** 2 if gdim == 3 else 0.0))
    height = x[:, up].copy()
    mesh.topology.create_connectivity(gdim - 1, gdim)
    sides = [
        dmesh.locate_entities_boundary(mesh, gdim - 1, lambda p, z=z: np.isclose(p[up], z))
        for z in (0.0, 1.0)
    ]
    x[:, up] += low * (1.0 - height)
    facets = np.concatenate(sides)
    values = np.repeat(np.array([1, 2], dtype=np.int32), [len(side) for side in sides])
    order = np.argsort(facets)
    return mesh, dmesh.meshtags(mesh, gdim - 1, facets[order], values[order])


def above_plane(F, J, u, bcs, touching, up, starts):
    """Yield u for each start of a load step: F(u) = 0 where u_up + x_up ≥ 0 allows it.

    That is what nodes ``touching`` have to fulfil; J is F's derivative, u is changed in place, and
    ``starts`` are called before each step.
    """
    V = u.function_space
    residual, jacobian = fem.form(F), fem.form(J)
    points, bs = V.tabulate_dof_coordinates(), V.dofmap.bs
    low, high = fem.Function(V), fem.Function(V)
    low.x.array[:], high.x.array[:] = -1e10, 1e10
    low.x.array[bs * touching + up] = -points[touching, up]
    x = fem.Function(V)

    def function(_, y, f):
        y.copy(u.x.petsc_vec)
        f.set(0.0)
        fem_petsc.assemble_vector(f, residual)
        fem_petsc.apply_lifting(f, [jacobian], bcs=[bcs], x0=[y], alpha=-1.0)
        fem_petsc.set_bc(f, bcs, y, -1.0)

    def derivative(_, y, A, P):
        A.zeroEntries()
        fem_petsc.assemble_matrix(A, jacobian, bcs=bcs)
        A.assemble()

    A, b = fem_petsc.create_matrix(jacobian), x.x.petsc_vec.duplicate()
    snes = PETSc.SNES().create(MPI.COMM_SELF)
    snes.setFunction(function, b)
    snes.setJacobian(derivative, A, A)
    snes.setType("vinewtonrsls")
    snes.setTolerances(rtol=1e-13, atol=1e-13, stol=0.0, max_it=100)
    snes.getKSP().setType("preonly")
    snes.getKSP().getPC().setType("lu")
    snes.setVariableBounds(low.x.petsc_vec, high.x.petsc_vec)
    for start in starts:
        start()
        for bc in bcs:
            bc.set(x.x.array)
        np.maximum(x.x.array, low.x.array, out=x.x.array)
        snes.solve(None, x.x.petsc_vec)
        assert snes.getConvergedReason() > 0
        u.x.array[:] = x.x.array
        yield np.array(x.x.array.reshape(-1, bs))
    snes.destroy()


def by_dolfinx(F, u, bcs):
    """Return a function that solves F(u) = 0 by DOLFINx's own nonlinear problem."""
    lu = {"ksp_type": "preonly", "pc_type": "lu"}
    if "petsc_options_prefix" in inspect.signature(fem_petsc.NonlinearProblem).parameters:
        exact = {"snes_rtol": 1e-12, "snes_atol": 1e-13, "snes_error_if_not_converged": None}
        given = {"petsc_options_prefix": "reference_", "petsc_options": {**lu, **exact}}
        return fem_petsc.NonlinearProblem(F, u, bcs=bcs, **given).solve
    from dolfinx.nls.petsc import NewtonSolver

    solver = NewtonSolver(MPI.COMM_SELF, fem_petsc.NonlinearProblem(F, u, bcs=bcs))
    solver.rtol, solver.atol, solver.max_it = 1e-12, 1e-13, 100
    solver.krylov_solver.setType(lu["ksp_type"])
    solver.krylov_solver.getPC().setType(lu["pc_type"])
    return lambda: solver.solve(u)


def nearest_nodes(V, W):
    """For each node of W that of V at the same place."""
    distance, found = cKDTree(V.tabulate_dof_coordinates()).query(W.tabulate_dof_coordinates())
    assert np.all(distance < 1e-12)
    return found


def pressed_ring(inside, outside, widened, E, nu):
    """Return where radii of a ring of ``neo_hooke`` are in plane strain, the inner one widened.

    Balance of a ring, (R P_r)' = P_θ, P the derivatives of the energy in the stretches r' and r/R.
    """
    mu, lmbda = E / 2 / (1 + nu), E * nu / (1 + nu) / (1 - 2 * nu)

    def stress(a, b):  # along the stretch a
        return mu * (a - 1 / a) + lmbda * np.log(a * b) / a

    def slope(R, y):  # r' = a, and a' from R dP_r/da a' = P_θ − P_r − R dP_r/db (a − b)/R
        a, b = y[1], y[0] / R
        of_a = mu * (1 + 1 / a**2) + lmbda * (1 - np.log(a * b)) / a**2
        of_b = lmbda / (a * b)
        return np.stack((a, (stress(b, a) - stress(a, b) - of_b * (a - b)) / (R * of_a)))

    def ends(first, last):
        return np.array([first[0] - widened, stress(last[1], last[0] / outside)])

    R = np.linspace(inside, outside, 50)
    found = solve_bvp(slope, ends, R, np.stack((R + widened - inside, np.ones_like(R))), tol=1e-9)
    assert found.success
    return lambda R: found.sol(R)[0]
