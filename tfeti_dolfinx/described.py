"""Parameters that say once what they are: default, range, text, symbol, name as an option."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import Field, dataclass, field, fields, is_dataclass
from typing import Any

from tfeti_dolfinx.checks import FINITE, Range

FROM_0 = Range("0 or more", lambda value: value >= 0.0)
FROM_1 = Range("1 or more", lambda value: value >= 1.0)
ABOVE_0 = Range("more than 0", lambda value: value > 0.0)


@dataclass(frozen=True)
class Description:
    """What a parameter is.

    Attributes:
        algorithm: Whose it is.
        text: What it does.
        choices: Its values, if they are few.
        fits: Range of a number.
        words: What may stand in the place of a number.
        name: Name on the command line, if it is not the field's.
        symbol: Letter in the literature and in docs/notation.md.
        kind: Type of its values, if it is not the default's.
    """

    algorithm: str
    text: str
    choices: tuple[str, ...] = ()
    fits: Range = FINITE
    words: tuple[str, ...] = ()
    name: str = ""
    symbol: str = ""
    kind: type | None = None


def described(default: Any, algorithm: str, text: str, **more: Any) -> Any:
    """A field of a dataclass of parameters.

    Args:
        default: Its default, which says its type too.
        algorithm: Whose it is.
        text: What it does.
        **more: What else ``Description`` has.
    """
    return field(default=default, metadata={"is": Description(algorithm, text, **more)})


@dataclass(frozen=True)
class Parameter:
    """A described field, found in a dataclass or in one that is part of it.

    Attributes:
        name: Name on the command line.
        default: Its default.
        description: What it is.
        path: Names of the attributes that lead to it.
    """

    name: str
    default: Any
    description: Description
    path: tuple[str, ...]

    def value_in(self, parameters: Any) -> Any:
        """Its value in an object of the dataclass."""
        for attribute in self.path:
            parameters = getattr(parameters, attribute)
        return parameters


def parameters_of(kind: type, path: tuple[str, ...] = ()) -> Iterator[Parameter]:
    """All parameters of a dataclass, those of dataclasses in it included, in their order."""
    for f in fields(kind):
        if is_dataclass(f.default):
            yield from parameters_of(type(f.default), (*path, f.name))
        else:
            about = _description(f)
            yield Parameter(about.name or f.name, f.default, about, (*path, f.name))


def made(kind: type, values: dict[str, Any]) -> Any:
    """An object of a dataclass of parameters from values by their names on the command line."""
    given: dict[str, Any] = {}
    for f in fields(kind):
        if is_dataclass(f.default):
            given[f.name] = made(type(f.default), values)
        elif (name := _description(f).name or f.name) in values:
            given[f.name] = values[name]
    return kind(**given)


def _description(f: Field[Any]) -> Description:
    description: Description = f.metadata["is"]
    return description
