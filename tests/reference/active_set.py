"""Independent solvers: untorn mesh, direct factorisation, primal active set; numpy QP."""

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from scenes import box, clamp, forms
from scipy.sparse import bmat, csr_matrix
from scipy.sparse.linalg import spsolve


class UntornElasticity:
    """The boxes of ``scenes`` on one rank, with their nodes sorted by point."""

    def __init__(self, cell, n, traction, clamped=("left",), degree=1, loaded="top", grading=1.0):
        mesh, tags, names = box(cell, n, MPI.COMM_SELF, grading)
        V, a, L = forms(mesh, tags, traction, names[loaded], degree)
        self.gdim = mesh.geometry.dim
        bcs = [clamp(V, tags.find(names[name])) for name in clamped]
        K = fem.assemble_matrix(fem.form(a), block_mode=None)
        self.K = csr_matrix(K.to_scipy())
        self.f = fem.assemble_vector(fem.form(L)).array.copy()
        fixed = [bc.dof_indices()[0] for bc in bcs]
        self.fixed = np.unique(np.concatenate([*fixed, np.empty(0, dtype=np.int32)]))
        self.free = np.setdiff1d(np.arange(len(self.f)), self.fixed)
        self.x = V.tabulate_dof_coordinates()
        bottom = fem.locate_dofs_topological(V, self.gdim - 1, tags.find(names["bottom"]))
        self.contact_nodes = bottom
        self.order = np.lexsort(np.rint(self.x.T * 1e7))

    def solve_linear(self):
        u = np.zeros(len(self.f))
        u[self.free] = spsolve(self.K[self.free][:, self.free].tocsc(), self.f[self.free])
        return self.sorted(u)

    def solve_contact(self, distance):
        """Active set on −u_last ≤ distance at the nodes of the bottom; returns u, forces."""
        N, gap = self._conditions(distance)
        u, lam = primal_active_set(
            self.K[self.free][:, self.free], self.f[self.free], N[:, self.free], gap
        )
        full = np.zeros(len(self.f))
        full[self.free] = u
        return self.sorted(full), lam

    def _conditions(self, distance):
        dofs = self.contact_nodes * self.gdim + self.gdim - 1
        keep = ~np.isin(dofs, self.fixed)
        dofs, nodes = dofs[keep], self.contact_nodes[keep]
        n = len(dofs)
        N = csr_matrix((-np.ones(n), (np.arange(n), dofs)), shape=(n, len(self.f)))
        return N, distance(self.x[nodes].T)

    def sorted(self, u):
        return u.reshape(-1, self.gdim)[self.order]


def primal_active_set(K, f, N, gap):
    """min ½uᵀKu − fᵀu, N u ≤ gap: primal-dual active set with direct solves of the KKT system."""
    active = np.zeros(len(gap), dtype=bool)
    # a row that touches without a force is left out, else rounding would flip it for ever
    touching = 1e-12 * np.abs(f).sum()
    for _ in range(100):
        A = N[active]
        KKT = bmat([[K, A.T], [A, None]], format="csc") if active.any() else K.tocsc()
        solution = spsolve(KKT, np.concatenate((f, gap[active])))
        u, lam = solution[: len(f)], np.zeros(len(gap))
        lam[active] = solution[len(f) :]
        new = lam + (N @ u - gap) * K.diagonal().max() > touching
        if np.array_equal(new, active):
            return u, lam
        active = new
    raise AssertionError("the reference active set did not settle")


def dense_qp(F, d, G, e, bounded):
    """min ½λᵀFλ − λᵀd, Gλ = e, λ ≥ 0 on bounded rows: active set with dense KKT systems."""
    free = np.ones(len(d), dtype=bool)
    for _ in range(100):
        n, r = int(free.sum()), len(e)
        KKT = np.block([[F[np.ix_(free, free)], G[:, free].T], [G[:, free], np.zeros((r, r))]])
        solution = np.linalg.lstsq(KKT, np.concatenate((d[free], e)), rcond=None)[0]
        lam = np.zeros(len(d))
        lam[free] = solution[:n]
        gradient = F @ lam - d + G.T @ solution[n:]
        new = free.copy()
        new[bounded] = lam[bounded] - gradient[bounded] > 0.0
        if np.array_equal(new, free):
            return lam
        free = new
    raise AssertionError("the reference QP did not settle")
