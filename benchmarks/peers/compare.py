#!/usr/bin/env python3
"""Seconds to an error of the pressure beside other programs, on the same meshes, in turns.

    python3 benchmarks/peers/compare.py [--quick] [--output DIR]      (not inside of ./run)

Hertz's half cylinder on a rigid plane, meshes that get finer, order 1 and 2 (curved). Each program
reads the same nodes and elements and uses one processor. They are installed when first asked for,
see benchmarks/peers/run. Seconds are those of the processor, the best of a few if short, for
set-up and solve; start, imports and reading a mesh are left out for GetFEM and Kratos, and reading
its deck is in CalculiX' seconds. Results of each run stay in DIR/peers; DIR/peers.md, .json and
.png have the tables.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
OURS, THEIRS = [str(ROOT / "run"), "python3"], [str(HERE / "run"), "python3"]
LIMIT = 300  # seconds of the wall of a run
SIZES = {1: (6, 12, 24, 48), 2: (3, 6, 12, 24)}
PEERS = {"getfem": (1, 2), "calculix": (1, 2), "kratos": (1,)}  # orders of meshes
NAME, LEVELS = "tfeti_dolfinx", (0.05, 0.02, 0.01, 0.005, 0.002)


def told(words):
    """Run a command; what went wrong, or nothing."""
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=LIMIT, cwd=ROOT)
    except subprocess.TimeoutExpired:
        return f"stopped after {LIMIT} s"
    return "" if done.returncode == 0 else (done.stdout + done.stderr)[-500:]


def solve_here(size, order, file, **other):
    """Solve by this package: a case of benchmarks/time_against_error.py."""
    words = {"scene": "half cylinder", "sizes": [size], "degree": order, "order": order}
    case = json.dumps({**words, "processor": True, **other})
    program = [str(ROOT / "benchmarks" / "time_against_error.py"), "--worker"]
    return told([*OURS, *program, case, str(file), str(file.parent / "stresses.npz")])


def compare(order, size, folder):
    """All programs on one mesh."""
    stem = f"{order}_{size}"
    mesh = folder / f"{stem}.npz"
    if said := told([*OURS, str(HERE / "mesh_file.py"), str(size), str(order), str(mesh)]):
        sys.exit(said)
    for name in ["ours", *(peer for peer, orders in PEERS.items() if order in orders)]:
        file = folder / f"{stem}_{name}.json"
        if name == "ours":
            said = solve_here(size, order, file)
        else:
            said = told([*THEIRS, str(HERE / f"{name}_hertz.py"), str(mesh), str(file)])
        if said:
            file.write_text(json.dumps({"failed": said}))
        print(f"order {order}", f"{size} elements along a", name, said or "done", flush=True)


def rows_of(folder):
    """A row for each mesh and program that did not fail, by program, order and size."""
    import numpy as np

    from benchmarks.error_scenes import SCENES
    from benchmarks.pressures import errors

    samples = SCENES["half cylinder"]().samples
    (reference,) = json.loads((folder / "reference.json").read_text())["rows"]
    rows = []
    for file in folder.glob("[12]_*_*.json"):
        order, size, _ = file.stem.split("_")
        found = json.loads(file.read_text())
        if "failed" in found:
            continue
        if "rows" in found:
            (found,) = found["rows"]
            found |= {"program": NAME, "steps": found["F"]}
            profile = np.array(found["profile"])
        else:
            profile = samples.at(np.array(found["points"])[:, None], np.array(found["values"]))
        shown = ("program", "unknowns", "steps", "seconds", "MB")
        against = errors(samples, profile, np.array(reference["profile"]))
        row = {"order": int(order), "size": int(size), **against}
        rows.append({**{key: found[key] for key in shown}, **row})
    return sorted(rows, key=lambda r: (r["program"] != NAME, r["program"], r["order"], r["size"]))


def tables_of(folder):
    """The rows, and seconds to equal errors of the pressure, each program at its better order."""
    from benchmarks.time_against_error import seconds_at

    rows, lines, table = rows_of(folder), {}, []
    for row in rows:
        lines.setdefault(row["program"], {}).setdefault(row["order"], []).append(row)
    for program, orders in lines.items():
        row = {"program": program}
        for level in LEVELS:
            found = [seconds_at(line, "pressure", level) for line in orders.values()]
            row[f"{level:.1%}"] = min((s for s in found if s is not None), default=None)
        table.append(row)
    return {"half cylinder": rows, "half cylinder, seconds to an error": table}


def write(folder, commit=None):
    """Write the tables of a folder, in ./run, with a commit into docs/, too; returns them."""
    sys.path.insert(0, str(ROOT))
    from benchmarks.tools import curves, finish, picture

    def draw(path, tables):
        lines = {}
        # an error of 1 is no answer: that point is left to the table
        for row in (row for row in tables["half cylinder"] if row["pressure"] < 1.0):
            x, y = lines.setdefault(f"{row['program']}, order {row['order']}", ([], []))
            x.append(row["seconds"])
            y.append(row["pressure"])
        with picture(path, 1, 4.6) as (panel,):
            labels = "seconds of the processor", "relative error of the pressure inside 0.9 a"
            curves(panel, "half cylinder", labels, lines)

    given = argparse.Namespace(output=folder.parent, document=commit)
    return finish(given, "peers", tables_of(folder), draw)


def command_line(description):
    """The options of programs that run others."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--quick", action="store_true", help="two coarse meshes")
    parser.add_argument("--output", type=Path, default=Path("results"), help="folder")
    parser.add_argument("--document", metavar="COMMIT", help="put the tables into docs/, too")
    parser.add_argument("--tables", action="store_true", help="of a folder of results, in ./run")
    return parser


def main():
    arguments = command_line(__doc__).parse_args()
    folder = arguments.output.resolve() / "peers"
    if arguments.tables:
        return write(folder, arguments.document)
    folder.mkdir(parents=True, exist_ok=True)
    # where forms of many programs lie, to find one takes longer
    os.environ["TFETI_JIT_CACHE"] = str(folder / "forms")
    reference = folder / "reference.json"
    finest = 12 if arguments.quick else 64
    if not reference.exists() and (said := solve_here(finest, 2, reference, rtol=1e-7)):
        sys.exit(said)
    for order, along in ({1: (6,), 2: (3,)} if arguments.quick else SIZES).items():
        for size in along:
            compare(order, size, folder)
    words = ["--document", arguments.document] if arguments.document else []
    words = [*OURS, __file__, "--tables", "--output", str(folder.parent), *words]
    sys.exit(subprocess.run(words).returncode)


if __name__ == "__main__":
    main()
