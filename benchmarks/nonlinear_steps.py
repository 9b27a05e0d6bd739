"""What a load step of the nonlinear demos costs: Newton steps, multiplications, factorisations.

    ./run python3 -m benchmarks.nonlinear_steps [--quick | --large] [--only DEMO ...]

Results go to results/nonlinear_steps.md and .json; ``--large`` makes the table of large meshes.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from benchmarks.tools import Tables, command_line, finish, say
from demos import steps_of

DEMOS = (
    "plastic_indentation_2d",
    "plastic_hertz_3d",
    "deep_drawing_2d",
    "rubber_pressed_3d",
    "ironing_2d",
    "ironing_3d",
)
LARGE = {
    "rubber_pressed_3d": ["--size", "0.0158", "--subdomains", "200"],
    "plastic_hertz_3d": ["--size", "0.0058", "--subdomains", "50", "--degree", "1"],
}
# of a step's figures: the columns of their means
COUNTS = {
    "newton_steps": "Newton steps",
    "assemblies": "tangents",
    "F_multiplications": "F",
    "preconditioner_multiplications": "S",
}


def row(name: str, words: list[str]) -> dict[str, Any]:
    """Row of a demo: means over its load steps, the most F of one, and F of the first ones."""
    figures = [record.figures for record in steps_of(name, words)]
    subdomains = figures[0]["subdomains"]
    means = {
        column: float(np.mean([step[count] for step in figures]))
        for count, column in COUNTS.items()
    }
    factors = float(np.mean([step["factorizations"] for step in figures])) / subdomains
    return {
        "demo": f"`{name}`",
        "unknowns": figures[0]["primal_dofs"],
        "subdomains": subdomains,
        "load steps": len(figures),
        **{column: f"{mean:.1f}" for column, mean in means.items()},
        "F at most": max(step["F_multiplications"] for step in figures),
        "F at first": ", ".join(str(step["F_multiplications"]) for step in figures[:3]),
        "F a Newton step": f"{means['F'] / means['Newton steps']:.1f}",
        "factorisations a subdomain": f"{factors:.1f}",
    }


def main(argv: list[str]) -> Tables:
    """Run the demos; returns their table."""
    arguments, options = command_line(__doc__, argv, large=False, only=DEMOS)
    runs = LARGE if arguments.large else dict.fromkeys(DEMOS, ["--quick"] * arguments.quick)
    rows = []
    for name in arguments.only or runs:
        rows.append(row(name, [*runs[name], *options]))
        say(rows[-1])
    tables = {"Load steps of nonlinear demos": rows}
    if arguments.large:  # of some minutes each, so each has a commit of its own
        tables = {f"Load steps of a large {row['demo'].strip('`')}": [row] for row in rows}
    return finish(arguments, "nonlinear_steps", tables)


if __name__ == "__main__":
    main(sys.argv[1:])
