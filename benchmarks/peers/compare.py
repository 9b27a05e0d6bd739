#!/usr/bin/env python3
"""Time against error beside other programs, on the same meshes, in turns; not inside of ./run.

    python3 benchmarks/peers/compare.py [--quick] [--scenes "half ball"] [--output DIR]

Hertz's half cylinder and half ball on a rigid plane, meshes that get finer, order 1 and 2 (curved).
Each program reads the same nodes and elements and uses one processor. They are installed when
first asked for, see benchmarks/peers/run. Seconds are those of the processor, the best of three
if short, for set-up and solve; start, imports and reading a mesh are left out for GetFEM and
Kratos, and reading its deck is in CalculiX' seconds. Results of each run stay in DIR/peers;
DIR/peers.md, .json and .png have the tables, see benchmarks/peers/tables.py.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
OURS, THEIRS = str(ROOT / "run"), str(HERE / "run")
LIMIT = 300  # seconds of the wall of a run
SIZES = {
    "half cylinder": {1: (6, 12, 24, 48), 2: (3, 6, 12, 24)},
    "half ball": {1: (4, 6, 10), 2: (2, 3, 5)},
}
QUICK = {"half cylinder": {1: (6,), 2: (3,)}}
FINEST = {"half cylinder": 64, "half ball": 10}
PEERS = ("getfem", "calculix", "kratos")
LINEAR = ("kratos",)  # contact for meshes of order 1 only


def told(text, limit=LIMIT, **where):
    """Run a command; what went wrong, or nothing."""
    try:
        done = subprocess.run(text, capture_output=True, text=True, timeout=limit, **where)
    except subprocess.TimeoutExpired:
        return f"stopped after {limit} s"
    return "" if done.returncode == 0 else (done.stdout + done.stderr)[-500:]


def case(scene, size, order, rtol=1e-6):
    """A case of benchmarks/error_case.py."""
    words = {"scene": scene, "sizes": [size], "degree": order, "order": order}
    return json.dumps({**words, "processor": True, "rtol": rtol})


def solved_here(scene, size, order, file, **other):
    """Solve by this package."""
    program = ["python3", str(ROOT / "benchmarks" / "error_case.py")]
    stresses = file.parent / f"{scene.replace(' ', '_')}_stresses.npz"
    words = [case(scene, size, order, **other), str(file), str(stresses)]
    return told([OURS, *program, *words], 3 * LIMIT)


def compare(scene, order, size, folder):
    """All programs on one mesh."""
    stem = f"{scene} {order} {size}".replace(" ", "_")
    mesh = folder / f"{stem}.npz"
    if said := told(
        [OURS, "python3", str(HERE / "meshes.py"), scene, str(size), str(order), str(mesh)]
    ):
        sys.exit(said)
    peers = PEERS if order == 1 else [peer for peer in PEERS if peer not in LINEAR]
    runs = {"ours": lambda file: solved_here(scene, size, order, file)}
    for peer in peers:
        program = ["python3", str(HERE / f"{peer}_hertz.py"), str(mesh)]
        runs[peer] = lambda file, program=program: told([THEIRS, *program, str(file)])
    for name, run in runs.items():
        file = folder / f"{stem}_{name}.json"
        said = run(file)
        if said:
            file.write_text(json.dumps({"failed": said}))
        print(scene, f"order {order}", f"{size} elements along a", name, said or "done", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two coarse meshes")
    parser.add_argument("--scenes", nargs="+", choices=list(SIZES), default=list(SIZES))
    parser.add_argument("--output", type=Path, default=Path("results"), help="folder")
    arguments = parser.parse_args()
    folder = arguments.output.resolve() / "peers"
    folder.mkdir(parents=True, exist_ok=True)
    sizes = QUICK if arguments.quick else {scene: SIZES[scene] for scene in arguments.scenes}
    for scene, orders in sizes.items():
        reference = folder / f"{scene.replace(' ', '_')}_reference.json"
        if not reference.exists():
            finest = 12 if arguments.quick else FINEST[scene]
            if said := solved_here(scene, finest, 2, reference, rtol=1e-7):
                sys.exit(said)
        for order, along in orders.items():
            for size in along:
                compare(scene, order, size, folder)
    sys.exit(told([OURS, "python3", str(HERE / "tables.py"), str(folder)]))


if __name__ == "__main__":
    main()
