"""Checks of what users give: values, types, and what their callables raise."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import InputError, TfetiError


@dataclass(frozen=True)
class Range:
    """Which numbers fit, and how a message says it."""

    text: str
    holds: Callable[[float], bool]


FINITE = Range("a finite number", lambda value: True)
POSITIVE = Range("a positive number", lambda value: value > 0.0)


def shown(value: Any) -> str:
    """A value for a message: short, and of objects their type only."""
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
    """Whether a value is an integer, numpy's included; True and False are none."""
    return isinstance(value, Integral) and not isinstance(value, (bool, np.bool_))


def checked_number(value: Any, what: str, expected: Range = FINITE) -> float:
    """A finite number in a range; numpy's scalars are numbers, booleans and texts are none.

    Args:
        value: What was given.
        what: Its name in messages.
        expected: The range.

    Raises:
        InputError: It is not a number, not finite, or out of the range.
    """
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    number = isinstance(value, Real) and not isinstance(value, (bool, np.bool_))
    if not number or not math.isfinite(value) or not expected.holds(float(value)):
        raise InputError(f"{what}={shown(value)}: expected {expected.text}")
    return float(value)


def real_numbers(values: Any) -> Array:
    """What a user's function has returned as floats; of complex numbers no part is dropped.

    Raises:
        TypeError: They are no real numbers.
        ValueError: They are texts.
    """
    array = np.asarray(values)
    if np.iscomplexobj(array):
        raise TypeError("complex numbers; expected real ones")
    return np.asarray(array, dtype=float)


def checked_flag(value: Any, what: str) -> bool:
    """A boolean, or numpy's.

    Raises:
        InputError: It is anything else.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"{what}={shown(value)}: expected True or False")
    return bool(value)


def checked_type(value: Any, kinds: type | tuple[type, ...], what: str, expected: str) -> None:
    """Raise unless a value is of some type.

    Raises:
        InputError: ``<what> is <value>; expected <expected>``.
    """
    if not isinstance(value, kinds):
        raise InputError(f"{what} is {shown(value)}; expected {expected}")


def checked_callable(value: Any, what: str, expected: str) -> None:
    """Raise unless a value can be called.

    Raises:
        InputError: It cannot.
    """
    if not callable(value):
        raise InputError(f"{what} is {shown(value)}; expected {expected}")


def checked_path(path: Any, suffix: str) -> Path:
    """A file's name with this ending.

    Raises:
        InputError: It is no name, or ends otherwise.
    """
    expected = f"a name that ends with {suffix}"
    checked_type(path, (str, PathLike), "path", expected)
    target = Path(path)
    if target.suffix != suffix:
        raise InputError(f"{target}: expected {expected}")
    return target


@contextmanager
def named(what: str, *kinds: type[Exception]) -> Iterator[None]:
    """Name what failed: errors of the given kinds (default all) become an InputError.

    Not collective; errors of this package stay as they are.

    Args:
        what: Begins the message.
        kinds: Types of errors.
    """
    try:
        yield
    except TfetiError:
        raise
    except Exception as error:
        if kinds and not isinstance(error, kinds):
            raise
        raise InputError(f"{what}: {type(error).__name__}: {error}") from error
