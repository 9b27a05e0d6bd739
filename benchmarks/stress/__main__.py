"""Random scenes against an LP and an independent solver.

    ./run python3 -m benchmarks.stress --scenes 1000 --seed 0 --ranks 1
    ./run python3 -m benchmarks.stress --only 17 --ranks 4

Every scene is solved by the package and by ``reference`` and put into a class
(see ``judge``): right, not converged, WRONG, and so on; classes in capitals must
not occur. A scene that takes longer than ``--limit`` seconds is a HANG, one that ends its process
a DEATH. Results go to results/stress.json and .md. Ends with 1 if a class in capitals occurred.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any, TextIO

BATCH = 100
START = 60.0  # seconds that a process may take to import and to compile


def run_batch(names: list[str], ranks: int, limit: float) -> list[dict[str, Any]]:
    """Rows of scenes; a process that hangs or dies is begun again behind the scene."""
    rows: list[dict[str, Any]] = []
    while names:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "rows"
            path.touch()
            ended = _watch(path, names, ranks, limit)
            lines = [json.loads(line) for line in path.read_text().splitlines()]
        done = [line for line in lines if "scene" in line]
        rows += done
        names = names[len(done) :]
        if names and ended:
            rows.append({"scene": names[0], "class": ended[0], "error": ended[1]})
            names = names[1:]
    return rows


def _watch(path: Path, names: list[str], ranks: int, limit: float) -> tuple[str, str] | None:
    """Run a worker; how it ended if before its time."""
    command = [sys.executable, "-m", "benchmarks.stress.worker", str(path), str(limit), *names]
    if ranks > 1:
        command = ["mpirun", "-n", str(ranks), *command]
    with tempfile.TemporaryFile("w+") as log:
        process = subprocess.Popen(
            command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        )
        size, since, allowed = 0, time.monotonic(), START + limit
        try:
            while process.poll() is None:
                time.sleep(0.05)
                if path.stat().st_size != size:
                    size, since = path.stat().st_size, time.monotonic()
                    allowed = limit if size > 200 else START + limit
                if time.monotonic() - since > allowed:
                    _end(process)
                    return "HANG", f"no answer after {allowed:.0f} s{_standing(log)}"
        finally:
            _end(process)
        if process.returncode == 0:
            return None
        log.seek(0)
        return "DEATH", f"exit status {process.returncode}: {log.read()[-1500:]}"


def _standing(log: TextIO) -> str:
    """The package's own lines, innermost first, of the ranks' last tracebacks."""
    log.seek(0)
    places = re.findall(r"tfeti_dolfinx/(\S+\.py)\", line (\d+) in (\w+)", log.read())
    return "".join(f", {file}:{line} {name}" for file, line, name in places[:8])


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a worker with all its ranks."""
    for sign in (signal.SIGTERM, signal.SIGKILL):
        if process.poll() is not None:
            return
        os.killpg(process.pid, sign)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            continue


def summary(rows: list[dict[str, Any]]) -> str:
    """Counts of the classes, then all scenes that are not right."""
    counts = Counter(row["class"] for row in rows)
    lines = ["| class | scenes |", "|---|---|"]
    lines += [f"| {name} | {count} |" for name, count in counts.most_common()]
    keys = ("u", "u of all", "jump", "force", "noise", "F", "seconds")
    lines += ["", "| scene | class | " + " | ".join(keys) + " | text |", "|---" * 10 + "|"]
    for row in rows:
        if row["class"] in ("right", "right: no solution"):
            continue
        shown = [_short(row.get(key, "")) for key in keys]
        text = row.get("error") or row.get("reference") or row.get("reason", "")
        cells = [row["scene"], row["class"], *shown, " ".join(text.split())[:160]]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _short(value: Any) -> str:
    return f"{value:.2g}" if isinstance(value, float) else str(value)


def main(argv: list[str]) -> list[dict[str, Any]]:
    """Run scenes; returns their rows."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", type=int, default=100, help="how many random scenes")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--ranks", type=int, default=1)
    parser.add_argument("--limit", type=float, default=60.0, help="seconds for a scene")
    parser.add_argument("--only", nargs="*", help="seeds of scenes")
    parser.add_argument("--output", type=Path, default=Path("results"))
    arguments = parser.parse_args(argv)
    some = range(arguments.seed, arguments.seed + arguments.scenes)
    names = arguments.only or [str(seed) for seed in some]
    rows: list[dict[str, Any]] = []
    for k in range(0, len(names), BATCH):
        rows += run_batch(names[k : k + BATCH], arguments.ranks, arguments.limit)
        arguments.output.mkdir(parents=True, exist_ok=True)
        (arguments.output / "stress.json").write_text(json.dumps(rows, indent=1) + "\n")
        (arguments.output / "stress.md").write_text(summary(rows) + "\n")
    print(summary(rows))
    return rows


if __name__ == "__main__":
    bad = [row for row in main(sys.argv[1:]) if row["class"].split(":")[0].isupper()]
    sys.exit(1 if bad else 0)
