"""Errors that every rank raises together."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from mpi4py import MPI


class TfetiError(Exception):
    """Base of all errors of this package."""


class InputError(TfetiError, ValueError):
    """What the user gave does not fit; the message names it and says what was expected."""


class NoSolutionError(TfetiError, RuntimeError):
    """The problem has no solution; the message says why."""


class ConvergenceError(TfetiError, RuntimeError):
    """A solver stopped before it reached its tolerance."""


@contextmanager
def raised_on_all_ranks(comm: MPI.Intracomm) -> Iterator[None]:
    """Let an exception of any rank inside the block be raised on all ranks at its end.

    Collective. The block itself must not communicate after a point where a rank may raise.
    The exception of the lowest rank that has one is raised everywhere.

    Args:
        comm: The communicator whose ranks all enter the block.
    """
    error: Exception | None = None
    try:
        yield
    except Exception as caught:
        error = caught
    raiser = comm.allreduce(comm.size if error is None else comm.rank, op=MPI.MIN)
    if raiser == comm.size:
        return
    shared = comm.bcast(_portable(error) if comm.rank == raiser else None, root=raiser)
    if comm.rank == raiser and error is not None:
        raise error
    raise shared


def _portable(error: Exception | None) -> Exception:
    """The error itself if other ranks can rebuild it from its message, else a TfetiError."""
    if isinstance(error, TfetiError):
        return type(error)(str(error))
    return TfetiError(f"{type(error).__name__}: {error}")
