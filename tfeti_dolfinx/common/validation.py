"""Checks of what is given, and parameters that say once what they are."""

import math
import reprlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from numbers import Integral, Real
from typing import Any, TypeGuard

import numpy as np

from tfeti_dolfinx.common.arrays import Array, LocalMatrix
from tfeti_dolfinx.errors import InputError, TfetiError

# --- Checks of values, types and callables ----------------------------------------------------


@dataclass(frozen=True)
class Range:
    """Range of numbers, with the words that a message describes it by."""

    text: str
    holds: Callable[[float], bool]


FINITE = Range("a finite number", lambda value: True)
POSITIVE = Range("a positive number", lambda value: value > 0.0)


def shown(value: Any) -> str:
    """Return a value for a message: short, and of objects their type only."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, str, Real, list, tuple, dict)):
        return reprlib.repr(value)
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    if isinstance(value, type):
        return f"the class {value.__qualname__}"
    return f"a {type(value).__qualname__}"


def is_whole(value: Any) -> TypeGuard[int]:
    """Return whether a value is an integer, numpy's included; True and False are none."""
    return isinstance(value, Integral) and not isinstance(value, (bool, np.bool_))


def checked_number(value: Any, what: str, expected: Range = FINITE) -> float:
    """Return a finite number in a range; numpy's scalars are numbers, booleans and texts are none.

    Raise an InputError ``<what>=<value>: expected <range>`` where it is not.
    """
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    number = isinstance(value, Real) and not isinstance(value, (bool, np.bool_))
    if not number or not math.isfinite(value) or not expected.holds(float(value)):
        raise InputError(f"{what}={shown(value)}: expected {expected.text}")
    return float(value)


def real_numbers(values: Any) -> Array:
    """Convert what a user's function has returned to floats; drop no imaginary part.

    Raise a TypeError where they are no real numbers, a ValueError where they are texts.
    """
    array = np.asarray(values)
    if np.iscomplexobj(array):
        raise TypeError("complex numbers; expected real ones")
    return np.asarray(array, dtype=float)


def checked_vector(values: Any, what: str, sizes: Sequence[int], expected: str) -> Array:
    """Return finite numbers, as many as one of the sizes; a number is one of them.

    Raise ``InputError: <what>=<values>: expected <expected>`` where they are not.
    """
    try:
        vector = np.atleast_1d(real_numbers(values))
    except (TypeError, ValueError):
        vector = np.empty((0, 0))
    if vector.ndim != 1 or len(vector) not in sizes or not np.all(np.isfinite(vector)):
        raise InputError(f"{what}={shown(values)}: expected {expected}")
    return vector


def checked_flag(value: Any, what: str) -> bool:
    """Return a boolean, or numpy's, as a boolean; raise an InputError for anything else."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"{what}={shown(value)}: expected True or False")
    return bool(value)


def checked_type(value: Any, kinds: type | tuple[type, ...], what: str, expected: str) -> None:
    """Raise ``InputError: <what> is <value>; expected <expected>`` unless a value is of a type."""
    if not isinstance(value, kinds):
        raise InputError(f"{what} is {shown(value)}; expected {expected}")


def checked_callable(value: Any, what: str, expected: str) -> None:
    """Raise an InputError unless a value can be called."""
    if not callable(value):
        raise InputError(f"{what} is {shown(value)}; expected {expected}")


@contextmanager
def named(what: str, *kinds: type[Exception]) -> Iterator[None]:
    """Name what failed: errors of the given kinds (default all) become an InputError.

    Not collective; errors of this package stay as they are. The message begins with ``what``.
    """
    try:
        yield
    except TfetiError:
        raise
    except Exception as error:
        if kinds and not isinstance(error, kinds):
            raise
        raise InputError(f"{what}: {type(error).__name__}: {error}") from error


def values_at(
    function: Callable[[Array], Any], x: Array, size: tuple[int, ...], what: str
) -> Array:
    """Return what a user's function gives at points, real numbers of a shape. Not collective.

    Raise an InputError, ``<what> points of shape ...``, where it fails or gives another shape.
    """
    what = f"{what} points of shape {x.shape}"
    with named(what):
        values = real_numbers(function(x))
    try:
        return np.broadcast_to(values, size)
    except ValueError:
        raise InputError(f"{what} has the shape {values.shape}; expected {size}") from None


# --- Descriptions of parameters ---------------------------------------------------------------

FROM_0 = Range("0 or more", lambda value: value >= 0.0)
FROM_1 = Range("1 or more", lambda value: value >= 1.0)
ABOVE_0 = Range("more than 0", lambda value: value > 0.0)


@dataclass(frozen=True)
class Description:
    """Description of a parameter."""

    algorithm: str  # whose it is
    text: str  # what it does
    choices: tuple[str, ...] = ()  # its values, if they are few
    fits: Range = FINITE  # range of a number
    words: tuple[str, ...] = ()  # what may stand in the place of a number
    name: str = ""  # name on the command line, if it is not the field's
    symbol: str = ""  # letter in the literature and in docs/notation.md
    kind: type | None = None  # type of its values, if it is not the default's


def described(default: Any, algorithm: str, text: str, **more: Any) -> Any:
    """Return a field of a dataclass of parameters, with its ``Description``."""
    return field(default=default, metadata={"is": Description(algorithm, text, **more)})


@dataclass(frozen=True)
class Parameter:
    """A described field, found in a dataclass or in one that is part of it."""

    name: str  # name on the command line
    default: Any  # its default
    description: Description  # what it is
    path: tuple[str, ...]  # names of the attributes that lead to it


def parameters_of(kind: type, path: tuple[str, ...] = ()) -> Iterator[Parameter]:
    """All described parameters of a dataclass, those of dataclasses in it included, in order."""
    for f in fields(kind):
        if is_dataclass(f.default):
            yield from parameters_of(type(f.default), (*path, f.name))
        elif "is" in f.metadata:
            about: Description = f.metadata["is"]
            yield Parameter(about.name or f.name, f.default, about, (*path, f.name))


def from_names(kind: type, values: dict[str, Any]) -> Any:
    """An object of a dataclass of parameters from values by their names on the command line."""
    given: dict[str, Any] = {}
    for f in fields(kind):
        if is_dataclass(f.default):
            given[f.name] = from_names(type(f.default), values)
        elif "is" in f.metadata and (name := f.metadata["is"].name or f.name) in values:
            given[f.name] = values[name]
    return kind(**given)


# --- Checks of a subdomain's stiffness --------------------------------------------------------


def check_stiffness(
    name: str,
    K: Any,
    what: str = "the stiffness",
    form: str = "a linear elastic form over all cells, or the tangent of an energy",
    symmetry: float = 1e-8,
    product: LocalMatrix | None = None,
) -> None:
    """Raise an InputError unless a stiffness is finite, symmetric and of a positive diagonal.

    Messages have its owner's name, what it is called and the form that is expected. ``symmetry`` is
    the largest entry of K − Kᵀ over that of K: far above what rounding of assembly leaves, far
    below any term of a form that matters. ``product`` is K, where it is there for products.
    """
    if not np.all(np.isfinite(K.data)):
        raise InputError(f"{name}: {what} has entries that are not finite")
    scale = np.abs(K.data).max(initial=0.0)
    if not (LocalMatrix(K) if product is None else product).is_symmetric(symmetry * scale):
        skew = np.abs((K - K.T).data).max(initial=0.0)  # maybe on entries that Kᵀ has not
        if skew > symmetry * scale:
            raise InputError(
                f"{name}: {what} is not symmetric (|K − Kᵀ| = {skew:.3g}, |K| = {scale:.3g}); "
                f"expected {form}"
            )
    lowest = K.diagonal().min(initial=np.inf)
    if lowest <= 0.0:
        raise InputError(
            f"{name}: {what} has a diagonal entry {lowest:.3g}; "
            f"expected {form}, positive on all unknowns"
        )
