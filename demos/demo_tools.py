"""What the demos share: their command line, and what they do with a solution."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

from petsc4py import PETSc

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.output import write_vtx


class Demo:
    """Command line and clock of a demo.

    Args:
        description: The demo's docstring.
        argv: Arguments after the program's name; what argparse does not know are PETSc options.
        configure: Adds the demo's own arguments.

    Attributes:
        arguments: The parsed arguments.
        petsc_options: Options for ``ContactProblem``.
    """

    def __init__(
        self,
        description: str | None,
        argv: list[str],
        configure: Callable[[argparse.ArgumentParser], None] | None = None,
    ) -> None:
        self.start = time.perf_counter()
        parser = argparse.ArgumentParser(
            description=description,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            epilog="PETSc options such as -tfeti_rtol 1e-8 may follow, see docs/options.md.",
        )
        parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
        parser.add_argument("--report", type=Path, metavar="FILE", help="report as JSON")
        parser.add_argument("--output", type=Path, metavar="DIR", help="fields for ParaView")
        parser.add_argument("--plot", action="store_true", help="pictures, beside the fields")
        if configure is not None:
            configure(parser)
        self.arguments, rest = parser.parse_known_args(argv)
        for word in argv:
            if word.startswith("--"):  # known to argparse; PETSc would call it unused
                PETSc.Options().delValue(word.split("=")[0])
        try:
            self.petsc_options = petsc_options(rest)
        except ValueError as error:
            parser.error(str(error))
        if self.arguments.plot:
            from tfeti_dolfinx.plot import check_screen

            check_screen()

    @property
    def folder(self) -> Path:
        """Where pictures go: ``--output``, else ``results``."""
        return self.arguments.output or Path("results")

    def finish(
        self, problem: tfeti.ContactProblem, name: str
    ) -> tuple[tfeti.Solution, tfeti.Report]:
        """Print and write what the command line asks for; solution and report. Collective."""
        comm, report = problem.decomposition.comm, problem.report
        if self.arguments.output is not None:
            write_vtx(self.arguments.output / f"{name}.bp", problem.solution)
        report.seconds["total"] = time.perf_counter() - self.start
        if self.arguments.report is not None:
            report.write(self.arguments.report, comm)
        if comm.rank == 0:
            print(report, flush=True)
        problem.destroy()
        return problem.solution, report


def petsc_options(arguments: list[str]) -> dict[str, str | None]:
    """Options ``-name [value]`` as a dictionary; those of other libraries are PETSc's business."""
    options: dict[str, str | None] = {}
    name = None
    for word in arguments:
        if word.startswith("--"):
            raise ValueError(f"unrecognized argument: {word}")
        if word.startswith("-") and not _is_number(word):
            name = word.removeprefix("-")
            options[name] = None
        elif name is not None and options[name] is None:
            options[name] = word
        else:
            raise ValueError(f"unrecognized argument: {word}")
    return {name: value for name, value in options.items() if name.startswith("tfeti_")}


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
