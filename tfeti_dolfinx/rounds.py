"""Solves with more and more contact rows, until no node without one overlaps."""

from __future__ import annotations

from collections.abc import Callable

from tfeti_dolfinx.errors import ConvergenceError, NoSolutionError
from tfeti_dolfinx.report import Report
from tfeti_dolfinx.solution import Solution
from tfeti_dolfinx.system import System
from tfeti_dolfinx.timing import stage

MAX_ROUNDS = 20


def solve_in_rounds(solve_rows: Callable[[], Solution], system: System, report: Report) -> None:
    """Solve until no node without a row overlaps. Collective.

    Args:
        solve_rows: Solves with the present rows.
        system: The rows.
        report: Takes seconds and counts.

    Raises:
        NoSolutionError: The problem has no solution, however far one looks.
        ConvergenceError: Nodes without a row still overlap after many rounds.
    """
    for _ in range(MAX_ROUNDS):
        try:
            solution = solve_rows()
        except NoSolutionError as error:  # on all ranks: what is far may hold the body yet
            added = _widen(system, report, error)
        else:
            overlap = report.tolerances["penetration"]
            with stage("contact", report.seconds):
                added = system.search.take_in_overlapping(solution.u, overlap)
            if added == 0:
                return
        if added:
            system.change("rows")
        report.late_contact_rows += added
    raise ConvergenceError(f"nodes out of reach still overlap after {MAX_ROUNDS} rounds")


def _widen(system: System, report: Report, error: NoSolutionError) -> int:
    """Look farther for what may hold a body; how many rows are new."""
    search = system.search
    if not search.is_exhausted:
        with stage("contact", report.seconds):
            return search.widen()
    report.converged_reason = "NO_SOLUTION"
    if unmet := search.unmet():
        text = f"{error}; of the contacts meet nobody: {', '.join(unmet)}"
        raise NoSolutionError(text) from error
    raise error
