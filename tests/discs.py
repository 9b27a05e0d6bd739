"""Discs in pairs of rows: friction with given bounds, a feasible set that is not the package's."""

import numpy as np
from scipy.sparse import coo_array, csr_array

from tfeti_dolfinx.qp.faces import Face, Status


class Discs:
    """‖(x_2i, x_2i+1) − centre_i‖ ≤ r_i."""

    def __init__(self, radius, centre=0.0):
        self.radius, self.centre = np.asarray(radius, dtype=float), centre

    def _polar(self, x):
        """Pairs from their centres, outward normals, and flags of those on their circle."""
        t = x.reshape(-1, 2) - self.centre
        size = np.linalg.norm(t, axis=1)
        return t, t / np.maximum(size, 1e-300)[:, None], size >= self.radius * (1 - 1e-10)

    def project(self, x):
        t, n, _ = self._polar(x)
        outside = np.sum(t * n, axis=1) > self.radius
        return (self.centre + np.where(outside[:, None], self.radius[:, None] * n, t)).ravel()

    def split(self, x, g):
        _, n, on = self._polar(x)
        pairs = g.reshape(-1, 2)
        inward = pairs - np.minimum(np.sum(pairs * n, axis=1), 0.0)[:, None] * n
        inward[self.radius == 0.0] = 0.0
        phi, beta = np.where(on[:, None], 0.0, pairs), np.where(on[:, None], inward, 0.0)
        return phi.ravel(), beta.ravel()

    def reduced(self, x, phi, alpha):
        return (x - self.project(x - alpha * phi)) / alpha

    def max_step(self, x, p):
        t, _, _ = self._polar(x)
        p = p.reshape(-1, 2)
        a, b = np.sum(p * p, axis=1), np.sum(p * t, axis=1)
        room = np.maximum(self.radius**2 - np.sum(t * t, axis=1), 0.0)
        moves = a > 0.0
        steps = (b + np.sqrt(b * b + a * room))[moves] / a[moves]
        return float(np.min(steps, initial=np.inf))

    def shifted(self, shift):
        return Discs(self.radius, self.centre - shift.reshape(-1, 2))

    def face(self, x, g):
        _, n, on = self._polar(x)
        slip, stick = np.flatnonzero(on & (self.radius > 0.0)), np.flatnonzero(~on)
        k, inner = len(slip), np.concatenate((2 * stick, 2 * stick + 1))
        rows = np.concatenate((inner, 2 * slip, 2 * slip + 1))
        around = len(inner) + np.arange(k)
        columns = np.concatenate((np.arange(len(inner)), around, around))
        values = np.concatenate((np.ones(len(inner)), -n[slip, 1], n[slip, 0]))
        Z = csr_array(coo_array((values, (rows, columns)), shape=(len(x), len(inner) + k)))
        outward = np.maximum(-np.sum(g.reshape(-1, 2) * n, axis=1), 0.0)[slip]
        status = np.where(on, np.where(self.radius > 0.0, Status.SLIP, Status.OPEN), Status.STICK)
        curvature = np.concatenate((np.zeros(len(inner)), outward / self.radius[slip]))
        return Face(Z, curvature, np.repeat(status, 2))
