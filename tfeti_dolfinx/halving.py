"""Where a series of load steps is, whose steps are halved where they do not converge."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tfeti_dolfinx.checks import checked_number, shown
from tfeti_dolfinx.errors import InputError

# whole numbers of the smallest parts are exact in a double, and parts of any real step differ
MOST_HALVINGS = 30


@dataclass(frozen=True)
class Place:
    """Before a part of a step.

    Attributes:
        number: The step.
        done: What of it is done, of 2^30 parts.
        level: How often it is halved now.
    """

    number: int = 0
    done: int = 0
    level: int = 0

    @property
    def _part(self) -> int:
        return 2 ** (MOST_HALVINGS - self.level)

    def ahead(self) -> Place:
        """After a part that has converged: the next is as long as its place allows."""
        done, level = self.done + self._part, self.level
        if done == 2**MOST_HALVINGS:
            return Place(self.number + 1)
        while level and done % 2 ** (MOST_HALVINGS - level + 1) == 0:
            level -= 1
        return Place(self.number, done, level)

    def begin(self, times: Sequence[float]) -> float:
        """Where the part begins; ``times`` begins with the begin of the first step."""
        return _between(times[self.number], times[self.number + 1], self.done)

    def end(self, times: Sequence[float]) -> float:
        """Where the part ends."""
        return _between(times[self.number], times[self.number + 1], self.done + self._part)


def _between(begin: float, end: float, done: int) -> float:
    share = done / 2**MOST_HALVINGS
    return end if share == 1.0 else begin + share * (end - begin)


def checked_times(begin: float, times: Sequence[float]) -> list[float]:
    """The begin and all times, increasing.

    Raises:
        InputError: They are no such numbers.
    """
    if isinstance(times, (str, bytes)) or not np.iterable(times):
        raise InputError(f"times is {shown(times)}; expected a list of increasing numbers")
    first = checked_number(begin, "begin")
    found = [first, *(checked_number(t, f"times[{i}]") for i, t in enumerate(times))]
    if len(found) < 2:
        raise InputError("times is empty; expected at least one time")
    for i, (before, after) in enumerate(pairwise(found)):
        if not before < after or not math.isfinite(after - before):
            raise InputError(
                f"times[{i}]={after:g} is not after {before:g}; expected increasing times "
                "after begin"
            )
    return found
