"""What solvers rely on, checked on any feasible set."""

from __future__ import annotations

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import require
from tfeti_dolfinx.qp.faces import Face, Status
from tfeti_dolfinx.qp.feasible_sets import FeasibleSet

# Steps along a face, relative to the radius of its curvature: one so short that what is linear in
# it stands out from what is quadratic; one that is longer, so that what is quadratic stands out
# from rounding.
SHORT, LONG = 1e-8, 1e-5
# Steps along a gradient: small sets are curved so much that only the last ones are short
SHORTER = (1e-8, 1e-10, 1e-12, 1e-14)


def check_feasible_set(feasible: FeasibleSet, size: int, seed: int = 0) -> None:
    """Check what solvers rely on, at random points of any feasible set.

    The projection is idempotent and the nearest point; a maximal step stays in the set; the
    projected gradient is how a projected step moves; the reduced free gradient is not longer
    than the free one; shifting shifts; a face has orthonormal directions, along which a point
    may move to both sides, and its curvature and its statuses are right.

    Args:
        feasible: The set; an object of any class.
        size: Number n of entries of its vectors.
        seed: Of the random points.

    Raises:
        ConformanceError: Something of that does not hold; the message says what.
    """
    rng = np.random.default_rng(seed)
    for scale in (0.1, 1.0, 10.0):
        start, other, g, shift = scale * rng.standard_normal((4, size))
        x = feasible.project(start)
        _check_projection(feasible, start, x, feasible.project(other))
        _check_gradients(feasible, x, g)
        moved = feasible.shifted(shift).project(start - shift) + shift
        require(_close(moved, x, 1e-12), "P of Ω − s is P of Ω, shifted")
        _check_face(feasible.face(x, g), size)
        t = rng.standard_normal(feasible.face(x, g).Z.shape[1])
        _check_moves(feasible, x, x - start, t)


def _close(a: Array, b: Array, share: float) -> bool:
    return bool(np.linalg.norm(a - b) <= share * (1.0 + np.linalg.norm(b)))


def _check_projection(feasible: FeasibleSet, start: Array, x: Array, y: Array) -> None:
    obtuse = (start - x) @ (y - x)  # with all points of a convex set
    size = np.linalg.norm(start - x) * np.linalg.norm(y - x)
    require(obtuse <= 1e-12 * (1.0 + size), "P(x) is the nearest point of Ω")
    require(_close(feasible.project(x), x, 1e-14), "P(P(x)) = P(x)")


def _check_gradients(feasible: FeasibleSet, x: Array, g: Array) -> None:
    phi, beta = feasible.split(x, g)
    reduced = float(feasible.reduced(x, phi, 0.5) @ phi)
    require(-1e-12 <= reduced <= phi @ phi * (1.0 + 1e-12), "0 ≤ φ̃ᵀφ ≤ φᵀφ")
    far = x - min(feasible.max_step(x, phi), 1e3) * phi
    require(_close(feasible.project(far), far, 1e-10), "x − αφ ∈ Ω for the largest step α")
    right = [_is_derivative(feasible, x, g, phi + beta, step) for step in SHORTER]
    require(any(right), "φ + β is the projected gradient")


def _is_derivative(
    feasible: FeasibleSet, x: Array, g: Array, projected: Array, step: float
) -> bool:
    """Whether a step along −g that is projected goes along −g^P."""
    apart = np.linalg.norm(feasible.project(x - step * g) - x + step * projected)
    return bool(apart <= 1e-4 * step * (1.0 + np.linalg.norm(projected)))


def _check_face(face: Face, size: int) -> None:
    """Shapes, and what each row's status says of the directions."""
    k = len(face.curvature)
    require(face.Z.shape == (size, k), "Z has a row per entry and a column per curvature")
    require(face.status.shape == (size,), "there is a status for each row")
    gram = (face.Z.T @ face.Z).toarray()
    require(np.allclose(gram, np.eye(k), atol=1e-12), "the columns of Z are orthonormal")
    require(np.all(face.curvature >= 0.0), "the curvature is 0 or more")
    free = np.asarray(face.Z.multiply(face.Z).sum(axis=1)).ravel()
    require(np.allclose(free[face.holding], 1.0), "rows that are held are free in Z")
    require(np.all(free[~face.carrying] == 0.0), "open rows are not in Z")
    require(np.isin(face.status, list(Status)).all(), "each status is one of Status")


def _check_moves(feasible: FeasibleSet, x: Array, g: Array, t: Array) -> None:
    """Moves along the face stay in the set, but for what its curvature bends them.

    Args:
        feasible: The set.
        x: A point of it.
        g: A gradient that pushes against the set there, and does nothing else.
        t: Coefficients of a move.
    """
    face = feasible.face(x, g)
    t = t * np.minimum(1.0, _radii(face, g))
    step = face.Z @ t
    for sign in (SHORT, -SHORT):
        out = np.linalg.norm(feasible.project(x + sign * step) - x - sign * step)
        stays = out <= 1e-4 * SHORT * (1.0 + np.linalg.norm(step)) + 1e-15 * np.linalg.norm(x)
        require(stays, "x + Zt stays in Ω to both sides, to first order in t")
    moved = feasible.project(x + LONG * step)
    if np.array_equal(feasible.face(moved, g).status, face.status):  # else it met a bound
        bent = g @ (moved - x - LONG * step)
        expected = 0.5 * LONG**2 * float(face.curvature @ t**2)
        rounding = 1e-14 * np.linalg.norm(g) * np.linalg.norm(x)
        right = abs(bent - expected) <= 0.01 * abs(expected) + rounding
        require(right, "gᵀx along Ω bends by ½ tᵀ diag(κ) t")


def _radii(face: Face, g: Array) -> Array:
    """Radius of curvature along each direction of a face, infinite where it is flat."""
    pushing = np.sqrt(abs(face.Z.sign()).T @ g**2)
    flat = face.curvature == 0.0
    return np.where(flat, np.inf, pushing / np.where(flat, 1.0, face.curvature))
