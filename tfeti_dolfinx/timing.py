"""Stages: wall time for the report, and a stage of PETSc's log for each."""

from __future__ import annotations

import time
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager

from petsc4py import PETSc


@contextmanager
def stage(name: str, seconds: MutableMapping[str, float]) -> Iterator[None]:
    """Add the wall time of the block to ``seconds[name]``; ``-log_view`` shows it as a stage."""
    log = PETSc.Log.Stage(f"tfeti: {name}")
    start = time.perf_counter()
    log.push()
    try:
        yield
    finally:
        log.pop()
        seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start
