"""Checks that all ranks make the same call with the same arguments: one small message each."""

import inspect
import math
import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from functools import partial
from hashlib import blake2b
from numbers import Integral, Real
from types import FunctionType
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from ufl.algorithms import extract_coefficients
from ufl.algorithms.analysis import extract_constants
from ufl.classes import Conj, Expr, FixedIndex, FloatValue, Label, MultiIndex
from ufl.corealg.traversal import unique_post_traversal

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import space_of
from tfeti_dolfinx.common.parallel import summed
from tfeti_dolfinx.common.validation import shown
from tfeti_dolfinx.errors import InputError, raise_together

# where objects are made that say what a user wants, and have nothing of a rank
DESCRIPTIONS = ("tfeti_dolfinx.contact.", "tfeti_dolfinx.bem.boundary_elements")
# in a name that was made from an object: that of another rank lies elsewhere
ADDRESS = re.compile(r" at 0x[0-9a-f]+")
# in an error of ranks that may be in different calls: outer calls must not talk about it again
TOLD = "_told_to_all_ranks"
# a part that one of two descriptions does not have
NOT_GIVEN = "not given"


@contextmanager
def agreeing(comm: MPI.Intracomm, call: str) -> Iterator[dict[str, Any]]:
    """Raise on all ranks unless all make the same call, with the same arguments. Collective.

    Every public collective call begins with this. Its message has one size, 17 bytes, so ranks that
    make different calls meet in it, and none of them waits for ever; where they differ, or a rank
    has an error, they say more. On one rank there is no message.

    The block checks what its rank was given, and puts it into the dictionary, by name; it must not
    communicate but by calls that begin like this one. An exception of any rank in it is raised on
    all: that of the lowest rank that has one.

    Raises:
        InputError: Another rank makes another call, or was given something else.
    """
    given: dict[str, Any] = {}
    if comm.size == 1:
        yield given
        return
    error: Exception | None = None
    told: dict[str, Any] = {}
    try:
        yield given
        told = {name: as_json(value) for name, value in given.items()}
    except Exception as caught:
        if TOLD in vars(caught):
            raise
        error = caught
    digest = blake2b(repr((call, told)).encode(), digest_size=16).digest()
    message = np.frombuffer(bytes([error is not None]) + digest, dtype=np.uint8)
    all_messages = np.empty((comm.size, message.size), dtype=np.uint8)
    comm.Allgather(message, all_messages)
    if np.any(all_messages[:, 0]):
        _raise_everywhere(comm, error, int(np.argmax(all_messages[:, 0])))
    if np.any(all_messages != all_messages[0]):
        different = _difference_of_ranks(comm.allgather((call, told)))
        if different is not None:
            _raise_everywhere(comm, InputError(different), 0)


def _raise_everywhere(comm: MPI.Intracomm, error: Exception | None, raiser: int) -> None:
    try:
        raise_together(comm, error, raiser)
    except Exception as found:
        vars(found)[TOLD] = True
        raise


def _difference_of_ranks(all_told: list[tuple[str, dict[str, Any]]]) -> str | None:
    """Describe how the first rank that differs does so from rank 0; None: only by rounding."""
    first, expected = all_told[0]
    for rank, (call, told) in enumerate(all_told):
        if call != first:
            return (
                f"rank {rank} has called {call} where rank 0 has called {first}; expected the same "
                "calls on all ranks"
            )
        if (found := difference(told, expected)) is not None:
            what, own, there = found
            return (
                f"{what} is {brief(own)} on rank {rank} and {brief(there)} on rank 0; expected the "
                "same on all ranks"
            )
    return None


def as_json(value: Any) -> Any:
    """Describe what a user gave, alike on all ranks that were given the same. Not collective.

    Numbers and texts are themselves, forms and expressions a hash of their structure with the
    values of constants, objects of this package their attributes. Functions on the mesh and
    conditions are described without what a rank has of them, all else by its name and the floats
    in it: constants, defaults, what a closure or ``partial`` holds, attributes.

    Return numbers, texts and None, lists and dictionaries of them, as JSON takes them.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, str):
        return ADDRESS.sub("", value)
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, Real):
        return int(value) if isinstance(value, Integral) else float(value)
    for kind, describe in KINDS:
        if isinstance(value, kind):
            return describe(value)
    if type(value).__module__.startswith(DESCRIPTIONS):
        names = [f.name for f in fields(value)] if is_dataclass(value) else list(vars(value))
        public = {n: as_json(getattr(value, n)) for n in names if not n.startswith("_")}
        return {"type": type(value).__qualname__, **public}
    return _of_program(value)


def _of_program(value: Any) -> dict[str, Any]:
    """Describe a callable or an object of a user's program: its name and the floats it holds.

    Not whole numbers, which may count something, and no arrays: they may be those of a rank.
    """
    given: dict[str, Any] = {}
    while isinstance(value, partial):
        given = (
            {f"argument {k}": item for k, item in enumerate(value.args)} | value.keywords | given
        )
        value = value.func
    held: dict[str, Any] = {}
    if isinstance(function := getattr(value, "__func__", value), FunctionType):
        numbers = (*function.__code__.co_consts, *(function.__defaults__ or ()))
        held |= {f"number {k}": item for k, item in enumerate(numbers)}
        with suppress(ValueError):  # a variable is set later
            known = inspect.getclosurevars(function)
            held |= {**known.globals, **known.nonlocals}
        held |= function.__kwdefaults__ or {}
    held |= getattr(getattr(value, "__self__", value), "__dict__", {}) | given
    floats = {name: float(x) for name, x in held.items() if isinstance(x, (float, np.floating))}
    name = getattr(value, "__qualname__", type(value).__qualname__)
    return {"type": f"the callable {name}" if callable(value) else name, **floats}


def _of_ufl(given: ufl.Form | Expr) -> dict[str, Any]:
    """Describe a form or an expression by a hash of its structure and the values of constants."""
    constants, functions = extract_constants(given), extract_coefficients(given)
    numbers: defaultdict[Any, int] = defaultdict(int)  # all meshes are 0
    for items in (constants, functions):
        numbers.update({item: k for k, item in enumerate(items)})
    is_form = isinstance(given, ufl.Form)
    if is_form:
        parts = [
            f"{i.integral_type()} {i.subdomain_id()} {sorted(i.metadata().items())} "
            f"{type(i.subdomain_data()).__qualname__} {_structure(i.integrand(), numbers)}"
            for i in given.integrals()
        ]
    else:
        parts = [_structure(given, numbers)]
    return {
        "type": "Form" if is_form else "expression",
        "structure": _hash(parts),
        **{
            f"constants[{k}]": as_json(getattr(c, "value", type(c).__qualname__))
            for k, c in enumerate(constants)
            if not hasattr(c, "law")  # which Newton's method sets
        },
        "functions": [str(f.ufl_element()) for f in functions],
    }


def _structure(expression: Any, numbers: Mapping[Any, int]) -> str:
    """Return a hash of an expression, whatever the order of operands, floats to ten digits.

    UFL's own signature depends on the order of operands that commute, and UFL sorts constants by
    texts with counters in them, which on another rank may have one digit more.
    """
    known: dict[Any, str] = {}
    for part in unique_post_traversal(expression):
        operands = [known[operand] for operand in part.ufl_operands]
        if isinstance(part, Conj):  # UFL puts one where it turns an inner product round
            known[part] = operands[0]
            continue
        text = type(part).__name__
        if isinstance(part, MultiIndex):
            text = str([int(i) if isinstance(i, FixedIndex) else "free" for i in part])
        elif isinstance(part, FloatValue):
            text = f"{float(part):.9e}"
        elif part._ufl_is_terminal_ and not isinstance(part, Label):
            text = str(part._ufl_signature_data_(numbers))
        known[part] = _hash([text, *operands])
    return known[expression]


def _hash(parts: list[str]) -> str:
    return blake2b("\n".join(sorted(parts)).encode(), digest_size=8).hexdigest()


def _of_condition(condition: fem.DirichletBC) -> dict[str, Any]:
    value = condition.g
    is_function = hasattr(value, "x")
    return {
        "type": "DirichletBC",
        "component": [int(i) for i in space_of(condition).component()],
        "value": {"type": "Function"} if is_function else np.asarray(value.value).tolist(),
    }


# in their order: a function is an expression, too
KINDS: tuple[tuple[Any, Callable[[Any], Any]], ...] = (
    (np.ndarray, lambda value: as_json(value.tolist())),
    (os.PathLike, os.fspath),
    (Mapping, lambda value: {str(key): as_json(item) for key, item in value.items()}),
    ((list, tuple), lambda value: [as_json(item) for item in value]),
    (fem.Constant, lambda value: np.asarray(value.value).tolist()),
    (fem.Function, lambda value: {"type": f"Function of {value.ufl_element()}"}),
    ((ufl.Form, Expr), _of_ufl),
    (fem.DirichletBC, _of_condition),
)


def difference(found: Any, expected: Any, what: str = "") -> tuple[str, Any, Any] | None:
    """Find the first part in which two descriptions differ by more than rounding.

    Return its name, what it is in ``found``, and what in ``expected``; None if there is none.
    """
    if isinstance(found, dict) and isinstance(expected, dict):
        beside = f"{what}: " if what else ""
        names = dict.fromkeys([*expected, *found])
        parts = [
            (f"{beside}{n}", found.get(n, NOT_GIVEN), expected.get(n, NOT_GIVEN)) for n in names
        ]
    elif isinstance(found, list) and isinstance(expected, list):
        if _is_rounding(found, expected):
            return None
        if len(found) != len(expected):
            return f"the number of {what}", len(found), len(expected)
        both = enumerate(zip(found, expected, strict=True))
        parts = [(f"{what}[{k}]", one, other) for k, (one, other) in both]
    else:
        return None if _is_rounding([found], [expected]) else (what, found, expected)
    found_in_parts = (difference(one, other, name) for name, one, other in parts)
    return next((deeper for deeper in found_in_parts if deeper is not None), None)


def _is_rounding(found: list[Any], expected: list[Any], rounding: float = 1e-10) -> bool:
    """Return whether two lists are equal up to rounding, as of processors of other kinds."""
    if repr(found) == repr(expected):
        return True
    numbers = [*found, *expected]
    if len(found) != len(expected) or any(type(x) not in (int, float) for x in numbers):
        return False
    size = max(abs(x) for x in numbers)
    return math.isfinite(size) and np.allclose(found, expected, rtol=0.0, atol=rounding * size)


def brief(value: Any) -> str:
    """Return a description for a message."""
    if isinstance(value, dict) and "type" in value:
        return f"a {value['type']}" if not value["type"].startswith("the ") else value["type"]
    return NOT_GIVEN if value is NOT_GIVEN else shown(value)


def sums_of(comm: MPI.Intracomm, arrays: list[Array]) -> list[list[Any]]:
    """Return checksums of fields that do not depend on the partition: one reduction. Collective.

    Of each field [[Σx, Σ|x|], Σ√|x|] over all ranks: two of a size, and one that knows how the
    magnitudes are spread, and does not overflow.
    """
    sums = np.zeros((len(arrays), 3))
    for row, x in zip(sums, arrays, strict=True):
        size = np.abs(x)
        row[:] = x.sum(), size.sum(), np.sqrt(size).sum()
    return [[row[:2].tolist(), float(row[2])] for row in summed(comm, sums)]


def fields_in(given: Mapping[str, Any]) -> dict[str, Array]:
    """Find this rank's values of the functions on the mesh in what a user gave, by names."""
    return {
        f"{name}: function {k}": function.x.array
        for name, value in given.items()
        for k, function in enumerate(_functions(value))
    }


def _functions(value: Any) -> list[Any]:
    if isinstance(value, (ufl.Form, Expr)):
        return list(extract_coefficients(value))
    if isinstance(value, fem.DirichletBC):
        return [value.g] if hasattr(value.g, "x") else []
    if type(value).__module__.startswith(DESCRIPTIONS):
        value = vars(value)
    if isinstance(value, Mapping):
        value = list(value.values())
    items = value if isinstance(value, (list, tuple)) else []
    return [function for item in items for function in _functions(item)]


def check_same_problem(kept: Mapping[str, Any], found: Mapping[str, Any]) -> None:
    """Raise an InputError, which names the first difference, unless two problems are the same.

    Both are what ``ContactProblem.digest`` returns at the same place of a series.
    """
    if (different := difference(dict(found), dict(kept))) is not None:
        what, now, before = different
        raise InputError(
            f"{what} is {brief(now)}, and was {brief(before)} when the checkpoint was written; "
            "expected the same problem, in which apply sets the same at the same time"
        )
