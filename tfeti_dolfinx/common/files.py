"""Names of files, and files that appear whole."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tfeti_dolfinx.common.validation import checked_type
from tfeti_dolfinx.errors import InputError

PARTIAL = ".partial-"  # how the name of a file begins that is not whole


def checked_path(path: Any, *suffixes: str) -> Path:
    """Return a file's name with one of these endings; raise an InputError where it has none."""
    expected = f"a name that ends with {' or '.join(suffixes)}"
    checked_type(path, (str, os.PathLike), "path", expected)
    target = Path(path)
    if target.suffix not in suffixes:
        raise InputError(f"{target}: expected {expected}")
    return target


@contextmanager
def written_whole(target: Path) -> Iterator[Path]:
    """Give a name to write to inside the block; a whole file has the target's. Not collective.

    It is on the disk before it gets that name, so a power cut leaves no less.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f"{PARTIAL}{target.name}")
    try:
        yield partial
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)


def remove(path: Path) -> None:
    """Remove a file or a folder, if it is there."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
