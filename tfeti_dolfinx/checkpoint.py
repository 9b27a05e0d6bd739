"""Checkpoints of a series of load steps: files of each rank, and one that says which count."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.checks import checked_type, named, shown
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.saved_state import SavedState

INDEX, RECORDS, VERSION = "checkpoint.json", "records.jsonl", 2
BROKEN = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile)


class Checkpoint:
    """A folder with the last converged step of a series. Creation and all methods are collective.

    Each rank writes its arrays to a file of its own, with the number of the step in its name.
    The record of the step is a line at the end of ``records.jsonl``. When all are whole,
    ``checkpoint.json`` takes that number, and how long the lines are: it is written aside and
    renamed, so it names whole files at any time, and a line that is torn lies beyond what counts.
    Then files of earlier steps go. What a step writes does not grow with their number.

    Args:
        path: The folder; it may be there if it is empty or has a checkpoint.
        comm: Communicator.

    Raises:
        InputError: The path is no folder for a checkpoint.
    """

    def __init__(self, path: str | os.PathLike[str], comm: MPI.Intracomm) -> None:
        checked_type(path, (str, os.PathLike), "checkpoint", "the name of a folder")
        self.path, self._comm = Path(path), comm
        self._length, self._last = 0, -1  # of records in bytes, on rank 0; the last step kept
        with raised_on_all_ranks(comm), named(f"checkpoint {self.path}", OSError):
            if comm.rank == 0:
                _check_folder(self.path)

    def forget(self) -> None:
        """Remove what an earlier series has left."""
        with raised_on_all_ranks(self._comm), named(f"checkpoint {self.path}", OSError):
            if self._comm.rank == 0:
                self.path.mkdir(parents=True, exist_ok=True)
                (self.path / INDEX).unlink(missing_ok=True)
                self._remove(f for f in self.path.iterdir() if _is_own(f))
        self._length, self._last = 0, -1

    def read_index(self) -> dict[str, Any] | None:
        """What ``write`` was given last as ``about``, on all ranks, and all ``records``.

        None if there is nothing.

        Raises:
            InputError: It cannot be read, or was written on another number of ranks.
        """
        found: dict[str, Any] | None = None
        self._last = -1
        with raised_on_all_ranks(self._comm), named(f"cannot read {self.path / INDEX}", *BROKEN):
            if self._comm.rank == 0 and (self.path / INDEX).exists():
                index = json.loads((self.path / INDEX).read_text())
                self._check(index)
                self._length = index["records_length"]
                found = {**index, "records": self._read_records(index["number"])}
        return self._comm.bcast(found, root=0)

    def write(
        self,
        number: int,
        about: Mapping[str, Any],
        record: Mapping[str, Any],
        state: SavedState,
        fields: Mapping[str, Array],
    ) -> None:
        """Keep a step; the one before is replaced when this one is whole.

        Args:
            number: How many steps have converged.
            about: What else to keep of it, for JSON; rank 0's counts.
            record: What to keep of every step, likewise.
            state: The state of this rank.
            fields: Fields of the step on this rank, kept for all steps.

        Raises:
            InputError: The files cannot be written.
        """
        rank = self._comm.rank
        with raised_on_all_ranks(self._comm), named(f"cannot write {self.path}", OSError):
            self._save(f"state_{number}_{rank}.npz", asdict(state))
            if fields:
                self._save(f"fields_{number}_{rank}.npz", fields)
        with raised_on_all_ranks(self._comm), named(f"cannot write {self.path}", OSError):
            if rank == 0:
                self._append(record)
                index = {"version": VERSION, "ranks": self._comm.size, "number": number}
                length = {"records_length": self._length}
                text = json.dumps({**index, **length, **about}, indent=1)
                partial = self.path / f"{INDEX}.partial"
                partial.write_text(text + "\n")
                os.replace(partial, self.path / INDEX)
                self._remove(self._earlier_states(number))
        self._last = number

    def read_state(self, number: int) -> SavedState:
        """The state of this rank at the step that the index names.

        Raises:
            InputError: It cannot be read.
        """
        name = self.path / f"state_{number}_{self._comm.rank}.npz"
        with raised_on_all_ranks(self._comm), named(f"cannot read {name}", *BROKEN):
            state = SavedState(**_load(name))
        return state

    def read_fields(self, number: int) -> dict[str, Array]:
        """Fields of an earlier step on this rank.

        Raises:
            InputError: They cannot be read.
        """
        name = self.path / f"fields_{number}_{self._comm.rank}.npz"
        with raised_on_all_ranks(self._comm), named(f"cannot read {name}", *BROKEN):
            fields = _load(name)
        return fields

    def _save(self, name: str, arrays: Mapping[str, Array]) -> None:
        partial = self.path / f"{name}.partial"
        with partial.open("wb") as file:
            np.savez(file, **cast(dict[str, Any], arrays))
        os.replace(partial, self.path / name)

    def _append(self, record: Mapping[str, Any]) -> None:
        """Put a record after those that count; what lies beyond them goes."""
        line = (json.dumps(record) + "\n").encode()
        with (self.path / RECORDS).open("ab") as file:
            file.truncate(self._length)
            file.write(line)
        self._length += len(line)

    def _read_records(self, number: int) -> list[Any]:
        with (self.path / RECORDS).open("rb") as file:
            lines = file.read(self._length).splitlines()
        if len(lines) != number:
            raise ValueError(f"{RECORDS} has {len(lines)} whole records of {number}")
        return [json.loads(line) for line in lines]

    def _earlier_states(self, number: int) -> list[Path]:
        """Those of the last step, or, where that is not known, all but those of this one."""
        if self._last >= 0:
            states = [f"state_{self._last}_{rank}.npz" for rank in range(self._comm.size)]
            return [self.path / name for name in states if self._last != number]
        kept = f"state_{number}_"
        return [f for f in self.path.glob("state_*.npz") if kept not in f.name]

    def _check(self, found: Any) -> None:
        if not isinstance(found, dict) or found.get("version") != VERSION:
            raise InputError(f"{self.path} has no checkpoint of this version of the package")
        if found["ranks"] != self._comm.size:
            raise InputError(
                f"{self.path} was written on {found['ranks']} ranks, this run has "
                f"{self._comm.size}; expected the same number"
            )

    def _remove(self, files: Iterable[Path]) -> None:
        for file in list(files):
            file.unlink()


def _load(name: Path) -> dict[str, Array]:
    with np.load(name) as file:
        return dict(file)


def _is_own(file: Path) -> bool:
    """Whether a checkpoint has files of this name."""
    own = ("state_", "fields_", f"{INDEX}.")
    return file.name in (INDEX, RECORDS) or file.name.startswith(own)


def _check_folder(path: Path) -> None:
    if path.exists() and not path.is_dir():
        raise InputError(f"checkpoint {shown(str(path))} is a file; expected the name of a folder")
    if path.is_dir():
        other = [f.name for f in path.iterdir() if not _is_own(f)]
        if other:
            raise InputError(
                f"checkpoint {shown(str(path))} is a folder with other files, {other[0]!r}; "
                "expected a new or empty one, or one with a checkpoint"
            )
