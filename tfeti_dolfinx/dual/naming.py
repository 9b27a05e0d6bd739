"""Words for motions of bodies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.linalg import qr
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.bodies import Bodies
from tfeti_dolfinx.dual.motions import NULL, Motions
from tfeti_dolfinx.dual.sparse_columns import parts_of_columns

# Of the largest coefficient: a body that moves by less than this takes no part in a motion, which
# is known to rounding only; and a motion is named after modes of this share or more, which leaves
# out what a rotation about another centre mixes in.
TAKES_PART, DOMINANT = 1e-3, 0.3
# bodies that a sentence names; of more it tells how many
NAMED = 4


def free_to_move(amounts: Array, body_names: Sequence[str], mode_names: Sequence[str]) -> str:
    """A sentence about a motion.

    Args:
        amounts: How much of each mode is in it, shape ``(bodies, k)``.
        body_names: Names of the bodies.
        mode_names: Names of their modes.
    """
    moving, modes = _parts(amounts, mode_names)
    if len(moving) == 1:
        return f"{body_names[moving[0]]} is free to move ({modes})"
    names = ", ".join(body_names[b] for b in moving[:NAMED])
    more = f" and {len(moving) - NAMED} more" if len(moving) > NAMED else ""
    return f"{names}{more} are free to move together ({modes})"


def _parts(amounts: Array, mode_names: Sequence[str]) -> tuple[Array, str]:
    """The bodies that take part in a motion, and what it is mostly."""
    parts = np.abs(amounts)
    moving = np.flatnonzero(parts.max(axis=1) > TAKES_PART * parts.max())
    share = parts[moving].max(axis=0)
    modes = " and ".join(mode_names[m] for m in np.flatnonzero(share > DOMINANT * share.max()))
    return moving, modes


def parts_of_motions(
    motions: csr_array, bodies: Bodies, body_names: Sequence[str], mode_names: Sequence[str]
) -> Iterator[tuple[list[str], str]]:
    """Names of the bodies that take part in each column, and what it is mostly."""
    for motion in motions.toarray().T:
        moving, mode = _parts(bodies.amounts(motion), mode_names)
        yield [body_names[b] for b in moving[:NAMED]], mode


def listed(
    motions: Motions, bodies: Bodies, body_names: Sequence[str], mode_names: Sequence[str]
) -> list[dict[str, object]]:
    """A list of motions: ``bodies``, ``mode`` and the ``stiffness`` that holds them, 0 for none.

    Of several free motions of one body any combination is one, too; they are named after the
    modes that span them best.
    """
    found: list[dict[str, object]] = []
    for body in np.flatnonzero(motions.free.any(axis=1)):
        vectors = bodies.frames[body] @ motions.single[body]
        own, stiffness = motions.free[body], motions.stiffness[body]
        loose = own & (stiffness <= NULL)
        for mode in _spanning(vectors[:, loose], mode_names):
            found.append({"bodies": [body_names[body]], "mode": mode, "stiffness": 0.0})
        for j in np.flatnonzero(own & ~loose):
            _, mode = _parts(vectors[:, j][None, :], mode_names)
            held = float(stiffness[j])
            found.append({"bodies": [body_names[body]], "mode": mode, "stiffness": held})
    for _, rows, joint in parts_of_columns(motions.joint):
        moving, place = np.unique(rows // bodies.k, return_inverse=True)
        for motion in _plain(joint).T:
            coefficients = np.zeros((len(moving), bodies.k))
            coefficients[place, rows % bodies.k] = motion
            amounts = np.einsum("bij,bj->bi", bodies.frames[moving], coefficients)
            parts, mode = _parts(amounts, mode_names)
            names = [body_names[b] for b in moving[parts]]
            found.append({"bodies": names, "mode": mode, "stiffness": 0.0})
    return found


def _plain(joint: Array) -> Array:
    """Motions that span the same, each with a coordinate that the others leave alone."""
    rows = qr(joint.T, pivoting=True, mode="r")[1][: joint.shape[1]]
    return np.asarray(joint @ np.linalg.inv(joint[np.sort(rows)]))


def _spanning(vectors: Array, mode_names: Sequence[str]) -> list[str]:
    """Names of as many motions as there are columns."""
    count = vectors.shape[1]
    if count == 1:
        return [_parts(vectors.T, mode_names)[1]]
    if count == 0:
        return []
    return [mode_names[m] for m in sorted(qr(vectors.T, pivoting=True, mode="r")[1][:count])]
