"""A rigid body as a Block: no stiffness, and its free motions for a kernel."""

from __future__ import annotations

from typing import Any

import numpy as np

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.subdomains.block import Block, OperatorKind


class RigidBlock(Block):
    """A rigid body. K = 0 and R = I: it adds nothing to F, and its motions to G.

    Args:
        name: Name for messages.
        load: Force on each unknown, shape ``(n,)``.
        mode: Candidate mode of a body that each unknown is, shape ``(n,)``.
        num_modes: Number of candidate modes.
    """

    def __init__(self, name: str, load: Array, mode: Array, num_modes: int) -> None:
        self.name, self.bs, n = name, 1, len(load)
        self.x = np.zeros((n, 1))
        self.trace_dofs = np.arange(n)
        self._modes = np.eye(num_modes)[mode]
        self._node_shares = np.ones(n)
        self.update(load)
        self.set_stiffness(None)

    def set_stiffness(self, K: Any) -> None:
        """Take that there is none."""
        self.kernel, self.diagonal = np.eye(len(self.load)), np.zeros(len(self.load))

    @property
    def modes(self) -> Array:
        """C, a unit vector for each free motion, 0 for others, shape ``(n, k)``."""
        return self._modes

    def multiply(self, u: Array) -> Array:
        """0."""
        return np.zeros_like(u)

    def solve(self, b: Array) -> Array:
        """0."""
        return np.zeros_like(b)

    def apply_schur(self, w: Array) -> Array:
        """0."""
        return np.zeros_like(w)

    def prepare(self, kind: OperatorKind) -> None:
        """Nothing to make."""
