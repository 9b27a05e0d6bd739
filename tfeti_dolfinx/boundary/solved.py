"""The solution of bodies with boundary elements, to be asked for what is inside."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.boundary.inside import Inside


@dataclass(frozen=True)
class SolvedBody:
    """A subdomain with boundary elements.

    Attributes:
        subdomain: Its number.
        inside: What is inside.
        nodes: Primal nodes that are not on its surface, shape ``(k,)``.
    """

    subdomain: int
    inside: Inside
    nodes: Array


@dataclass(frozen=True)
class BoundarySolution:
    """What boundary elements know of a solution.

    Attributes:
        bodies: Gives the subdomains of this rank that have them, one at a time.
        finite: Cells of this rank that have finite elements.
        cell_subdomain: Subdomain of each cell of this rank.
    """

    bodies: Callable[[], Iterable[SolvedBody]]
    finite: Array
    cell_subdomain: Array
