"""A small dense quadratic program: an interior point to find the active set, then that set."""

from __future__ import annotations

import numpy as np

UNFELT = 1e-11
ROUNDING = 1e-9  # of the largest: values below have no sign


class UnsettledError(Exception):
    """The reference itself found no solution to its accuracy."""


def solve_qp(
    F: np.ndarray, d: np.ndarray, G: np.ndarray, e: np.ndarray, active: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """min ½λᵀFλ − dᵀλ, Gλ = e, λ ≥ 0, which has a solution.

    Args:
        F: Positive definite on the null space of G, positive diagonal.
        d: Shape ``(m,)``.
        G: Shape ``(r, m)``.
        e: Shape ``(r,)``.
        active: A first guess of what carries force, instead of an interior point's.

    Returns:
        λ, and α with s = Fλ − d − Gᵀα ≥ 0.

    Raises:
        UnsettledError: The active set did not settle.
    """
    scale = np.sqrt(np.diag(F))
    F, d, G = F / np.outer(scale, scale), d / scale, G / scale
    # what no row feels is left out
    U, sigma, Vt = np.linalg.svd(G, full_matrices=False)
    felt = sigma > UNFELT * sigma.max(initial=0.0)
    U, sigma, G = U[:, felt], sigma[felt], Vt[felt]
    if np.linalg.norm(e - U @ (U.T @ e)) > 1e-8 * np.linalg.norm(e):
        raise UnsettledError("Gλ = e has no solution")
    e = U.T @ e / sigma
    if active is None:
        active = interior_point(F, d, G, e)
    lam, alpha = settle(F, d, G, e, active)
    return lam / scale, U @ (alpha / sigma)


def interior_point(F: np.ndarray, d: np.ndarray, G: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Where λ > s at the end of Mehrotra's predictor and corrector (SIAM J. Optim. 2, 1992)."""
    m, r = len(d), len(e)
    size = max(np.abs(d).max(initial=0.0), np.abs(e).max(initial=0.0), 1e-300)
    d, e = d / size, e / size
    lam, s, alpha = np.ones(m), np.ones(m), np.zeros(r)
    regular = 1e-14 * np.eye(r)
    for _ in range(120):
        dual, primal = F @ lam - d - G.T @ alpha - s, G @ lam - e
        mean = lam @ s / m
        if mean < 1e-22:
            break
        H = np.linalg.inv(F + np.diag(s / lam))
        schur = G @ H @ G.T + regular

        def step(target: np.ndarray) -> tuple[np.ndarray, ...]:
            right = -dual - s + target / lam  # noqa: B023
            da = np.linalg.lstsq(schur, -primal - G @ (H @ right), rcond=None)[0]  # noqa: B023
            dl = H @ (right + G.T @ da)  # noqa: B023
            return dl, da, target / lam - s - s / lam * dl  # noqa: B023

        dl, _, ds = step(np.zeros(m))
        length = min(_longest(lam, dl), _longest(s, ds))
        ahead = (lam + length * dl) @ (s + length * ds) / m
        dl, da, ds = step(mean * (ahead / mean) ** 3 - dl * ds)
        length = 0.995 * min(_longest(lam, dl), _longest(s, ds))
        if not np.isfinite(length) or length < 1e-12:
            break
        lam, alpha, s = lam + length * dl, alpha + length * da, s + length * ds
    return lam > s


def _longest(x: np.ndarray, dx: np.ndarray) -> float:
    falling = dx < 0.0
    return float(min(1.0, (-x[falling] / dx[falling]).min(initial=1.0)))


def settle(
    F: np.ndarray, d: np.ndarray, G: np.ndarray, e: np.ndarray, active: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Primal-dual active set from a guess, each set by a dense saddle point system."""
    r, seen = len(e), set()
    size = max(np.abs(e).max(initial=0.0), np.abs(d).max(initial=0.0))
    for _ in range(60):
        n = int(active.sum())
        A, B = F[np.ix_(active, active)], G[:, active]
        saddle = np.block([[A, -B.T], [B, np.zeros((r, r))]])
        right = np.concatenate((d[active], e))
        x = np.linalg.lstsq(saddle, right, rcond=1e-13)[0]
        x += np.linalg.lstsq(saddle, right - saddle @ x, rcond=1e-13)[0]
        lam = np.zeros(len(d))
        lam[active], alpha = x[:n], x[n:]
        s = F @ lam - d - G.T @ alpha
        s[active] = 0.0
        balance = np.abs(G @ lam - e).max(initial=0.0)
        noise = ROUNDING * max(np.abs(lam).max(initial=0.0), 1e-12 * size)
        wrong = (active & (lam < -noise)) | (~active & (s < -noise))
        if not wrong.any():
            largest = max(np.abs(e).max(initial=0.0), np.abs(lam).max(initial=0.0))
            if balance > 1e-8 * max(largest, 1e-12 * size):
                raise UnsettledError(f"Gλ = e is off by {balance:.1e}")
            return lam, alpha
        if active.tobytes() in seen:  # a cycle: one at a time
            worst = np.argmax(np.where(wrong, np.maximum(-lam, -s), -np.inf))
            wrong = np.arange(len(d)) == worst
        seen.add(active.tobytes())
        active = active ^ wrong
    raise UnsettledError("the active set did not settle")
