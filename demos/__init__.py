"""Demos: each is a script to copy. The functions here are for tests and benchmarks."""

from __future__ import annotations

import inspect
import runpy
import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from petsc4py import PETSc

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.steps.load_steps import StepRecord


class Made(Exception):  # noqa: N818  # it is no error
    """Raised in a demo that has come to its problem: the problem's arguments."""


def run(name: str, arguments: Sequence[object] = ()) -> tuple[Any, Any]:
    """Run a demo in this process as its command line would; its solution and report. Collective."""
    problem = names_of(name, arguments)["problem"]
    problem.destroy()
    return problem.solution, problem.report


def steps_of(name: str, arguments: Sequence[object] = ()) -> list[StepRecord]:
    """Run a demo of load steps in this process; the records of its steps. Collective."""
    names = names_of(name, arguments)
    names["problem"].destroy()
    found: list[StepRecord] = names["records"]
    return found


def scene(
    name: str, arguments: Sequence[object] = (), problem: str = "ContactProblem"
) -> dict[str, Any]:
    """Return the arguments of the problem, of that class, that a demo makes. Collective."""
    made = getattr(tfeti, problem)
    signature = inspect.signature(made)

    def stop(*values: Any, **named: Any) -> None:
        given = dict(signature.bind(*values, **named).arguments)
        for parameter in signature.parameters.values():
            if parameter.kind is parameter.VAR_KEYWORD:
                given |= given.pop(parameter.name, {})
        raise Made(given)

    setattr(tfeti, problem, stop)
    try:
        names_of(name, arguments)
    except Made as found:
        made_of: dict[str, Any] = found.args[0]
        return made_of
    finally:
        setattr(tfeti, problem, made)
    raise RuntimeError(f"demos/{name}.py makes no {problem}")


def names_of(name: str, arguments: Sequence[object]) -> dict[str, Any]:
    """Return a demo's names after a run; options of PETSc stand among the arguments."""
    words = [str(word) for word in arguments]
    before, database, given = sys.argv, PETSc.Options(), petsc_options(words)
    sys.argv = [str(Path(__file__).with_name(f"{name}.py")), *words]
    for option, value in given.items():
        database.setValue(option, value)
    try:
        return runpy.run_path(sys.argv[0], run_name="__main__")
    finally:
        sys.argv = before
        for option in given:
            database.delValue(option)


def petsc_options(words: Sequence[str]) -> dict[str, str | None]:
    """Options ``-tfeti_name [value]`` of a command line."""
    options: dict[str, str | None] = {}
    for word, following in pairwise([*words, "-"]):
        if word.startswith("-tfeti_"):
            value = not following.startswith("-") or following[1:2].isdigit()
            options[word.removeprefix("-")] = following if value else None
    return options
