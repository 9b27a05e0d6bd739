"""Anderson's acceleration of a fixed point iteration x ← Φ(x) in x ≥ 0."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tfeti_dolfinx.arrays import Array

# Steps that are remembered: one, which makes it the crossed secant method. More of them mix
# values of Φ on several faces, each inexact, and took up to twice as many steps.
DEPTH = 1
# ‖Φ(x) − x‖ that has grown by more than this since its least: what is remembered misleads
GROWTH = 2.0
# of the largest singular value: directions of the memory that inexact values of Φ decide
DEPENDENT = 1e-6
# of a plain step where the iteration has gone astray
CAUTION = 0.5


class Anderson:
    """Proposes the next x from the last values of Φ.

    x⁺ = Φ_k − Σ_j γ_j (Φ_{j+1} − Φ_j), γ such that Σ_j γ_j (f_{j+1} − f_j) is nearest to f_k, with
    f = Φ(x) − x (Anderson, J. ACM 12, 1965); with one step remembered it is the crossed secant
    method. Negative entries become 0.

    Args:
        products: AᵀB of columns on this rank, added up over ranks and the same on all.
        depth: Steps that are remembered.
        growth: What ‖f‖ may grow by before all is forgotten.
    """

    def __init__(
        self,
        products: Callable[[Array, Array], Array],
        depth: int = DEPTH,
        growth: float = GROWTH,
    ) -> None:
        self._products, self._depth, self._growth = products, depth, growth
        self._known: list[tuple[Array, Array]] = []
        self._least = np.inf

    def next(self, x: Array, image: Array) -> Array:
        """The next x, given the last one and Φ(x). Collective."""
        f = image - x
        size = float(np.sqrt(self._products(f[:, None], f[:, None])[0, 0]))
        astray = size > self._growth * self._least
        self._least = size if astray else min(size, self._least)
        if astray:
            self._known.clear()
        self._known = [*self._known[-self._depth :], (f, image)]
        if astray:
            return np.asarray(x + CAUTION * f)
        return np.maximum(image - self._correction(f), 0.0)

    def _correction(self, f: Array) -> Array:
        """Σ_j γ_j (Φ_{j+1} − Φ_j)."""
        if len(self._known) == 1:
            return np.zeros_like(f)
        residuals, images = (np.stack(known, axis=1) for known in zip(*self._known, strict=True))
        df, dimage = np.diff(residuals, axis=1), np.diff(images, axis=1)
        gram = self._products(df, np.column_stack((df, f)))
        # the root of DEPENDENT's square is what a Gram matrix shows of singular values
        gamma = np.linalg.lstsq(gram[:, :-1], gram[:, -1], rcond=DEPENDENT**2)[0]
        return np.asarray(dimage @ gamma)
