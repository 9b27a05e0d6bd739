"""Errors that every rank raises together."""

import pickle
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np
from mpi4py import MPI


class TfetiError(Exception):
    """Base of all errors of this package."""


class InputError(TfetiError, ValueError):
    """Invalid input; the message names what is wrong and says what was expected."""


class NoSolutionError(TfetiError, RuntimeError):
    """The problem has no solution; the message says why."""


class ConvergenceError(TfetiError, RuntimeError):
    """A solver stopped before it reached its tolerance."""


class FactorError(TfetiError, RuntimeError):
    """A matrix could not be factored; the message says why."""


class ConformanceError(TfetiError, AssertionError):
    """An implementation does not do what its interface promises; the message says what."""


def require(holds: object, promise: str) -> None:
    """Raise a ConformanceError unless a promise holds; ``assert`` would go with ``python -O``."""
    if not holds:
        raise ConformanceError(f"this does not hold: {promise}")


@contextmanager
def raised_on_all_ranks(comm: MPI.Intracomm) -> Iterator[None]:
    """Let an exception of any rank inside the block be raised on all ranks at its end.

    Collective. The block itself must not communicate after a point where a rank may raise.
    The exception of the lowest rank that has one is raised everywhere, of the same type: one that
    cannot travel is a TfetiError that names it, on its own rank too.
    """
    error: Exception | None = None
    try:
        yield
    except Exception as caught:
        error = caught
    raiser = np.array([comm.size if error is None else comm.rank])
    comm.Allreduce(MPI.IN_PLACE, raiser, op=MPI.MIN)
    if raiser[0] < comm.size:
        raise_together(comm, error, int(raiser[0]))


def raise_together(comm: MPI.Intracomm, error: Exception | None, raiser: int) -> None:
    """Raise the exception of the rank ``raiser`` on all ranks. Collective."""
    if comm.rank != raiser or error is None:
        raise comm.bcast(None, root=raiser)
    portable: Exception = TfetiError(f"{type(error).__name__}: {error}")
    with suppress(Exception):  # whatever the error's own methods raise
        rebuilt = pickle.loads(pickle.dumps(error))
        if type(rebuilt) is type(error) and str(rebuilt) == str(error):
            portable = error
    comm.bcast(portable, root=raiser)
    if portable is error:
        raise error
    raise portable from error
