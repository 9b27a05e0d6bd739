"""What a Block is made from, and what Blocks have cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tfeti_dolfinx.arrays import Array


@dataclass
class Counters:
    """What the Blocks of a rank have cost.

    Attributes:
        factorizations: Numeric factorisations.
        analyses: Symbolic ones: those of a pattern not seen before in this place.
        load_solves: Solves for K⁺f, one for each Block and load.
    """

    factorizations: int = 0
    analyses: int = 0
    load_solves: int = 0


@dataclass(frozen=True)
class SubdomainData:
    """One subdomain: n unknowns, bs at each node.

    Attributes:
        name: Name for messages.
        K: Stiffness, scipy CSR with sorted indices, shape ``(n, n)``.
        f: Load, shape ``(n,)``.
        x: Points of the nodes, shape ``(n / bs, gdim)``.
        trace_dofs: Trace unknowns, ascending, shape ``(t,)``.
        body_frame: Centre and length of the whole body, for its candidate modes.
        node_shares: 1 / number of torn copies of each node, shape ``(n / bs,)``.
        added: What the diagonal of K is to get where rows hold u at 0, shape ``(n,)``; None:
            nothing.
    """

    name: str
    K: Any
    f: Array
    x: Array
    trace_dofs: Array
    body_frame: tuple[Array, float]
    node_shares: Array
    added: Array | None = None

    @property
    def bs(self) -> int:
        """Unknowns per node."""
        return len(self.f) // max(len(self.x), 1)
