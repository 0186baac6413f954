"""Rows of many runs on disk: journals that grow by a line a run, and Parquet files.

A line of a journal ends with its run's rows written, so a killed process loses only the run that it
was computing. When a job ends, its journal becomes Parquet files, each of rows with the same
columns and types; the name of such a file holds the digest of its bytes. So any damage is seen.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import zlib
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from experiments.runs.columns import DEPENDENCIES, REPEAT
from experiments.runs.dependencies.digests import changed
from experiments.runs.dependencies.recorder import Digests, digest_of_all
from experiments.runs.processes import hold_lock
from experiments.runs.row import (
    WITH_DIGEST,
    Outcome,
    Row,
    check_row,
    check_table,
    concatenate,
    read_parquet,
    read_rows,
    to_tables,
)
from experiments.runs.version import code_version
from sim.errors import InputError, require
from sim.files import require_file, write_whole, writing

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    from numpy.typing import NDArray

Table = TypeVar("Table", "pd.DataFrame", "pa.Table")
JOURNAL = ".journal"
_BEGUN, _WHOLE, _CHANGES, _FAILED = b"b=+!"
ENDED = (_WHOLE, _CHANGES, _FAILED)  # kinds of lines of runs that have ended
KIND_AT = 9  # place of the kind in a line, after the checksum
_STATUS = ["run_key", "status", "status_code", "status_detail", DEPENDENCIES, "code_version"]
_KEY, _DIGEST = re.compile("[0-9a-f]{16}"), re.compile("[0-9a-f]{12}")
_REMEDY = "free some space, or choose another folder of results with ESTIMA_RESULTS"
_SMALL_BYTES, _MOST_SMALL = 2**22, 100  # small files are merged when there are more of them


class Journal:
    """A file to which the runs of one job append their rows.

    A line is a checksum, a kind and JSON: the key of a run that begins, or the rows of one that has
    ended. Rows with the same columns as the last whole ones are written as their changes to them;
    their checksum goes on from that line's, so what has lost its basis is not read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._basis: Row = {}
        self._basis_crc = 0
        with writing(path, _REMEDY):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("ab", buffering=0)
            if self._file.tell():  # a job tried again: its last line may be half written
                self._file.write(b"\n")

    def begin(self, key: str) -> None:
        """Note that a run begins."""
        self._append(_BEGUN, key, 0)

    def append(self, rows: Sequence[Row]) -> None:
        """Append the rows of a run, which `check_row` has passed."""
        if any(row["status"] == Outcome.FAILED for row in rows):
            self._append(_FAILED, rows, 0)
        elif all(list(row) == list(self._basis) for row in rows):
            changes = [
                {k: v for k, v in row.items() if not _same(v, self._basis[k])} for row in rows
            ]
            self._append(_CHANGES, changes, self._basis_crc)
        else:
            self._basis_crc = self._append(_WHOLE, rows, 0)
            self._basis = rows[0]

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _append(self, kind: int, payload: Any, basis_crc: int) -> int:
        text = bytes([kind]) + json.dumps(payload).encode()
        crc = zlib.crc32(text, basis_crc)
        line = b"%08x %s\n" % (crc, text)
        with writing(self.path, _REMEDY):
            size = self._file.seek(0, os.SEEK_END)
            if self._file.write(line) != len(line):  # the disk is full
                self._file.truncate(size)
                raise OSError(28, os.strerror(28))
        return crc


def journal(path: Path) -> closing[Journal]:
    """Open a journal, as a context that closes it."""
    return closing(Journal(path))


@dataclass(frozen=True)
class Outcomes:
    """How runs ended.

    Attributes
    ----------
    done
        (N,) keys of the runs that did not fail, sorted, as numbers.
    failed
        How each of the others failed, by its key as a number.
    """

    done: NDArray[np.uint64]
    failed: dict[int, str]


def read_runs(path: Path) -> pd.DataFrame:
    """Read a table, or all rows of a folder, each run once.

    Of several rows of a run and of equal dependencies, those that did not fail are kept, else
    those of the last file.

    Raises
    ------
    InputError
        If there are none, or a file is damaged or holds no rows.
    """
    tables = [t for file in _files(path) for t in _tables(file)] if path.is_dir() else []
    table = concatenate(tables) if tables else read_rows(path)
    require(len(table), f"{path}: a table of no rows; delete it")
    check_table(table, path)
    if not tables:
        return table
    run = [name for name in ("run_key", REPEAT, DEPENDENCIES) if name in table]
    if "status" not in table or len(run) < 2 or not table.duplicated(run).any():
        return table
    source = np.repeat(np.arange(len(tables)), [len(t) for t in tables])
    sound = (table["status"] != Outcome.FAILED).groupby([table["run_key"], source])
    order = np.lexsort((source, sound.transform("all")))
    return table.iloc[order].drop_duplicates(run, keep="last", ignore_index=True)


def ended(folder: Path, prefix: str = "", damaged: Any = None) -> Outcomes:
    """How the runs of a folder ended, by their status columns alone; stale ones have not.

    Parameters
    ----------
    prefix
        Begin of the names of the files to read.
    damaged
        Called with each InputError of a damaged file, which is then passed over; None to raise it.
    """
    done, failed = [np.zeros(0, np.uint64)], dict[int, str]()
    for file in _files(folder, prefix):
        try:
            tables = _tables(file, _STATUS)
        except InputError as error:
            if damaged is None:
                raise
            damaged(file, error)
            continue
        for table in tables:
            if not set(_STATUS) - {DEPENDENCIES} <= set(table.column_names):
                continue
            frame = table.to_pandas()
            check_table(frame, file)
            table = table.filter(fresh_rows(frame, folder))
            keys = _as_numbers(table["run_key"])
            bad = np.asarray(table["status"].to_pandas() == Outcome.FAILED.value)
            if bad.any():
                said = ("status_code", "status_detail")
                codes, details = (table[c].to_pandas()[bad].fillna("") for c in said)
                failed.update(zip(keys[bad].tolist(), codes + ": " + details, strict=True))
                keys = keys[~np.isin(keys, keys[bad])]
            done.append(keys)
    whole = np.unique(np.concatenate(done))
    places = np.array(list(failed), np.uint64)
    for key in places[np.isin(places, whole)].tolist():
        del failed[key]
    return Outcomes(whole, failed)


def keep_dependencies(digests: Digests, folder: Path) -> str:
    """Keep what rows depend on beside them; return its digest, which goes into the rows."""
    digest = digest_of_all(digests)
    path = _kept(folder, digest)
    if not path.exists():
        with write_whole(path, durable=False) as part:
            part.write_text(json.dumps(digests, indent=1) + "\n")
    return digest


def stale_because(digest: str, folder: Path) -> list[str] | None:
    """What has changed of the dependencies of rows in a folder; None if they are not known."""
    path = _kept(folder, digest)
    if not _DIGEST.fullmatch(digest):
        return None
    try:
        require_file(path)
        kept = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return None
    sound = isinstance(kept, dict) and digest_of_all(kept) == digest
    return changed(kept) if sound else None


def fresh_rows(table: pd.DataFrame, folder: Path) -> NDArray[np.bool_]:
    """Which rows this code and the files here would make: none of their dependencies has changed.

    Rows without known dependencies are taken for fresh if they come from this very code.
    """
    fresh = np.array(table["code_version"] == code_version())
    if DEPENDENCIES in table:
        digests = table[DEPENDENCIES].fillna("")
        for digest in set(digests) - {""}:
            why = stale_because(digest, folder)
            if why is not None:
                fresh[np.asarray(digests == digest)] = not why
    return fresh


def _kept(folder: Path, digest: str) -> Path:
    return (folder if folder.is_dir() else folder.parent) / "dependencies" / f"{digest}.json"


def find_begun_runs(folder: Path, prefix: str) -> set[int]:
    """Keys of the runs that some journal shows as begun and not ended, as numbers."""
    found = set()
    for path in folder.glob(f"{prefix}*{JOURNAL}"):
        require_file(path)
        last = ""
        for key, rows in journal_lines(path.read_bytes()):
            last = "" if rows else key
        if last:
            found.add(int(last, 16))
    return found


def journal_lines(content: bytes) -> Iterator[tuple[str, list[Row]]]:
    """Walk through a journal: the key of a run that begins and no rows, or its key and rows.

    Lines that do not match their checksum, or hold something else, are passed over.
    """
    basis: Row = {}
    basis_crc = 0
    for line in content.split(b"\n")[:-1]:
        text = line[KIND_AT:]
        kind = text[0] if text else 0
        crc = zlib.crc32(text, basis_crc if kind == _CHANGES else 0)
        if line[:KIND_AT] != b"%08x " % crc:
            continue
        try:
            payload = json.loads(text[1:])
        except (ValueError, RecursionError):
            continue
        if kind == _BEGUN:
            if isinstance(payload, str) and _KEY.fullmatch(payload):
                yield payload, []
            continue
        rows = payload if isinstance(payload, list) else []
        if not rows or not all(isinstance(row, dict) for row in rows):
            continue
        if kind == _CHANGES:
            rows = [{**basis, **changes} for changes in rows]
        elif kind == _WHOLE:
            basis, basis_crc = rows[0], crc
        try:
            for row in rows:
                check_row(row)
        except InputError:
            continue
        yield str(rows[0]["run_key"]), rows


def has_checksum(path: Path) -> bool:
    """Whether a file of rows carries checksums: a journal, or a name with a digest."""
    return path.suffix == JOURNAL or WITH_DIGEST.fullmatch(path.name) is not None


def compact(path: Path) -> None:
    """Turn a journal into Parquet files."""
    for table in _tables(path) if path.exists() else ():
        write_table(table, path.parent / path.stem)
    path.unlink(missing_ok=True)


def write_run(rows: Sequence[Row], folder: Path) -> Path:
    """Write the rows of a single run, in place of its former ones; return the file.

    It is a journal until a sweep makes Parquet of it: Arrow takes longer to load than all else.
    """
    for row in rows:
        check_row(row)
    path = folder / f"{rows[0]['run_key']}{JOURNAL}"
    with write_whole(path) as part, journal(part) as book:
        book.append(rows)
    for former in folder.glob(f"{path.stem}*.parquet"):
        former.unlink(missing_ok=True)
    return path


def write_table(table: pa.Table, stem: Path) -> Path:
    """Write a Parquet file called by a stem and the digest of its bytes; return its path."""
    import pyarrow.parquet as pq

    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    digest = hashlib.sha256(buffer.getvalue()).hexdigest()[:16]
    path = stem.with_name(f"{stem.name}.{digest}.parquet")
    with write_whole(path) as part:
        part.write_bytes(buffer.getvalue())
    return path


def tidy(folder: Path, is_live: Any) -> None:
    """Turn journals without a job into Parquet, and merge small files when there are many.

    Parameters
    ----------
    is_live
        Whether a journal, by its name, may still grow.
    """
    if not folder.is_dir():
        return
    with hold_lock(folder / ".tidy.lock"):
        for path in sorted(folder.glob(f"*{JOURNAL}")):
            if not is_live(path.name):
                compact(path)
        small = [
            path
            for path in _files(folder)
            if path.suffix == ".parquet" and path.stat().st_size < _SMALL_BYTES
        ]
        if len(small) > _MOST_SMALL:
            _merge(small)


def _merge(files: Sequence[Path]) -> None:
    """Merge the files of equal columns and types; the name is that of the last one."""
    import pyarrow as pa

    groups: dict[str, list[tuple[Path, pa.Table]]] = {}
    for path in files:
        table = read_parquet(path).replace_schema_metadata(None)
        groups.setdefault(str(table.schema), []).append((path, table))
    for group in groups.values():
        if len(group) > 1:
            last = group[-1][0]
            path = write_table(
                pa.concat_tables(table for _, table in group),
                last.with_name(last.name.split(".")[0]),
            )
            for old in {old for old, _ in group} - {path}:
                old.unlink(missing_ok=True)


def _files(folder: Path, prefix: str = "") -> list[Path]:
    """Files of rows; what a killed process was writing is hidden, and is not among them."""
    names = sorted(p for p in folder.glob(f"{prefix}*") if p.suffix in (".parquet", JOURNAL))
    for path in names:
        there = path.exists() or path.is_symlink()  # or a job has turned it into Parquet meanwhile
        if path.name[0] != "." and there and not path.is_file():
            raise InputError(f"{path}: not a file of rows; remove it")
    return [path for path in names if path.name[0] != "."]


def _tables(path: Path, columns: list[str] | None = None) -> list[pa.Table]:
    """Tables of a file; of the Parquet file if the journal has become one meanwhile."""
    require_file(path)
    if path.suffix == ".parquet":
        table = read_parquet(path, columns)
        require(len(table), f"{path}: a table of no rows; delete it")
        return [table]
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return [read_parquet(p, columns) for p in path.parent.glob(f"{path.stem}.*.parquet")]
    except OSError as error:
        raise InputError(f"{path}: cannot read it ({error.strerror}); remove it") from error
    return to_tables(row for _, rows in journal_lines(content) for row in rows)


def _as_numbers(keys: pa.ChunkedArray) -> NDArray[np.uint64]:
    """Keys of 16 hexadecimal digits as numbers; others are left out of any match, as 0."""
    sound = (isinstance(key, str) and _KEY.fullmatch(key) for key in keys.to_pylist())
    return np.array([int(found[0], 16) if found else 0 for found in sound], np.uint64)


def _same(a: Any, b: Any) -> bool:
    """Whether two values are the same, of the same type; 0.0 and -0.0 are not."""
    return type(a) is type(b) and repr(a) == repr(b)
