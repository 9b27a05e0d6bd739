"""Checkpoints of a series of load steps: files of each rank, and one that says which count."""

import fcntl
import functools
import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.files import PARTIAL, written_whole
from tfeti_dolfinx.common.parallel import any_rank
from tfeti_dolfinx.common.validation import checked_type, named
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.saved_state import SHIFT, SavedState, Table, numbered

INDEX, RECORDS, VERSION = "checkpoint.json", "records.jsonl", 12
KIND = "checkpoint of tfeti_dolfinx"
COUNTS = " of subdomains"  # behind the name of an array: how many of its rows are of each
_hash: Any = functools.partial(hashlib.blake2b, digest_size=16)
OF_STEP = re.compile(
    rf"(?P<partial>{re.escape(PARTIAL)})?(?P<kind>state|fields)_(?P<number>[1-9]\d*)"
    r"_(?P<rank>0|[1-9]\d*)\.npz"
)


@dataclass(frozen=True)
class Index:
    """Content of ``checkpoint.json``: the step that counts, and what a series goes on from."""

    number: int  # how many steps have converged; 0: the folder is taken, nothing is kept yet
    ranks: int  # the largest number of ranks that have written here
    kind: str = KIND  # the mark of a folder that a checkpoint owns
    version: int = VERSION  # of this form
    digest: Any = None  # describes what the user has given
    about: dict[str, Any] = field(default_factory=dict)  # what else is to be known of the step
    states: list[str] = field(default_factory=list)  # checksum of the state's file of each rank
    subdomains: list[list[int]] = field(default_factory=list)  # subdomains of each of these ranks

    def owns(self, file: Path) -> bool:
        """Return whether the checkpoint writes a file of this name up to the next step."""
        found = OF_STEP.fullmatch(file.name)
        if not file.is_file() or found is None:
            return file.is_file() and file.name in (INDEX, f"{PARTIAL}{INDEX}", RECORDS)
        return int(found["number"]) <= self.number + 1 and int(found["rank"]) < self.ranks

    def counts(self, file: Path) -> bool:
        """Return whether an own file is one of those that the next run reads."""
        found = OF_STEP.fullmatch(file.name)
        if found is None:
            return file.name in (INDEX, RECORDS)
        number, is_state = int(found["number"]), found["kind"] == "state"
        known = number == self.number if is_state else number <= self.number
        return known and not found["partial"]


@dataclass(frozen=True)
class Kept:
    """A step in a checkpoint: a line of ``records.jsonl``, the same on all ranks."""

    record: dict[str, Any]  # its record
    # checksum of the fields' file of each rank, and its subdomains; empty where there are none
    fields: list[str] = field(default_factory=list)
    subdomains: list[list[int]] = field(default_factory=list)


class Checkpoint:
    """A folder with the last converged step of a series. Creation and all methods are collective.

    Each rank writes its arrays to a file of its own, with the number of the step in its name,
    subdomain by subdomain. Another number of ranks reads them: each rank the files that have its
    subdomains. The record of the step is a line at the end of ``records.jsonl``, with the checksums
    of its fields. When all are whole, ``checkpoint.json`` takes that number, and the checksums of
    the state: it is written aside and renamed, so it names whole files at any time, and a line that
    is torn lies beyond the lines of so many steps. Then the state of the step before goes. What a
    step writes does not grow with their number.

    The folder is the checkpoint's own. ``checkpoint.json`` marks it before anything else is
    written; it says of which steps and ranks there are files, and only those are ever removed.
    Creation raises an InputError where the path is no folder for a checkpoint, or its index is
    damaged.

    Args:
        path: The folder; it may be there if it is empty or has a checkpoint, and nothing else.
        comm: Communicator.
        subdomains: Those of this rank, ascending.

    Attributes:
        index: The step that counts; on other ranks than 0 as the last ``read`` has found it.
    """

    def __init__(
        self, path: str | os.PathLike[str], comm: MPI.Intracomm, subdomains: Array
    ) -> None:
        checked_type(path, (str, os.PathLike), "checkpoint", "the name of a folder")
        self.path, self._comm = Path(path), comm
        self._subdomains = [int(s) for s in subdomains]
        self.index = Index(0, comm.size)  # rank 0's counts
        with raised_on_all_ranks(comm), named(f"checkpoint {self.path}", OSError):
            if comm.rank == 0:
                self.index = self._checked_folder()

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other runs out of the folder inside the block, while this process lives."""
        lock = None
        with raised_on_all_ranks(self._comm), named(f"checkpoint {self.path}", OSError):
            if self._comm.rank == 0:
                self.index = self._checked_folder()
                self.path.mkdir(parents=True, exist_ok=True)
                lock = _lock(self.path)
        try:
            yield
        finally:
            if lock is not None:
                os.close(lock)

    def forget(self) -> None:
        """Remove what an earlier series has left, and take the folder, which is locked."""
        with raised_on_all_ranks(self._comm), named(f"checkpoint {self.path}", OSError):
            if self._comm.rank == 0:
                self._commit(self.index)  # on a full disk nothing goes
                for file in self.path.iterdir():
                    if self.index.owns(file) and file.name != INDEX:
                        file.unlink()
                self._commit(Index(0, self._comm.size))  # until here it says what is to go

    def read(self) -> list[Kept]:
        """Return what was written of each step, on all ranks. The folder is locked.

        What a run that was killed has left beside it is removed. Raise an InputError where it is
        damaged.
        """
        kept: list[Kept] = []
        with raised_on_all_ranks(self._comm), named(f"cannot read {self.path}", OSError):
            if self._comm.rank == 0 and self.index.number:
                file = self.path / RECORDS
                lines = file.read_bytes().splitlines(keepends=True)[: self.index.number]
                if len(lines) < self.index.number:
                    raise damaged(file, INDEX)
                found = [_unsealed(line, file) for line in lines]
                kept = [Kept(**record.pop("kept"), record=record) for record in found]
                os.truncate(file, sum(len(line) for line in lines))  # what lies beyond goes
                for file in self.path.iterdir():
                    if self.index.owns(file) and not self.index.counts(file):
                        file.unlink()
                if self.index.ranks < self._comm.size:  # before files of more ranks come
                    self._commit(replace(self.index, ranks=self._comm.size))
        self.index, kept = self._comm.bcast((self.index, kept), root=0)
        return kept

    def write(
        self,
        number: int,
        record: Mapping[str, Any],
        digest: Any,
        about: Mapping[str, Any],
        state: SavedState,
        fields: Table,
    ) -> None:
        """Keep a step; the one before is replaced when this one is whole.

        ``number`` steps have converged then. Record, digest and what is about it are for JSON,
        those of rank 0; state and fields are this rank's.
        """
        comm, in_state, in_fields = self._comm, "", ""
        with raised_on_all_ranks(comm), named(f"cannot write {self.path}", OSError):
            in_state = self._save(f"state_{number}_{comm.rank}.npz", state.table())
            if fields:
                in_fields = self._save(f"fields_{number}_{comm.rank}.npz", fields)
        checksums = comm.gather((in_state, in_fields, self._subdomains), root=0)
        with raised_on_all_ranks(comm), named(f"cannot write {self.path}", OSError):
            if checksums is not None:  # on rank 0
                states, of_fields, parts = (list(c) for c in zip(*checksums, strict=True))
                before = self.index
                kept = {"fields": of_fields, "subdomains": parts} if fields else {}
                with (self.path / RECORDS).open("ab") as file:
                    file.write(_sealed({**record, "kept": kept}))
                    file.flush()
                    os.fsync(file.fileno())
                now = Index(number, max(before.ranks, comm.size), digest=digest, about=dict(about))
                self._commit(replace(now, states=states, subdomains=parts))
                for rank in range(before.ranks):
                    (self.path / f"state_{before.number}_{rank}.npz").unlink(missing_ok=True)

    def read_state(self) -> SavedState:
        """Return the state of this rank at the last step that ``read`` found."""
        last = self.index
        table = self._load("state", last.number, last.states, last.subdomains)
        state = SavedState.from_table(table)
        own = last.subdomains[self._comm.rank] if self._comm.rank < len(last.states) else []
        same = self._comm.size == len(last.states) and own == self._subdomains
        # F may be another elsewhere: it depends on K⁺, but for its values up to Gᵀ
        return state.without_products() if any_rank(self._comm, not same) else state

    def read_fields(self, number: int, kept: Kept) -> Table:
        """Return the fields of a step, of those that ``read`` found, on this rank."""
        if not kept.fields:
            raise InputError(
                f"checkpoint {self.path} has no fields of step {number}; expected path= as in "
                "the run that has written it"
            )
        return self._load("fields", number, kept.fields, kept.subdomains)

    def _save(self, name: str, table: Table) -> str:
        """Write arrays, rows by labels, and how many each subdomain has; return a checksum."""
        arrays: dict[str, Array] = {}
        for column, (values, labels) in table.items():
            arrays[column] = values
            if labels is not None:
                arrays[column] = values[np.argsort(labels)]
                place = np.searchsorted(self._subdomains, labels >> SHIFT)
                arrays[column + COUNTS] = np.bincount(place, minlength=len(self._subdomains))
        with written_whole(self.path / name) as partial:
            np.savez(partial, **cast(dict[str, Any], arrays))
        return _hash((self.path / name).read_bytes()).hexdigest()

    def _load(
        self, kind: str, number: int, checksums: list[str], subdomains: list[list[int]]
    ) -> Table:
        """Return what this rank's subdomains have; rows stand by labels."""
        rank_of = {s: rank for rank, own in enumerate(subdomains) for s in own}
        found: dict[int, dict[str, Array]] = {}
        with raised_on_all_ranks(self._comm), named(f"cannot read {self.path}", OSError):
            missing = [s for s in self._subdomains if s not in rank_of]
            if missing:
                raise InputError(
                    f"{self.path} has no subdomain {missing[0]}; expected the mesh in the same "
                    "subdomains as in the run that has written it"
                )
            for rank in {rank_of[s] for s in self._subdomains} or {0}:
                file = self.path / f"{kind}_{number}_{rank}.npz"
                with named(f"cannot read {file}", OSError):
                    if _hash(file.read_bytes()).hexdigest() != checksums[rank]:
                        raise damaged(file, INDEX if kind == "state" else RECORDS)
                    with np.load(file) as contents:
                        found[rank] = dict(contents)
        table: Table = {}
        first = next(iter(found.values()))
        for name in (name for name in first if not name.endswith(COUNTS)):
            table[name] = first[name], None
            if all(name + COUNTS in arrays for arrays in found.values()):
                known = np.array([s for rank in found for s in subdomains[rank]], dtype=np.int64)
                counts = np.concatenate([arrays[name + COUNTS] for arrays in found.values()])
                rows = np.concatenate([arrays[name] for arrays in found.values()])
                labels = numbered(np.repeat(known, counts))
                order = np.argsort(labels)
                order = order[np.isin(labels[order] >> SHIFT, self._subdomains)]
                table[name] = rows[order], labels[order]
        return table

    def _commit(self, index: Index) -> None:
        """Let an index count."""
        with written_whole(self.path / INDEX) as partial:
            partial.write_bytes(_sealed(asdict(index)))
        self.index = index

    def _checked_folder(self) -> Index:
        """Return the index of the folder, or one of nothing; raise where there is anything else."""
        what = f"checkpoint {self.path}"
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"{what} is a file; expected the name of a folder")
        files = sorted(self.path.iterdir()) if self.path.is_dir() else []
        index = self._read_index() if self.path / INDEX in files else None
        others = [f.name for f in files if index is None or not index.owns(f)]
        if others:
            raise InputError(
                f"{what} is a folder with other files, {others[0]!r}; "
                "expected a new or empty one, or one with a checkpoint and nothing else"
            )
        return index or Index(0, self._comm.size)

    def _read_index(self) -> Index:
        file = self.path / INDEX
        try:
            found = json.loads(text := file.read_bytes())
        except (ValueError, RecursionError) as error:
            raise damaged(file, "it") from error
        if isinstance(found, dict) and found.get("version") in range(1, VERSION):
            raise InputError(
                f"checkpoint {self.path} is of an earlier version of the package; "
                "expected one of this version: finish the series with that one, or name another "
                "folder"
            )
        if not isinstance(found, dict) or found.get("kind") != KIND:
            raise InputError(
                f"{file} is not that of a checkpoint, or damaged; expected the folder as it was "
                "left, or another one"
            )
        found = _unsealed(text, file)
        if found["version"] != VERSION:
            raise InputError(f"{file} is of version {found['version']}; expected {VERSION}")
        return Index(**found)


def damaged(file: Path, where: str) -> InputError:
    """Return the error of a file whose checksum differs from the one that was written."""
    return InputError(
        f"{file} is damaged: it is not what the checkpoint has written, by the checksum in "
        f"{where}; expected the folder as it was left. Bring the file back, or remove the folder"
    )


def _lock(folder: Path) -> int:
    """Lock a folder until the descriptor is closed, where its file system can."""
    lock = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        raise InputError(
            f"checkpoint {folder} is in use by another run; expected one that has ended, "
            "or another folder"
        ) from None
    except OSError:
        pass
    return lock


def _sealed(content: Mapping[str, Any]) -> bytes:
    """Return a line of JSON, the checksum of the content at its end."""
    checksum = _hash(json.dumps(content).encode()).hexdigest()
    return f"{json.dumps({**content, 'checksum': checksum})}\n".encode()


def _unsealed(line: bytes, file: Path) -> dict[str, Any]:
    """Return the content of a line that ``_sealed`` has made; raise if the file is damaged."""
    with suppress(ValueError, RecursionError, AttributeError, KeyError, TypeError):
        found: dict[str, Any] = json.loads(line)
        checksum = found.pop("checksum")
        if checksum == _hash(json.dumps(found).encode()).hexdigest():
            return found
    raise damaged(file, "it")
