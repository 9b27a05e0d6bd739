"""Draw the pictures of the documents anew.

    ./run python3 docs/pictures.py [--at COMMIT] [NAME ...]

A name is that of a demo, or of a picture of a benchmark; without one all are drawn, which takes an
hour or more. Demos draw at their default sizes; of what they draw those pictures are taken that are
in docs/pictures, so a new one is put there by hand. Benchmarks put their tables into the pages, as
measured at the commit; without one they are left out. peers.png needs the other programs:
benchmarks/peers/compare.py draws it.
"""

import argparse
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "docs/pictures"
SIZES = {"talk_hertz_2d": ["--subdomains", "32"]}
# of a benchmark its name, and on how many ranks it is started
BENCHMARKS = {
    "performance_price": ("linear_price", 2),
    "performance_talk": ("talk_tables", 2),
    "performance_weak": ("scaling", 1),
    "time_against_error": ("time_against_error", 1),
}


def main(names: list[str], commit: str | None) -> None:
    """Run demos and benchmarks, all by default, and replace their pictures."""
    demos = {path.stem: path for path in sorted((ROOT / "demos").glob("[a-z]*.py"))}
    for name in names or [*demos, *(BENCHMARKS if commit else ())]:
        program, ranks = BENCHMARKS.get(name, (name, 1))
        given = ["--plot", *SIZES.get(name, [])]
        if name in BENCHMARKS:
            given = ["--document", commit] if commit else []
        with TemporaryDirectory() as folder:
            path = demos.get(name, ROOT / f"benchmarks/{program}.py")
            command = [sys.executable, str(path), *given, "--output", folder]
            if ranks > 1:
                command = ["mpirun", "-n", str(ranks), *command]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            for drawn in sorted(Path(folder).glob(f"{program}*.[gp][in][fg]")):
                known = PICTURES / (f"{name}.png" if name in BENCHMARKS else drawn.name)
                if known.exists():
                    shutil.copy(drawn, known)
                    print(known.name, flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="demos, pictures of benchmarks")
    parser.add_argument("--at", metavar="COMMIT", help="commit that benchmarks measure")
    arguments = parser.parse_args()
    main(arguments.names, arguments.at)
