"""Make the pictures of the documents anew: ``./run python3 docs/make_pictures.py [DEMO ...]``.

Demos draw them at their default sizes, in some ten minutes. Those of benchmarks are drawn by
these, with their tables.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "docs" / "pictures"
SIZES = {"talk_hertz_2d": ["--subdomains", "32"]}


def shown() -> set[str]:
    """Return the names of the pictures that documents show."""
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    return {name for page in pages for name in re.findall(r"pictures/([\w.]+)", page.read_text())}


def main(names: list[str]) -> None:
    """Run the demos, all or those named, and keep the pictures that documents show."""
    wanted = shown()
    for path in sorted((ROOT / "demos").glob("[a-z]*.py")):
        name = path.stem
        if names and name not in names:
            continue
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, path, "--plot", "--output", folder, *SIZES.get(name, [])]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            for picture in sorted(Path(folder).glob(f"{name}*.[pg][ni][gf]")):
                if picture.name in wanted:
                    shutil.copy(picture, PICTURES)
                    print(picture.name, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
