"""An independent convex solver: Clarabel's interior point method for quadratic cone programs."""

import clarabel
import numpy as np
from scipy.sparse import block_array, csc_array, csr_array, diags_array, eye_array


def solve(P, q, A, b, cones):
    """min ½xᵀPx + qᵀx subject to b − Ax in a product of cones: x, and the dual variables of A."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-13
    settings.tol_ktratio = 1e-9
    settings.max_iter = 200
    P, A = csc_array(np.triu(P) if isinstance(P, np.ndarray) else upper(P)), csc_array(A)
    found = clarabel.DefaultSolver(P, q, A, b, cones, settings).solve()
    assert str(found.status) in ("Solved", "AlmostSolved", "InsufficientProgress"), found.status
    return np.array(found.x), np.array(found.z)


def upper(P):
    P = P.tocoo()
    kept = P.coords[0] <= P.coords[1]
    return csc_array((P.data[kept], (P.coords[0][kept], P.coords[1][kept])), shape=P.shape)


def constrained_qp(F, d, G, e, bounded, pairs=(), semi_axes=()):
    """min ½λᵀFλ − λᵀd, Gλ = e, λ ≥ 0 on bounded rows, pairs of rows in ellipses.

    Args:
        F, d, G, e: The program, dense.
        bounded: Rows with λ ≥ 0.
        pairs: Rows of each ellipse or interval, shape (n, k).
        semi_axes: Its semi-axes, shape (n, k); 0 fixes a row.
    """
    norm = np.linalg.norm(F, 2)
    size = max(np.linalg.norm(d) / norm, np.linalg.norm(e), np.max(semi_axes, initial=0.0)) or 1.0
    pairs, semi_axes = np.asarray(pairs), np.asarray(semi_axes) / size
    given = F / norm, d / (norm * size), G, e / size
    return size * _scaled(*given, bounded, pairs, semi_axes)


def _scaled(F, d, G, e, bounded, pairs, semi_axes):
    """The same, of numbers of size 1."""
    unit = eye_array(len(d), format="csr")
    blocks = [csr_array(G), -unit[np.asarray(bounded, dtype=int)]]
    right = [e, np.zeros(len(bounded))]
    cones = [clarabel.ZeroConeT(len(e)), clarabel.NonnegativeConeT(len(bounded))]
    for rows, axes in zip(pairs, semi_axes, strict=True):
        moves = axes > 0.0
        blocks += [unit[rows[~moves]], csr_array((1, len(d))), -unit[rows[moves]]]
        blocks[-1] = diags_array(1.0 / axes[moves]) @ blocks[-1]
        right.append(np.concatenate((np.zeros(np.sum(~moves)), [1.0], np.zeros(np.sum(moves)))))
        cones += [
            clarabel.ZeroConeT(int(np.sum(~moves))),
            clarabel.SecondOrderConeT(1 + int(np.sum(moves))),
        ]
    A = block_array([[block] for block in blocks if block.shape[0]])
    x, z = solve(F, -d, A, np.concatenate(right), cones)
    return polished(F, d, G, e, bounded, pairs, semi_axes, x, z)


def polished(F, d, G, e, bounded, pairs, a, x, z):
    """Newton's method from there on: what is on its boundary stays, at an angle of its ellipse.

    An interior point method is right in the cost, so only to the root of that in x; where it is
    unclear what is on its boundary, the signs of the gradient decide in the next sweep.
    """
    r = len(e)
    free = np.ones(len(d), dtype=bool)
    free[bounded] = x[bounded] > z[r : r + len(bounded)]
    on = np.zeros(len(pairs), dtype=bool)
    if len(pairs):
        # a cone's dual variable that is larger than its distance from the boundary pushes
        starts = r + len(bounded) + (a.shape[1] + 1) * np.arange(len(a)) + np.sum(a == 0.0, axis=1)
        on = (z[starts] > 1.0 - level(x, pairs, a)) & np.any(a > 0.0, axis=1)
        free[pairs[a == 0.0]] = False
    for _ in range(20):
        lam, g = on_face(F, d, G, e, free, on, pairs, a, x)
        x = lam
        new, now = free.copy(), on.copy()
        new[bounded] = (lam - g)[bounded] > 0.0
        if len(pairs):
            slides = np.sum(-g[pairs] * lam[pairs], axis=1) > 0.0
            now = np.where(on, slides, level(lam, pairs, a) > 1.0)
        if np.array_equal(new, free) and np.array_equal(now, on):
            return lam
        free, on = new, now
    raise AssertionError("the reference did not settle")


def level(x, pairs, a):
    """‖x/a‖ of each point."""
    return np.linalg.norm(np.divide(x[pairs], a, out=np.zeros(a.shape), where=a > 0.0), axis=1)


def on_face(F, d, G, e, free, on, pairs, a, x):
    """The stationary point with rows that are free, and points on their ellipses; its gradient."""
    m, r, free = len(d), len(e), free.copy()
    values, mu, angle = np.where(free, x, 0.0), np.zeros(r), np.zeros(0)
    slides = np.flatnonzero(on & np.all(a > 0.0, axis=1) & (a.shape[1] == 2)) if len(pairs) else []
    if len(pairs):
        free[pairs[on]] = False
        scaled = np.divide(x[pairs], a, out=np.zeros(a.shape), where=a > 0.0)
        scaled /= np.maximum(np.linalg.norm(scaled, axis=1, keepdims=True), 1e-300)
        values[pairs[on]] = a[on] * scaled[on]
        angle = np.arctan2(scaled[slides, -1], scaled[slides, 0])
    f = np.flatnonzero(free)
    for _ in range(30):
        lam, J = values.copy(), np.zeros((m, len(f) + len(slides)))
        J[f, np.arange(len(f))] = 1.0
        bent = np.zeros(J.shape[1])
        if len(slides):
            p, axes = pairs[slides], a[slides]
            lam[p] = axes * np.stack((np.cos(angle), np.sin(angle)), axis=1)
            columns = len(f) + np.arange(len(slides))
            J[p[:, 0], columns] = -axes[:, 0] * np.sin(angle)
            J[p[:, 1], columns] = axes[:, 1] * np.cos(angle)
            bent[columns] = -np.sum((F @ lam - d + G.T @ mu)[p] * lam[p], axis=1)
        H, C = J.T @ F @ J + np.diag(bent), G @ J
        KKT = np.block([[H, C.T], [C, np.zeros((r, r))]])
        right = np.concatenate((-J.T @ (F @ lam - d), e - G @ lam))
        step = np.linalg.lstsq(KKT, right, rcond=1e-13)[0]
        values[f] += step[: len(f)]
        angle, mu = angle + step[len(f) : J.shape[1]], step[J.shape[1] :]
        if np.linalg.norm(step[: J.shape[1]]) <= 1e-13 * (1.0 + np.linalg.norm(lam)):
            break
    return lam, F @ lam - d + G.T @ mu
