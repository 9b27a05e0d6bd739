"""Whether friction and contact can hold a scene at all: a mixed-integer program that says no.

Forces within Coulomb's cones that balance the load are not enough: they also have to arise where
bodies touch. A condition either touches, or has no force. With a binary s_i for each,

    K u + Nᵀλ + Tᵀτ = f,  N u ≤ gap,  0 ≤ λ_i ≤ Λ s_i,  gap_i − (N u)_i ≤ L (1 − s_i),

and ‖τ_i‖ ≤ μ_i λ_i in the polygon around that disc. That slips go against forces is left out, so
every solution of the scene is one of the program: where the program has none, the scene has none
with forces up to Λ and gaps up to L.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp

from benchmarks.stress.reference import Untorn

SIDES = 16  # of the polygon around a disc
LARGEST = 1e4  # force of a condition, of the sum of all loads
FARTHEST = 10.0  # open gap, of the largest gap or extent of the scene
WELL = 1e10  # condition of the stiffness with motions held, scaled, up to which digits are enough
SECONDS = 60.0
INFEASIBLE = 2  # status of SciPy's milp
MOVES = 1e-12


def has_none(scene: Untorn) -> bool:
    """Whether the scene has certainly no equilibrium; False where that is not known."""
    free, c = ~scene.fixed, scene.conditions
    N, T = c.N[:, free].toarray(), c.T[:, free].toarray()
    moves = np.abs(N).sum(axis=1) > MOVES
    T = T[np.repeat(moves, len(T) // len(N))]
    f, gap = (scene.f - scene.K @ scene.values)[free], c.gap - c.N @ scene.values
    N, gap, mu, given = N[moves], gap[moves], c.coefficient[moves], c.given[moves]
    R = scene.rigid_motions()[free]
    Q = np.linalg.qr(R)[0] if R.shape[1] else R
    load = float(np.abs(f).sum())
    H = np.concatenate((N, T))
    K = scene.K[free][:, free].toarray()
    bent = _bent(K, Q, np.column_stack((H.T * load, f)))
    if bent is None or load == 0.0:
        return False
    farthest = FARTHEST * max(np.abs(gap).max(), np.ptp(scene.x, axis=0).max())
    # unknowns: λ and τ in units of the load, motions, s
    count, forces, motions = len(gap), len(H), Q.shape[1]
    size = forces + motions + count
    balance, moved, touches, pressed = (
        np.zeros((rows, size)) for rows in (motions, count, count, count)
    )
    balance[:, :forces] = Q.T @ H.T
    moved[:, :forces], moved[:, forces : forces + motions] = -N @ bent[:, :-1], N @ Q
    touches[:, forces + motions :] = np.eye(count)
    pressed[:, :count] = np.eye(count)
    room = gap - N @ bent[:, -1]
    constraints = [
        LinearConstraint(balance, Q.T @ f / load, Q.T @ f / load),
        LinearConstraint(moved, -np.inf, room),
        LinearConstraint(moved - farthest * touches, room - farthest, np.inf),
        LinearConstraint(pressed - LARGEST * touches, -np.inf, 0.0),
        *_around_discs(pressed, mu, given / load, forces),
    ]
    low, high = np.full(size, -np.inf), np.full(size, np.inf)
    low[:count], low[forces + motions :], high[forces + motions :] = 0.0, 0.0, 1.0
    integral = np.zeros(size)
    integral[forces + motions :] = 1
    found = milp(
        np.zeros(size),
        constraints=constraints,
        bounds=Bounds(low, high),
        integrality=integral,
        options={"time_limit": SECONDS},
    )
    return int(found.status) == INFEASIBLE


def _around_discs(
    pressed: np.ndarray, mu: np.ndarray, given: np.ndarray, forces: int
) -> list[LinearConstraint]:
    """τ_i·e ≤ μ_i λ_i and given bounds, along the sides' normals e."""
    count = len(mu)
    axes = forces // count - 1
    angles = np.arange(SIDES) * 2.0 * np.pi / SIDES
    normals = np.column_stack((np.cos(angles), np.sin(angles)))
    found = []
    for e in np.array([[1.0], [-1.0]]) if axes == 1 else normals:
        rows = -mu[:, None] * pressed
        for k in range(axes):
            rows[np.arange(count), count + np.arange(count) * axes + k] = e[k]
        found.append(LinearConstraint(rows, -np.inf, given))
    return found


def _bent(K: np.ndarray, Q: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """K u = b − Q Qᵀb, Qᵀu = 0, for the columns of b; None where too few digits are left."""
    n, root = len(K), 1.0 / np.sqrt(np.diag(K))
    side = root[:, None] * Q
    side /= np.linalg.norm(side, axis=0)
    zero = np.zeros((Q.shape[1],) * 2)
    A = np.block([[K * root[:, None] * root, side], [side.T, zero]])
    if np.linalg.cond(A) > WELL:
        return None
    right = np.concatenate((root[:, None] * (b - Q @ (Q.T @ b)), np.zeros((len(zero), b.shape[1]))))
    x = np.linalg.solve(A, right)
    x += np.linalg.solve(A, right - A @ x)
    u: np.ndarray = root[:, None] * x[:n]
    return u - Q @ (Q.T @ u)
