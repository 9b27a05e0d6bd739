"""A bar on rank 0's terminal while a series of load steps runs; elsewhere nothing."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mpi4py import MPI

# called with the share of the series that is done and a few words
Show = Callable[[float, str], None]


def silent(share: float, text: str) -> None:
    """Show nothing."""


@contextmanager
def shown_progress(comm: MPI.Intracomm, wanted: bool | None) -> Iterator[Show]:
    """Give what shows how far a series is. Not collective.

    Args:
        comm: Communicator; only rank 0 shows anything.
        wanted: None: where rank 0's standard error is a terminal, and rich is there.
    """
    if comm.rank != 0 or wanted is False or (wanted is None and not sys.stderr.isatty()):
        yield silent
        return
    try:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    except ImportError:  # it is optional
        yield _say if wanted else silent
        return
    said = TextColumn("{task.fields[said]}")
    columns = (TextColumn("load steps"), BarColumn(), TimeElapsedColumn(), said)
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=1.0, said="")
        yield lambda share, text: bar.update(task, completed=share, said=text, refresh=True)


def _say(share: float, text: str) -> None:
    print(f"load steps {100 * share:3.0f} %: {text}", file=sys.stderr, flush=True)
