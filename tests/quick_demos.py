"""Runs of the demos at their quick size, and the multiplications that they are expected to take.

    ./run python3 tests/quick_demos.py

writes those of this commit to tests/expected_counts.json.
"""

import io
import json
import logging
import os
import shutil
import subprocess
from contextlib import redirect_stdout
from pathlib import Path
from types import SimpleNamespace

from mpi4py import MPI

import demos

ROOT = Path(__file__).resolve().parents[1]
EXPECTED = Path(__file__).with_name("expected_counts.json")
DEMOS = sorted(path.stem for path in (ROOT / "demos").glob("[!_]*.py"))
# rank 0 draws while the others wait: of each kind of pictures one
DRAWN_ON_RANKS = ("hertz_2d", "hertz_3d", "bouncing_bar")


def run(name, folder):
    """Run a demo with all outputs: report, solution, what it printed, its folder. Collective."""
    out = io.StringIO()
    log, said = logging.getLogger("tfeti_dolfinx"), logging.StreamHandler(out)
    log.addHandler(said)
    file = folder / "report.json"
    drawn = MPI.COMM_WORLD.size == 1 or name in DRAWN_ON_RANKS
    arguments = ["--quick", "--report", str(file), "--output", str(folder), *["--plot"] * drawn]
    with redirect_stdout(out):
        solution, _ = demos.run(name, [*arguments, "-tfeti_converged_reason"])
    log.removeHandler(said)
    solution.decomposition.comm.barrier()
    report = json.loads(file.read_text())
    return SimpleNamespace(
        report=report, solution=solution, out=out.getvalue(), folder=folder, drawn=drawn
    )


def alone(name, folder, kind="demos"):
    """Copy a program out of the tree: its path, and an environment that has the package alone."""
    (folder / "site").mkdir(parents=True)
    (folder / "site" / "tfeti_dolfinx").symlink_to(ROOT / "tfeti_dolfinx")
    path = Path(shutil.copy(ROOT / kind / f"{name}.py", folder))
    return path, {**os.environ, "PYTHONPATH": str(folder / "site")}


def process(command, folder, environment=None, limit=300):
    """Run a program to its good end; what it has printed."""
    given = {"cwd": folder, "env": environment, "timeout": limit}
    result = subprocess.run(list(map(str, command)), capture_output=True, text=True, **given)
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
    return result.stdout + result.stderr


def multiplications(report):
    """Multiplications by F and by the preconditioner of all solves of a report."""
    counted = report["in_all"]
    return counted["F_multiplications"] + counted["preconditioner_multiplications"]


def main():
    """Write the multiplications of all demos."""
    from tempfile import TemporaryDirectory

    counts = {}
    for name in DEMOS:
        with TemporaryDirectory() as folder:
            counts[name] = multiplications(run(name, Path(folder)).report)
        print(name, counts[name], flush=True)
    EXPECTED.write_text(json.dumps(counts, indent=1) + "\n")


if __name__ == "__main__":
    main()
