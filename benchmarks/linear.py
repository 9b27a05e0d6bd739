"""The linear problem of a contact's solution on the untorn mesh, and PETSc's solvers for it.

Components that Dirichlet conditions prescribe keep their values; nodes that carry a contact force
get the displacement that the contact's solution has there. The linear problem then has the same
solution as the contact, and no motion is free.
"""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.forms.assembly import Forms

# what to try of each; the best one counts
GAMG, HYPRE = "-pc_type gamg", "-pc_type hypre -pc_hypre_boomeramg"
SETTINGS = {
    "GAMG": {
        "as PETSc has it": GAMG,
        "threshold 0.01": f"{GAMG} -pc_gamg_threshold 0.01",
        "threshold 0.03": f"{GAMG} -pc_gamg_threshold 0.03",
        "threshold 0.01, SOR": f"{GAMG} -pc_gamg_threshold 0.01 -mg_levels_pc_type sor",
    },
    "BoomerAMG": {
        "PMIS, ext+i, strong threshold 0.5": f"{HYPRE}_strong_threshold 0.5 "
        "-pc_hypre_boomeramg_agg_nl 1 -pc_hypre_boomeramg_P_max 4 "
        "-pc_hypre_boomeramg_interp_type ext+i",
        "HMIS, ext+i, strong threshold 0.7": f"{HYPRE}_strong_threshold 0.7 "
        "-pc_hypre_boomeramg_coarsen_type HMIS -pc_hypre_boomeramg_P_max 4 "
        "-pc_hypre_boomeramg_interp_type ext+i",
    },
    "direct": {
        "MUMPS": "-ksp_type preonly -pc_type cholesky -pc_factor_mat_solver_type mumps",
        "CHOLMOD": "-ksp_type preonly -pc_type cholesky -pc_factor_mat_solver_type cholmod",
    },
}
PREFIX = "linear_"
DEFAULT_RTOL = 1e-6
LOWEST = 1e-4  # of rtol: where this is not low enough the table shows the error that is left


@dataclass
class Linear:
    """A K x = b, the held components taken out of it, and what is known of it.

    Attributes:
        A: The stiffness, rows and columns of held components those of the identity.
        b: The load that is left, 0 where it is held.
        reference: The displacement, less that of the held components alone, shape ``(n,)``.
        scale: The largest displacement.
        seconds: Of assembly; that copies are joined again is the benchmark's, and not counted.
    """

    A: PETSc.Mat
    b: PETSc.Vec
    reference: np.ndarray
    scale: float
    seconds: float

    def error(self, x):
        """Largest error of a solution, in terms of the largest displacement. Collective."""
        own = np.abs(x.array_r - self.reference).max(initial=0.0)
        return float(self.A.getComm().tompi4py().allreduce(own, op=MPI.MAX) / self.scale)

    def destroy(self):
        """Destroy the PETSc objects. Collective."""
        self.A.destroy()
        self.b.destroy()


def linear_problem(scene, solution):
    """The linear problem of a scene whose contact has been solved. Collective."""
    dofs, comm = solution.dofs, solution.decomposition.comm
    forms = Forms(scene["a"], scene["L"], dofs.V, scene["decomposition"], {}, {})
    comm.barrier()
    start = time.perf_counter()
    K, f = forms.stiffness(), forms.load()
    seconds = time.perf_counter() - start
    A = untorn(K, dofs)
    b = A.createVecRight()
    load = dofs.to_primal(f).reshape(-1, dofs.bs)
    b.array[:] = dofs.reduce(load, np.add, 0.0).ravel()
    u = dofs.reduce(solution.u.reshape(-1, dofs.bs), np.maximum, -np.inf)
    prescribed = solution.gluing.prescribed
    held = prescribed.flag.copy()
    held[solution.gluing.records.group[solution.force > 0.0]] = True
    x = b.duplicate()
    x.array[:] = np.where(held, u, 0.0).ravel()
    rows = np.flatnonzero(held.ravel()) + A.getOwnershipRange()[0]
    A.zeroRowsColumns(rows.astype(PETSc.IntType), 1.0, x, b)
    b.array[held.ravel()] = 0.0
    x.destroy()
    scale = comm.allreduce(np.abs(u).max(initial=0.0), op=MPI.MAX)
    return Linear(A, b, np.where(held, 0.0, u).ravel(), scale, comm.allreduce(seconds, op=MPI.MAX))


def untorn(K, dofs):
    """The stiffness of the untorn mesh: entries of torn copies added. Collective."""
    group = np.empty(dofs.num_nodes, dtype=PETSc.IntType)
    group[dofs.dolfinx_node] = dofs.group
    index = (group[:, None] * dofs.bs + np.arange(dofs.bs, dtype=PETSc.IntType)).ravel()
    n, g = dofs.num_nodes * dofs.bs, dofs.num_groups * dofs.bs
    rows = np.arange(n + 1, dtype=PETSc.IntType)
    copies = parallel_matrix(dofs, (n, g), (rows, index, np.ones(n)))
    columns = (K.indices + dofs.offsets[dofs.comm.rank] * dofs.bs).astype(PETSc.IntType)
    torn = parallel_matrix(dofs, (n, n), (K.indptr.astype(PETSc.IntType), columns, K.data))
    A = torn.ptap(copies)
    torn.destroy()
    copies.destroy()
    A.setOption(PETSc.Mat.Option.SPD, True)
    A.setNearNullSpace(rigid_motions(A, dofs))
    return A


def parallel_matrix(dofs, local_sizes, csr):
    sizes = tuple((size, None) for size in local_sizes)
    return PETSc.Mat().createAIJ(sizes, bsize=dofs.bs, csr=csr, comm=dofs.comm)


def rigid_motions(A, dofs):
    """Rigid motions of the untorn mesh, as a near null space of its stiffness. Collective."""
    x = dofs.V.tabulate_dof_coordinates()[dofs.dolfinx_node, : dofs.bs]
    points = A.createVecRight()
    points.setBlockSize(dofs.bs)
    points.array[:] = dofs.reduce(x, np.maximum, -np.inf).ravel()
    return PETSc.NullSpace().createRigidBody(points)


def solve(linear, text, rtol):
    """Set up and solve with the settings of a text; what came of it. Collective."""
    comm, x = linear.A.getComm().tompi4py(), linear.b.duplicate()
    with solver(text, rtol) as ksp:
        ksp.setOperators(linear.A)
        comm.barrier()
        start = time.perf_counter()
        ksp.setUp()
        ready = time.perf_counter()
        ksp.solve(linear.b, x)
        end = time.perf_counter()
        found = {
            "iterations": ksp.getIterationNumber(),
            "set-up": comm.allreduce(ready - start, op=MPI.MAX),
            "solve": comm.allreduce(end - ready, op=MPI.MAX),
            "error": linear.error(x),
        }
    x.destroy()
    return found


def first_tolerance(linear, text, rtol):
    """The first of rtol, rtol/10, ... with which CG stops at an error of at most rtol. Collective.

    Looked up in the steps of one solve.
    """
    residuals, errors = [], []

    def look(ksp, _, norm):
        residuals.append(norm)
        errors.append(linear.error(ksp.buildSolution()))

    with solver(text, LOWEST * rtol) as ksp:
        if ksp.getType() == PETSc.KSP.Type.PREONLY:
            return rtol
        x = linear.b.duplicate()
        ksp.setOperators(linear.A)
        ksp.setMonitor(look)
        ksp.solve(linear.b, x)
    x.destroy()
    wrong = [norm for norm, error in zip(residuals, errors, strict=True) if error > rtol]
    tolerance = rtol
    while any(norm <= tolerance * residuals[0] for norm in wrong) and tolerance > LOWEST * rtol:
        tolerance /= 10
    return linear.A.getComm().tompi4py().bcast(tolerance)


@contextmanager
def solver(text, rtol):
    """CG, or what the text says."""
    options, words = PETSc.Options(PREFIX), text.split()
    for name, value in zip(words[::2], words[1::2], strict=True):
        options[name.removeprefix("-")] = value
    ksp = PETSc.KSP().create(MPI.COMM_WORLD)
    ksp.setOptionsPrefix(PREFIX)
    ksp.setType(PETSc.KSP.Type.CG)
    ksp.setTolerances(rtol=rtol, max_it=2000)
    ksp.setFromOptions()
    yield ksp
    ksp.destroy()
    for name in words[::2]:  # smoothers read theirs in the set-up
        options.delValue(name.removeprefix("-"))


def available(kind, setting, comm):
    """Whether PETSc has been built with what a setting needs; CHOLMOD works on one rank only."""
    if kind == "GAMG":
        return True
    package = "hypre" if kind == "BoomerAMG" else setting.lower()
    return PETSc.Sys.hasExternalPackage(package) and (setting != "CHOLMOD" or comm.size == 1)
