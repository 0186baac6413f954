"""Files of words and numbers, read within bounds: the ground of the text readers.

Whatever the file holds, the memory is bounded by its size: nothing is ever allocated because a
header promises it.
"""

import codecs
import io
import lzma
import math
import tarfile
import zlib
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

import numpy as np

from sim.arrays import Array, ArrayLike, Bools, Ints
from sim.errors import InputError, require
from sim.files import require_file

Rows = Ints

MOST_BYTES = 1 << 30  # unpacked; a small archive may promise far more
LARGEST = 1e12  # times in microseconds and beyond are not what the formats hold
_XZ_MEMORY = 256 << 20
_CHUNK = 1 << 20


def read_bytes(path: Path, most_bytes: int = MOST_BYTES) -> bytes:
    """Contents of a plain, gzip or xz file, known by its first bytes.

    Raises
    ------
    InputError
        If it cannot be read, is cut short, or unpacks to more than `most_bytes`.
    """
    require_file(path)
    parts: list[bytes] = []
    size = 0
    try:
        with path.open("rb") as file:
            for part in _unpacked(file):
                size += len(part)
                require(
                    size <= most_bytes,
                    f"{path}: more than {MOST_BYTES >> 20} MiB of data; cut the log in parts",
                )
                parts.append(part)
    except (OSError, EOFError, ValueError, zlib.error, lzma.LZMAError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot read ({reason}); is the file whole?") from error
    return b"".join(parts)


def _unpacked(file: BinaryIO) -> Iterator[bytes]:
    """Contents of a file, unpacked, in steps that are bounded whatever it unpacks to."""
    head = file.read(6)
    file.seek(0)
    if head[:2] == b"\x1f\x8b":
        start: Callable[[], Any] = partial(zlib.decompressobj, wbits=31)
    elif head == b"\xfd7zXZ\x00":
        start = partial(lzma.LZMADecompressor, memlimit=_XZ_MEMORY)
    else:
        yield from iter(partial(file.read, _CHUNK), b"")
        return
    packed = file.read(_CHUNK)
    while packed.strip(b"\x00"):  # one stream may follow another, and padding the last
        unpack = start()
        while not unpack.eof:
            if not packed and getattr(unpack, "needs_input", True):
                packed = file.read(_CHUNK)
                if not packed:
                    raise EOFError("it ends in the middle of its data")
            yield unpack.decompress(packed, _CHUNK)
            packed = getattr(unpack, "unconsumed_tail", b"")
        packed = unpack.unused_data or file.read(_CHUNK)


def read_members(path: Path) -> dict[str, bytes]:
    """Files of a folder or of a tar archive (plain, gzip, xz): name to contents.

    Names are those of the files without the outermost folder if there is but one; contents of a
    folder's files are unpacked if they are packed, and the name then loses its ending.
    """
    if path.is_dir():
        files = {p: read_bytes(p) for p in sorted(path.iterdir()) if p.is_file()}
        return {p.name.removesuffix(".gz").removesuffix(".xz"): data for p, data in files.items()}
    data = read_bytes(path)
    members: dict[str, bytes] = {}
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
            for member in archive:
                if member.size > len(data):  # a sparse file may promise any length
                    raise ValueError(f"{member.name} of {member.size} bytes is longer than it")
                file = archive.extractfile(member) if member.isfile() else None
                if file is not None:
                    members[str(PurePosixPath(member.name))] = file.read()
    except (tarfile.TarError, OSError, EOFError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: not a tar archive ({error}); give the folder itself") from error
    folders = {name.split("/", maxsplit=1)[0] for name in members}
    if len(folders) == 1 and all("/" in name for name in members):
        members = {name.split("/", maxsplit=1)[1]: text for name, text in members.items()}
    return members


@dataclass(frozen=True)
class Words:
    """The words of a text file, line by line; blank lines are dropped.

    Attributes
    ----------
    where
        The file's name, for messages.
    values
        (K,) each word as a number, NaN where it is none.
    is_number
        (K,) whether it is one.
    first
        (L + 1,) line i holds the words first[i] to first[i + 1].
    line_numbers
        (L,) counted from 1.
    lines_by_keyword
        Lines that begin with each word that is not a number.
    """

    where: str
    values: Array
    is_number: Bools
    first: Rows
    line_numbers: Rows
    lines_by_keyword: dict[bytes, list[int]]

    @property
    def counts(self) -> Rows:
        """(L,) words of each line."""
        return np.diff(self.first)

    @property
    def lines(self) -> Rows:
        """(L,) numbers of all lines, from 0 on."""
        return np.arange(len(self.line_numbers))

    def error(self, line: int, reason: str) -> InputError:
        """The error that names the file, the line and the reason."""
        return InputError(f"{self.where}:{self.line_numbers[line]}: {reason}")

    def refuse(self, bad: ArrayLike, lines: Rows, reason: str) -> None:
        """Raise the error of the first of the lines that is bad, if one is."""
        for line in lines[np.flatnonzero(bad)[:1]].tolist():
            raise self.error(line, reason)

    def lines_of(self, keyword: str) -> Rows:
        """Lines whose first word is the keyword."""
        return np.array(self.lines_by_keyword.get(keyword.encode(), ()), np.int64)

    def numbers(self, lines: Rows, column: int | Rows, n_columns: int, what: str) -> Array:
        """Numbers (len(lines), n_columns) from a column on (one for all, or one a line).

        Raises
        ------
        InputError
            Naming the first line that has too few words, or a word that is not a number.
        """
        begin = self.first[lines] + column
        self.refuse(begin + n_columns > self.first[lines + 1], lines, f"too few words for {what}")
        wanted = begin[:, None] + np.arange(n_columns)
        self.refuse(~self.is_number[wanted].all(axis=1), lines, f"not a number in {what}")
        return np.asarray(self.values[wanted])

    def finite(self, lines: Rows, column: int | Rows, n_columns: int, what: str) -> Array:
        """As `numbers`, and they must be finite, and no larger than a log has reason to hold."""
        values = self.numbers(lines, column, n_columns, what)
        bad = ~(np.abs(values) < LARGEST).all(axis=1)
        self.refuse(bad, lines, f"{what} must be finite numbers below {LARGEST:g}")
        return values

    def whole(self, lines: Rows, column: int, what: str, least: int, most: int) -> Rows:
        """Whole numbers (len(lines),) of one column, within bounds."""
        values = self.finite(lines, column, 1, what)[:, 0]
        bad = (values != np.round(values)) | (values < least) | (values > most)
        self.refuse(bad, lines, f"{what} must be a whole number from {least} to {most}")
        return values.astype(np.int64)

    def table(self, n_columns: int | Sequence[int], what: str) -> Array:
        """All lines as finite numbers; each must have that many words (one of the choices)."""
        choices = (n_columns,) if isinstance(n_columns, int) else n_columns
        counts = self.counts
        width = next((choice for choice in choices if choice in counts[:1]), choices[0])
        for line in np.flatnonzero(counts != width)[:1].tolist():
            raise self.error(
                line, f"a line of {what} must be {width} numbers, this has {counts[line]}"
            )
        return self.finite(self.lines, 0, width, what)


def split_words(data: bytes, where: str) -> Words:
    """Split text at white space, commas and semicolons; `#` begins a comment.

    A byte order mark of UTF-8 at its beginning is passed over. Numbers are read exactly, as
    Python's `float` reads them, except that underscores are refused.

    Raises
    ------
    InputError
        If the file is binary (holds a zero byte).
    """
    data = data.removeprefix(codecs.BOM_UTF8)
    zero = data.find(b"\x00")
    if zero >= 0:
        line_number = data.count(b"\n", 0, zero) + 1
        raise InputError(f"{where}:{line_number}: holds a zero byte, so it is not a text log")
    values, first, line_numbers = array("d"), array("q"), array("q")
    not_numbers: list[int] = []
    lines_by_keyword: dict[bytes, list[int]] = {}
    for line_number, line in enumerate(data.translate(_PLAIN).split(b"\n"), start=1):
        words = line.partition(b"#")[0].split()
        if not words:
            continue
        first.append(len(values))
        line_numbers.append(line_number)
        for word in words:
            try:
                values.append(float(word))
            except ValueError:
                if len(values) == first[-1]:
                    lines_by_keyword.setdefault(word, []).append(len(first) - 1)
                not_numbers.append(len(values))
                values.append(math.nan)
    first.append(len(values))
    is_number = np.ones(len(values), bool)
    is_number[not_numbers] = False
    return Words(
        where,
        np.array(values),
        is_number,
        np.array(first, np.int64),
        np.array(line_numbers, np.int64),
        lines_by_keyword,
    )


def read_words(source: Path | Words) -> Words:
    """`split_words` of a plain, gzip or xz file; words that were read before are handed back."""
    return source if isinstance(source, Words) else split_words(read_bytes(source), str(source))


# Gaps are blanks; "1_0" is 10 to Python, but no number in a log, and no keyword has a "_".
_PLAIN = bytes.maketrans(b",;_", b"  ?")


def reason_of(error: Exception) -> str:
    """Kind and text of an error, on one short line, for a message."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:120]


def json_number(value: Any) -> float:
    """A number of a JSON document.

    Raises
    ------
    TypeError, ValueError
        If it is none, or not finite, or larger than a log has reason to hold.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{str(value)[:40]!r} is not a number")
    number = float(value)
    if not abs(number) < LARGEST:
        raise ValueError(f"numbers must be finite, below {LARGEST:g}")
    return number
