"""Seconds to a force in scenes of nonlinear bodies: runs in turns, tables; GetFEM's bodies."""

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

from compare import NAME, OURS, ROOT, THEIRS, command_line, told

LEVELS = (0.01, 0.003, 0.001)
# where a program runs; CalculiX is a process of its own
COMMANDS = {NAME: OURS, "GetFEM": THEIRS, "CalculiX": THEIRS}


def tables_of(rows, title):
    """The rows, with errors beside the finest mesh, and seconds to one that finer do not exceed."""
    from benchmarks.time_against_error import seconds_at

    finest = max(row["n"] for row in rows)
    forces = [row["force"] for row in rows if row["n"] == finest]
    mean, table = sum(forces) / len(forces), []
    rows = [{**row, "error": abs(row["force"] / mean - 1.0)} for row in rows]
    for name in dict.fromkeys(row["program"] for row in rows):
        line = [row for row in rows if row["program"] == name]
        worst = [max(row["error"] for row in line[k:]) for k in range(len(line))]
        line = [{**row, "error": error} for row, error in zip(line, worst, strict=True)]
        found = {f"{level:.1%}": seconds_at(line, "error", level) for level in LEVELS}
        table.append({"program": name, **found})
    return {title: rows, f"{title}, seconds to an error": table}


def main(program, description, title, sizes, mesh, programs):
    """Run all in turns; then, in ./run, write the tables.

    Programs take points and cells, and return a solve that gives force, unknowns and steps.
    """
    parser = command_line(description)
    parser.add_argument("--run", nargs=3, metavar=("PROGRAM", "N", "FILE"), help="in its root")
    arguments = parser.parse_args()
    folder, stem = arguments.output.resolve() / "peers", Path(program).stem
    sys.path.insert(0, str(ROOT))
    if arguments.run:
        from judged import best

        name, n, file = arguments.run
        apart = resource.RUSAGE_CHILDREN if name == "CalculiX" else resource.RUSAGE_SELF
        made = best(programs[name](*mesh(int(n))), apart)
        force, unknowns, steps = made.pop("found")
        found = {"program": name, "n": int(n), "unknowns": unknowns, "steps": steps, "force": force}
        return Path(file).write_text(json.dumps({**found, **made}))
    cases = [(n, name, folder / f"{stem}_{n}_{name}.json") for n in sizes for name in programs]
    if arguments.tables:
        from benchmarks.tools import finish

        rows = [json.loads(file.read_text()) for _, _, file in cases if file.exists()]
        return finish(arguments, stem, tables_of(rows, title))
    folder.mkdir(parents=True, exist_ok=True)
    os.environ["TFETI_JIT_CACHE"] = str(folder / "forms")
    for n, name, file in cases[: 2 * len(programs) if arguments.quick else None]:
        said = told([*COMMANDS[name], program, "--run", name, str(n), str(file)])
        print(f"{n} elements", name, said or "done", flush=True)
    given = ["--document", arguments.document] if arguments.document else []
    words = [*OURS, program, "--tables", "--output", str(arguments.output.resolve()), *given]
    sys.exit(subprocess.run(words).returncode)
