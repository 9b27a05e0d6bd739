"""Names of files, and files that are whole or not there."""

import os
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
    """Give a name to write to inside the block; a whole file has the target's. Not collective."""
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f"{PARTIAL}{target.name}")
    try:
        yield partial
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)
