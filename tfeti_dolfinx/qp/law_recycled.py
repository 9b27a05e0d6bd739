"""What earlier solves with F tell a step of Newton's method on a law of friction."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.parallel import agreed, summed
from tfeti_dolfinx.qp.gcr import Known
from tfeti_dolfinx.qp.law import OnFace
from tfeti_dolfinx.qp.recycled import RecycledOnFace, triangle

# of the largest image of a direction: what others leave of one, less would be rounding
NEW = 1e-7


def known_on(
    past: RecycledOnFace | None, on: OnFace, project: Callable[[Array], Array]
) -> Known | None:
    """What is known of Au = P(F(I + C)u + κu): of directions W N = (I + C)U of earlier solves.

    Farhat, Crivelli, Roux (``Recycled``); as Carvalho, Gratton, Lago, Vasseur, SIAM J. Sci.
    Comput. 33 (2011) 2463–2490 begin residuals. Multiplies by nothing. Collective.

    Args:
        past: Directions W; None: there are none.
        on: The face.
        project: P, of shapes ``(m, q)``.

    Returns:
        U with AU orthonormal, and FWN combined likewise; None where there is nothing.
    """
    if past is None or past.known.count == 0:
        return None
    comm, (W, FW) = past.known.comm, past.known.columns
    U = on.face.restricted(W - on.C @ W)
    N = past.known.without(W - on.followed(U))
    if N.shape[1] == 0:
        return None
    U, FU = U @ N, FW @ N
    AU = project(FU + on.bend(U))
    _, sizes, Vt = np.linalg.svd(triangle(comm, AU))
    kept = sizes > NEW * sizes[0]
    T = Vt[kept].T / sizes[kept]
    return Known((AU @ T).T, (U @ T).T, (FU @ T).T)


def keep(past: RecycledOnFace | None, x: Array, Fx: Array) -> None:
    """Keep a direction that was gone, of Gx = 0, with what F makes of it. Collective."""
    if past is None:
        return
    energy = agreed(past.known.comm, float(summed(past.known.comm, np.array([x @ Fx]))[0]))
    if energy > 0.0:
        past.known.add(x, Fx, energy)
