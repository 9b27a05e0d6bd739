"""Friction on the untorn mesh by Alart's and Curnier's generalised Newton method, dense."""

from __future__ import annotations

import contextlib
import warnings

import numpy as np
from scipy.linalg import LinAlgWarning, lu_factor, lu_solve
from scipy.sparse import csr_array

from benchmarks.stress.conditions import Conditions
from benchmarks.stress.solve import UnsettledError

SETTLED = 1e-10  # last change
WRONG = 1e-8  # of what a set gives: it leaves a motion free
BROKEN = 1e-6  # of the largest force: by so much may forces leave the law
MOST = 100


def solve_sliding(
    K: csr_array, f: np.ndarray, law: Conditions
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """K u + Nᵀλ + Tᵀτ = f, λ ≥ 0, N u ≤ gap; ‖τ_i‖ ≤ given_i or coefficient_i λ_i along the slip.

    Args:
        K: Stiffness.
        f: Load.
        law: The conditions, sparse, with ``slip``.

    Returns:
        u, λ, and τ of shape ``(c, gdim - 1)``.

    Raises:
        UnsettledError: Newton's method did not settle.
    """
    n, c, gap, given, coefficient = K.shape[0], len(law.gap), law.gap, law.given, law.coefficient
    t, root = law.T.shape[0] // c, np.sqrt(K.diagonal())
    K, N, T = (np.asarray(A.todense()) / root for A in (K, law.N, law.T))
    K, f, slip = K / root[:, None], f / root, law.slip.reshape(c, t)
    own, turned = np.sum(N**2, axis=1), np.sum(T.reshape(c, -1) ** 2, axis=1)
    moves, r = own > 0.0, 1.0 / np.where(own > 0.0, own, turned)  # r: a row's own stiffness
    saddle = np.block([[K, N.T, T.T], [np.zeros((c * (1 + t), n + c * (1 + t)))]])
    idle = n + c + np.flatnonzero(~T.any(axis=1))  # slips that are 0
    x, load = np.zeros(len(saddle)), np.abs(f * root).max()
    for k in range(MOST):
        J, right = saddle.copy(), np.concatenate((f, np.zeros(c * (1 + t))))
        u, lam, tau = x[:n], x[n : n + c], x[n + c :].reshape(c, t)
        z, y = lam + r * (N @ u - gap), tau + r[:, None] * ((T @ u).reshape(c, t) + slip)
        bound = given + coefficient * np.maximum(z, 0.0)
        for i in range(c):
            rows = slice(n + c + i * t, n + c + (i + 1) * t)
            along, closed = r[i] * T[i * t : (i + 1) * t], moves[i] and (z[i] > 0.0 or k == 0)
            if closed:
                J[n + i, :n], right[n + i] = N[i], gap[i]
            else:
                J[n + i, n + i] = 1.0
            length = np.linalg.norm(y[i])
            if length < bound[i] or (k == 0 and given[i] + coefficient[i] > 0.0):
                J[rows, :n], right[rows] = along, -r[i] * slip[i]
                continue
            # τ = bound y/‖y‖, linearised
            e = y[i] / length if length > 0.0 else y[i]
            turn = bound[i] / (length or 1.0) * (np.eye(t) - np.outer(e, e))
            J[rows, rows] = np.eye(t) - turn
            J[rows, :n] -= turn @ along
            right[rows] = bound[i] * e + turn @ (r[i] * slip[i])
            if closed:
                J[rows, n + i] -= coefficient[i] * e
                J[rows, :n] -= coefficient[i] * r[i] * np.outer(e, N[i])
                right[rows] -= coefficient[i] * (z[i] + r[i] * gap[i]) * e
        J[idle], right[idle] = np.eye(len(J))[idle], 0.0
        new = _solved(J, right)
        change, x, off = np.abs(new - x), new, np.abs(J @ new - right)
        parts = slice(0, n), slice(n, len(x))
        largest = np.abs(x[:n]).max(), max(np.abs(x[n:]).max(), load)
        settled = [
            change[p].max() <= SETTLED * size for p, size in zip(parts, largest, strict=True)
        ]
        if all(settled) and off[:n].max() <= WRONG * np.abs(f).max():
            u, lam, tau = x[:n], x[n : n + c], x[n + c :].reshape(c, t)
            bound = given + coefficient * np.maximum(lam, 0.0)
            beyond = np.maximum(np.linalg.norm(tau, axis=1) - bound, -lam).max(initial=0.0)
            if beyond <= BROKEN * largest[1]:
                return u / root, lam, tau
            break
    raise UnsettledError("friction did not settle")


def _solved(J: np.ndarray, right: np.ndarray) -> np.ndarray:
    """By elimination and a correction, or by least squares where a set leaves a motion free."""
    singular = np.linalg.LinAlgError, LinAlgWarning, ValueError  # the last: infinite
    with contextlib.suppress(*singular), warnings.catch_warnings():
        warnings.simplefilter("error", LinAlgWarning)
        factor = lu_factor(J)
        new = lu_solve(factor, right)
        new += lu_solve(factor, right - J @ new)
        if (
            np.all(np.isfinite(new))
            and np.abs(J @ new - right).max() <= WRONG * np.abs(right).max()
        ):
            return new
    return np.linalg.lstsq(J, right)[0]
