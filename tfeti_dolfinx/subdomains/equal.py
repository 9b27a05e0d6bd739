"""Subdomains that are equal but for a translation share their stiffness and its factors."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.subdomains.kplus import Making, same_pattern
from tfeti_dolfinx.subdomains.stiffness import Stiffness

# Of the size of a subdomain: nodes nearer than that have the same place. Which nodes are meant
# is all that it decides, so it is far below a cell and far above rounding of coordinates; the
# root keeps places of regular grids, which are rational, off the middle between two roundings.
PLACE = 1e-7 * np.sqrt(2.0)
# Of the largest entry: rounding of a stiffness of cells of size h at x is 1e-16 x / h, and a
# modulus that differs by more is another one.
SAME = 1e-12


class EqualSubdomains:
    """The stiffnesses of a rank, each held once.

    Args:
        how: How inverses are made.
    """

    def __init__(self, how: Making) -> None:
        self._how = how
        self._of_shape: dict[bytes, list[tuple[Stiffness, Array]]] = defaultdict(list)

    def find(self, name: str, x: Array, K: Any, own: Stiffness | None) -> tuple[Stiffness, Array]:
        """The stiffness that is equal to K, or a new one; and the unknown in it of each of K's.

        Args:
            name: Name for messages.
            x: Points of the nodes.
            K: scipy CSR with sorted indices; not needed any more after it where one is equal.
            own: What takes K if none is equal, since nobody else uses it.

        Raises:
            InputError: K does not fit.
            FactorError: A factor could not be made.
        """
        shape, order = _shape_and_order(x, K.shape[0] // len(x))
        known = self._of_shape[shape] = [
            item for item in self._of_shape[shape] if item[0].users > 0 or item[0] is own
        ]
        for stiffness, its_order in known:
            here = np.empty_like(order)
            here[order] = its_order
            if stiffness is not own and _equal(K, stiffness, here):
                return stiffness, here
        if own is not None:
            own.replace(K)
            return own, np.arange(len(order), dtype=order.dtype)
        made = Stiffness(name, x, K, self._how)
        known.append((made, order))
        return made, np.arange(len(order), dtype=order.dtype)


def places_in_order(x: Array) -> tuple[bytes, Array]:
    """The places of the nodes beside the lowest corner in their order, and this order."""
    corner = x.min(axis=0)
    size = float((x.max(axis=0) - corner).max()) or 1.0
    places = np.rint((x - corner) / (PLACE * size)).astype(np.int64)
    nodes = np.lexsort(places.T)
    return places[nodes].tobytes(), nodes


def _shape_and_order(x: Array, bs: int) -> tuple[bytes, Array]:
    """The places of the nodes, and the unknowns in their order."""
    places, nodes = places_in_order(x)
    # sizes that differ show in K; as a part of the key they would have to be rounded
    order = (nodes[:, None] * bs + np.arange(bs)).ravel().astype(np.int32)
    return bytes([bs]) + places, order


def _equal(K: Any, other: Stiffness, here: Array) -> bool:
    """Whether K is the other stiffness, its unknown i being the other's ``here[i]``."""
    allowed = SAME * np.abs(other.K.data).max(initial=0.0)
    in_order = np.array_equal(here, np.arange(len(here)))
    if in_order and same_pattern(K, other.K):
        return bool(np.abs(K.data - other.K.data).max(initial=0.0) <= allowed)
    # the diagonals tell most of those apart that are not
    if not np.abs(K.diagonal() - other.diagonal[here]).max(initial=0.0) <= allowed:
        return False
    there = np.argsort(here).astype(here.dtype)
    moved = K[there]
    moved = csr_array((moved.data, here[moved.indices], moved.indptr), shape=K.shape)
    return bool(np.abs((moved - other.K).data).max(initial=0.0) <= allowed)
