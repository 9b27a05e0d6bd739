"""The forms of K⁺ on a floating subdomain, its fixing nodes well and badly chosen.

    ./run python3 benchmarks/kplus_forms.py

A beam without any support, 4 : 1 in 2D and 4 : 1 : 1 in 3D: condition numbers of what is factored
and of the Schur complement on the fixing unknowns, and errors of K⁺. Nothing is parallel. Results
go to results/kplus_forms.md, .json and .png.
"""

from __future__ import annotations

import sys
from bisect import bisect_left

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from petsc4py import PETSc
from scipy.linalg import eigh
from scipy.sparse import csr_array

import tfeti_dolfinx as tfeti
from benchmarks.tools import column, command_line, curves, finish, picture
from tfeti_dolfinx.common.arrays import as_petsc_matrix
from tfeti_dolfinx.common.compat import assemble_csr
from tfeti_dolfinx.subdomains.block import candidate_modes, fixing_nodes, kernel_of
from tfeti_dolfinx.subdomains.factor import CholeskyFactor
from tfeti_dolfinx.subdomains.kplus import regular_matrix, regularised

ASPECT, NU = 4, 0.3
SOFTEST = 8  # deformations that K⁺ is to find


class SchurPseudoinverse(CholeskyFactor):
    """K⁺ = [K_rr⁻¹, 0; 0, 0] + E S⁺ Eᵀ, E = [−K_rr⁻¹K_rs; I], S = K_ss − K_sr K_rr⁻¹ K_rs.

    s are the fixing unknowns, r the others (Brzobohatý, Dostál, Kozubek, Kovář, Markopoulos,
    IJNME 88, 2011). E S⁺ Eᵀ is kept as H Hᵀ, n rows and |s| − r columns.
    """

    def __init__(self, K, R, s, prefix="tfeti_sub_"):
        self.s = s
        # diag(K_rr, diag K_ss)
        apart = K.tocoo()
        in_s = np.isin(np.arange(K.shape[0]), s)
        row, column = apart.coords
        values = np.where((in_s[row] | in_s[column]) & (row != column), 0.0, apart.data)
        self._H = np.zeros((K.shape[0], 0))
        super().__init__(csr_array((values, (row, column)), shape=K.shape), prefix)
        K_s = K[:, s].toarray()
        K_rs = np.array(K_s)
        K_rs[s] = 0.0
        E = -super().solve(K_rs)
        S = K_s[s] + K_rs.T @ E
        E[s] += np.eye(len(s))
        V = np.linalg.qr(R[s], mode="complete")[0][:, R.shape[1] :]
        energies, vectors = np.linalg.eigh(V.T @ S @ V)
        self._H = E @ V @ (vectors / np.sqrt(energies))

    def solve(self, b):
        """K⁺ b."""
        b_r = np.array(b)
        b_r[self.s] = 0.0
        return super().solve(b_r) + self._H @ (self._H.T @ b)


def trailing_pseudoinverse(K, R, fixing_dofs, prefix="tfeti_sub_", no_pivot=1e-4):
    """With s what elimination leaves at its first zero pivot (Farhat, Géradin, IJNME 41, 1998).

    Found by the kernel: the last unknowns of a nested dissection, as few as hold it. No motion is
    less than ``no_pivot`` of its mean size on them, which would leave a pivot of 1e-8 before them.
    """
    matrix = as_petsc_matrix(K)
    rows, columns = matrix.getOrdering(PETSc.Mat.OrderingType.ND)
    last = np.array(rows.indices[::-1], dtype=np.int64)
    for item in (rows, columns, matrix):
        item.destroy()

    def held(count):
        """Least mean size of a motion of the kernel on the last unknowns, over that on all."""
        some, every = (np.linalg.svd(X, compute_uv=False)[-1] for X in (R[last[:count]], R))
        return some / every * np.sqrt(len(R) / count)

    counts = range(R.shape[1], len(last) + 1)
    return SchurPseudoinverse(
        K, R, np.sort(last[: counts[bisect_left(counts, no_pivot, key=held)]])
    )


FORMS = {"regularized": regularised, "schur": SchurPseudoinverse, "lu_svd": trailing_pseudoinverse}


class Beam:
    """K of a floating beam of n cells across, and its nodes x, with what is exact about it.

    The kernel R, the softest deformations, orthonormal, and the condition beside the kernel.
    """

    def __init__(self, gdim, n):
        corners = [(0.0,) * gdim, (ASPECT,) + (1.0,) * (gdim - 1)]
        cells = [ASPECT * n] + [n] * (gdim - 1)
        create = dmesh.create_rectangle if gdim == 2 else dmesh.create_box
        cell = dmesh.CellType.quadrilateral if gdim == 2 else dmesh.CellType.hexahedron
        V = fem.functionspace(create(MPI.COMM_SELF, corners, cells, cell), ("Lagrange", 1, (gdim,)))
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        model = "plane_strain" if gdim == 2 else "3d"
        elastic = tfeti.Elasticity(V.mesh, E=1.0, nu=NU, model=model)
        self.K = csr_array(assemble_csr(fem.form(elastic.a(u, v))))
        self.K.sort_indices()
        self.x, self.n, self.gdim = V.tabulate_dof_coordinates()[:, :gdim], n, gdim
        self.R = kernel_of(self.K, candidate_modes(self.x, gdim, self.x.mean(axis=0), 1.0))
        values, vectors = eigh(self.K.toarray())
        r = self.R.shape[1]
        self.condition = float(values[-1] / values[r])
        self.softest = vectors[:, r : r + SOFTEST]

    def choices(self):
        """Names of choices of fixing nodes, with the nodes."""
        count, middle, h = 2**self.gdim, self.x.mean(axis=0), 1.0 / self.n
        end = np.flatnonzero(self.x[:, 0] < h / 2)
        places = {
            "spread": fixing_nodes(self.x, count),
            "spread over one end": end[fixing_nodes(self.x[end], count)],
            "a cell in the middle": self.cell(np.floor(middle / h) * h),
            "a cell in a corner": self.cell(np.zeros(self.gdim)),
        }
        return {name: np.sort(nodes) for name, nodes in places.items()}

    def cell(self, corner):
        """Nodes of the cell that begins at a corner."""
        h = 1.0 / self.n
        return np.flatnonzero(np.all(np.abs(self.x - corner - h / 2) < 0.6 * h, axis=1))

    def dofs(self, nodes):
        """Unknowns of some nodes."""
        return (nodes[:, None] * self.gdim + np.arange(self.gdim)).ravel()


def condition(A, kernel=0):
    """Largest over least eigenvalue, but for a kernel."""
    values = np.linalg.eigvalsh(A)
    return float(values[-1] / values[kernel]) if len(values) > kernel else 1.0


def schur_complement(K, s):
    """K_ss − K_sr K_rr⁻¹ K_rs, and K_rr, dense."""
    r = np.setdiff1d(np.arange(K.shape[0]), s)
    K_rs, K_rr = K[np.ix_(r, s)], K[np.ix_(r, r)]
    return K[np.ix_(s, s)] - K_rs.T @ np.linalg.solve(K_rr, K_rs), K_rr


def errors_of(pinv, beam):
    """Relative errors of K⁺: in soft deformations, from their forces, and of K K⁺ K = K."""
    K, R, u = beam.K, beam.R, beam.softest
    found = pinv.solve(extended_product(K, u))
    found -= R @ (R.T @ found)
    deformation = np.linalg.norm(found - u, axis=0).max()
    f = K @ np.random.default_rng(0).standard_normal((K.shape[0], SOFTEST))
    identity = np.linalg.norm(K @ pinv.solve(f) - f) / np.linalg.norm(f)
    return {"error of a deformation": float(deformation), "error of K K⁺ K": float(identity)}


def extended_product(K, u):
    """K u, each entry rounded once."""
    terms = K.data.astype(np.longdouble)[:, None] * u[K.indices]
    return np.add.reduceat(terms, K.indptr[:-1], axis=0).astype(float)


def row(kind, choice, beam, nodes):
    """One form with one choice of fixing nodes."""
    dofs, K, R = beam.dofs(nodes), beam.K, beam.R
    entry = {"K⁺": kind, "fixing nodes": choice}
    pinv = FORMS[kind](K, R, dofs)
    if kind == "regularized":
        factored = condition(regular_matrix(K, R, dofs).csr().toarray())
        entry |= {"unknowns": len(dofs), "condition of the factor": factored, "condition of S": "-"}
    else:
        S, K_rr = schur_complement(K.toarray(), pinv.s)
        entry |= {"unknowns": len(S), "condition of the factor": condition(K_rr)}
        entry |= {"condition of S": condition(S, R.shape[1])}
    entry |= errors_of(pinv, beam)
    return entry


def study(gdim, n):
    """All forms and choices; LU-SVD has no choice."""
    beam = Beam(gdim, n)
    rows = [
        row(kind, choice, beam, nodes)
        for choice, nodes in beam.choices().items()
        for kind in ("regularized", "schur")
    ]
    rows.append(row("lu_svd", "the last of the elimination", beam, beam.choices()["spread"]))
    title = f"{gdim}D, {beam.K.shape[0]} unknowns, condition of K {beam.condition:.3g}"
    return title, rows


def draw(path, tables):
    """Error over condition, a panel for each beam."""
    with picture(path, len(tables)) as axes:
        for panel, (title, rows) in zip(axes, tables.items(), strict=True):
            lines = {}
            for kind in FORMS:
                of = [row for row in rows if row["K⁺"] == kind]
                errors = column(of, "error of a deformation")
                lines[kind] = column(of, "condition of the factor"), errors
            curves(panel, title, ("condition of what is factored", "relative error"), lines)
            for line in panel.lines:  # other fixing nodes: no curve
                line.set_linestyle("none")


def main(argv):
    """Run the tables and write them; returns them."""
    arguments, _ = command_line(__doc__, argv)
    sizes = ((2, 2), (3, 2)) if arguments.quick else ((2, 16), (3, 4))
    tables = dict(study(gdim, n) for gdim, n in sizes)
    return finish(arguments, "kplus_forms", tables, draw)


if __name__ == "__main__":
    main(sys.argv[1:])
