"""What a generalised inverse of a stiffness is asked for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.subdomains.factor import CholeskyFactor, FactorSize


class GeneralisedInverse(Protocol):
    """K⁺ with K K⁺ K = K."""

    def solve(self, b: Array) -> Array:
        """K⁺ b, shape ``(n,)``."""
        ...

    def refactor(self, R: Array) -> None:
        """Follow new values of K in the same pattern; R is their kernel.

        Raises:
            FactorError: The factor could not be made.
        """
        ...

    def destroy(self) -> None:
        """Free the factor."""
        ...


class FactoredInverse:
    """Base of the package's own: a sparse factor, which takes several right sides at once."""

    _factor: CholeskyFactor

    def solve(self, b: Array) -> Array:
        """K⁺ b, shapes ``(n,)`` or ``(n, q)``."""
        return self._factor.solve(b)

    @property
    def size(self) -> FactorSize:
        """What the factor stores."""
        return self._factor.size

    def refactor(self, R: Array) -> None:
        """Follow new values of K in the same pattern; R is their kernel.

        Raises:
            FactorError: The factor could not be made.
        """
        raise NotImplementedError("refactor")

    def destroy(self) -> None:
        """Free the factor."""
        self._factor.destroy()


def solved(inverse: GeneralisedInverse, b: Array) -> Array:
    """K⁺ b, shapes ``(n,)`` or ``(n, q)``, by an inverse that may know single vectors only."""
    if b.ndim == 1 or isinstance(inverse, FactoredInverse):
        return inverse.solve(b)
    return np.stack([inverse.solve(column) for column in b.T], axis=1)


@contextmanager
def lent(entries: Array, places: Array, values: Array | float) -> Iterator[None]:
    """Other values at some places, in the block; the old ones come back to the last bit."""
    kept = entries[places]
    entries[places] = values
    try:
        yield
    finally:
        entries[places] = kept
