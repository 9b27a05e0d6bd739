"""The stages of a solve: their order, what depends on what, and which are out of date."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import TypeVar

from tfeti_dolfinx.errors import InputError

T = TypeVar("T")

# in the order in which they are made, with the name that their seconds have in the report
STAGES = {
    "stiffness": "assembly",
    "search": "contact",
    "rows": "gluing",
    "right side": "gluing",
    "friction": "gluing",
    "load": "assembly",
    "factors": "subdomains",
    "trace": "subdomains",
    "coarse problem": "dual",
    "linear term": "dual",
}
# what has to be made anew where something has changed
CHANGES = {
    "points": tuple(STAGES),
    "stiffness": ("stiffness", "rows", "friction", "factors", "trace", "coarse problem"),
    "rows": ("rows", "friction", "trace", "coarse problem"),
    "right side": ("right side", "linear term"),
    "friction": ("friction", "linear term"),
    "load": ("load", "linear term"),
}
# what comes with a stage
BRINGS = {"rows": "right side", "factors": "trace", "coarse problem": "linear term"}


class Stages:
    """Which stages are out of date, and which were made.

    Attributes:
        made: How often each stage was made since the counts were last taken.
    """

    def __init__(self) -> None:
        self.made: Counter[str] = Counter()
        self._stale = set(STAGES)

    def change(self, what: str) -> None:
        """Something has changed: a key of ``CHANGES``."""
        self._stale |= set(CHANGES[what])

    def is_stale(self, name: str) -> bool:
        """Whether a stage is out of date."""
        return name in self._stale

    def stale(self) -> Iterator[str]:
        """Stages that are out of date, in order; each is up to date when the next is asked for.

        Where the loop is left, as by an error, the stage that was being made stays out of date.
        """
        for name in STAGES:
            if name in self._stale:
                yield name
                self._stale -= {name, BRINGS.get(name, name)}
                self.made[name] += 1

    def forget(self) -> None:
        """All stages are out of date."""
        self._stale = set(STAGES)

    def take_counts(self) -> tuple[Counter[str], list[str]]:
        """How often each stage was made since the last call, and which were up to date."""
        made, self.made = self.made, Counter()
        new = {*made, *(BRINGS.get(name) for name in made), *self._stale}
        return made, [name for name in STAGES if name not in new]


def made(item: T | None) -> T:
    """What a stage has made."""
    if item is None:
        raise InputError("nothing has been made yet; expected a call of solve() before")
    return item
