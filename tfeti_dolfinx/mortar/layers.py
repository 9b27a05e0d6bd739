"""Which of several primary facets over one secondary facet it can meet."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tfeti_dolfinx.arrays import Array

# of a facet's size: distances closer than this are those of facets of one layer, apart by rounding
SAME = 1e-9
# of a facet: common parts that exceed it by less are one layer, whose clipping has rounded
COVERED_TWICE = 1e-6

# for pairs a and b of the same secondary facet: whether b's primary facet lies over the middle of
# a's common part, and its distance there
Look = Callable[[Array, Array], tuple[Array, Array]]


def truly_overlapping(s: Array, distance: Array, facing: Array, length: Array, look: Look) -> Array:
    """Facing pairs whose overlap is real: no way out of the primary body lies before them.

    An overlap means that the primary body reaches from its facet, behind the secondary one, up to
    that. If it ends before, at a facet that looks the same way as the secondary one, the pair is
    one of two faces that look away from each other through thin bodies.

    Args:
        s: Secondary facet of each pair, shape ``(n,)``.
        distance: Distance along the secondary facet's normal.
        facing: Whether the facets face each other.
        length: Size of every secondary facet.
        look: The way to look at one pair's place along another.

    Returns:
        Flags, shape ``(n,)``.
    """
    found, same = facing.copy(), SAME * length[s]
    behind = distance < -same
    within, out = np.flatnonzero(facing & behind), np.flatnonzero(~facing & behind)
    a, b = pairs_over_one_facet(s, within, out)
    over, there = look(a, b)
    found[a[over & (distance[a] < there) & (there < -same[a])]] = False
    return found


def nearest(
    s: Array, distance: Array, length: Array, size: Array, whole: Array, look: Look
) -> Array:
    """Pairs with no other primary facet before theirs.

    Args:
        s: Secondary facet of each pair, shape ``(n,)``.
        distance: Distance along the secondary facet's normal.
        length: Size of every secondary facet.
        size: Length or area of the common part.
        whole: Length or area of every secondary facet.
        look: The way to look at one pair's place along another.

    Returns:
        Flags, shape ``(n,)``.
    """
    found = np.ones(len(s), dtype=bool)
    covered = np.bincount(s, size, minlength=len(whole))
    several = np.flatnonzero((covered > (1.0 + COVERED_TWICE) * whole)[s])
    a, b = pairs_over_one_facet(s, several, several)
    over, there = look(a, b)
    found[a[(a != b) & over & (there < distance[a] - SAME * length[s[a]])]] = False
    return found


def pairs_over_one_facet(s: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """All (a, b), a of ``first`` and b of ``second``, with the same secondary facet."""
    ordered = second[np.argsort(s[second], kind="stable")]
    start = np.searchsorted(s[ordered], s[first], side="left")
    count = np.searchsorted(s[ordered], s[first], side="right") - start
    offset = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return np.repeat(first, count), ordered[np.repeat(start, count) + offset]
