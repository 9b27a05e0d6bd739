"""Draw the pictures of the examples anew, at their default sizes.

    ./run python3 docs/pictures.py [NAME ...]

Of what a demo draws those are taken that are in docs/pictures; a new one is put there by hand.
"""

import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parents[1]


def main(names: list[str]) -> None:
    """Run demos, all by default, and replace their pictures."""
    for path in sorted((ROOT / "demos").glob("[a-z]*.py")):
        if names and path.stem not in names:
            continue
        with TemporaryDirectory() as folder:
            command = [sys.executable, path, "--plot", "--output", folder]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            for known in (ROOT / "docs/pictures").glob(f"{path.stem}*"):
                if (Path(folder) / known.name).exists():
                    shutil.copy(Path(folder) / known.name, known)
                    print(known.name, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
