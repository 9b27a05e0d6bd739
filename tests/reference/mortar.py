"""Two boxes of rectangles by an untorn mesh, mortar integrals in closed form, active set."""

from itertools import pairwise

import numpy as np
import ufl
from bodies import boxes
from dolfinx import fem
from mpi4py import MPI
from scenes import hooke, strain
from scipy.sparse import csr_matrix

from reference.active_set import primal_active_set


def mortar_1d(secondary, primary):
    """Integrals ∫φ_i and ∫ψ_i φ_j of two meshes of the same interval, segment by segment."""
    D, M = np.zeros(len(secondary)), np.zeros((len(secondary), len(primary)))
    cuts = np.unique(np.concatenate((secondary, primary)).round(12))
    gauss, weight = np.polynomial.legendre.leggauss(3)
    for a, b in pairwise(cuts):
        for y, w in zip((a + b) / 2 + (b - a) / 2 * gauss, (b - a) / 2 * weight, strict=True):
            i = np.searchsorted(secondary, y) - 1
            j = np.searchsorted(primary, y) - 1
            t = (y - secondary[i]) / (secondary[i + 1] - secondary[i])
            s = (y - primary[j]) / (primary[j + 1] - primary[j])
            for k, psi, phi in ((i, 2 - 3 * t, 1 - t), (i + 1, 3 * t - 1, t)):
                D[k] += w * phi
                M[k, j] += w * psi * (1 - s)
                M[k, j + 1] += w * psi * s
    return D, M


class TwoBoxes:
    """The lever of ``test_mortar`` on one rank: [0, 1]^d−1 × [−1, 0] below [0, 1]^d."""

    def __init__(self, cell, n_lower, n_upper, push, pull, secondary="upper"):
        gdim = 2 if cell == "quadrilateral" else 3
        self.gdim = gdim
        flat = (0.0,) * (gdim - 1), (1.0,) * (gdim - 1)
        parts = [
            ("lower", flat[0] + (-1.0,), flat[1] + (0.0,), (n_lower,) * gdim),
            ("upper", flat[0] + (0.0,), flat[1] + (1.0,), (n_upper,) * gdim),
        ]
        mesh, tags, names = boxes(cell, parts, MPI.COMM_SELF)
        V = fem.functionspace(mesh, ("Lagrange", 1, (gdim,)))
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        degree = {"quadrature_degree": 2}
        dx = ufl.Measure("dx", domain=mesh, metadata=degree)
        ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags, metadata=degree)
        x = ufl.SpatialCoordinate(mesh)
        a = ufl.inner(hooke()(u), strain(v)) * dx
        L = (pull - (pull + push) * x[0]) * v[gdim - 1] * ds(names["upper top"])
        self.K = csr_matrix(fem.assemble_matrix(fem.form(a), block_mode=None).to_scipy())
        self.f = fem.assemble_vector(fem.form(L)).array.copy()

        def nodes(side):
            return fem.locate_dofs_topological(V, gdim - 1, tags.find(names[side]))

        self.x = V.tabulate_dof_coordinates()
        fixed = np.concatenate((nodes("lower bottom"), nodes("upper left")))
        self.fixed = np.unique(fixed[:, None] * gdim + np.arange(gdim))
        self.secondary = self._sorted(nodes("upper bottom"))
        self.primary = self._sorted(nodes("lower top"))
        self.n, self.down = (n_upper, n_lower), 1.0
        if secondary == "lower":
            self.secondary, self.primary = self.primary, self.secondary
            self.n, self.down = (n_lower, n_upper), -1.0

    def _sorted(self, nodes):
        return nodes[np.lexsort(np.rint(self.x[nodes].T * 1e7))]

    def solve(self):
        """Points and displacement of all nodes, points and forces of the secondary nodes."""
        D, M = mortar_1d(*(np.linspace(0, 1, n + 1) for n in self.n))
        if self.gdim == 3:  # nodes sorted by y, then x
            D, M = np.kron(D, D), np.kron(M, M)
        N = np.zeros((len(D), self.K.shape[0]))
        last = self.gdim - 1
        N[np.arange(len(D)), self.secondary * self.gdim + last] = -self.down * D
        N[:, self.primary * self.gdim + last] += self.down * M
        free = np.setdiff1d(np.arange(self.K.shape[0]), self.fixed)
        held = np.abs(N[:, free]).sum(axis=1) > 0
        rows = np.flatnonzero(held)
        scale = np.linalg.norm(N[rows], axis=1)
        u, force = primal_active_set(
            self.K[free][:, free],
            self.f[free],
            csr_matrix(N[rows][:, free] / scale[:, None]),
            np.zeros(len(rows)),
        )
        full, lam = np.zeros(self.K.shape[0]), np.zeros(len(D))
        full[free], lam[rows] = u, force / scale * D[rows]
        order = np.lexsort(np.rint(self.x.T * 1e7))
        u = full.reshape(-1, self.gdim)[order]
        return self.x[order], u, self.x[self.secondary], lam
