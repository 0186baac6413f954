"""Files of words and numbers, read fast and within bounds: the ground of the text readers.

Whatever the file holds, the memory is bounded by its size: nothing is ever allocated because a
header promises it.
"""

from __future__ import annotations

import io
import lzma
import tarfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.compiled import njit
from sim.errors import InputError

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

MOST_BYTES = 1 << 30  # unpacked; a small archive may promise far more
LARGEST = 1e12  # times in microseconds and beyond are not what the formats hold
_XZ_MEMORY = 256 << 20
_CHUNK = 1 << 20
_WORD, _NUMBER, _SLOW = 0, 1, 2


def read_bytes(path: Path, most_bytes: int = MOST_BYTES) -> bytes:
    """Contents of a plain, gzip or xz file, known by its first bytes.

    Raises
    ------
    InputError
        If it cannot be read, is cut short, or unpacks to more than `most_bytes`.
    """
    try:
        with path.open("rb") as file:
            head = file.read(6)
            file.seek(0)
            if head[:2] == b"\x1f\x8b" or head == b"\xfd7zXZ\x00":
                return _unpacked(file, head, path, most_bytes)
            data = file.read(most_bytes + 1)
    except (OSError, EOFError, ValueError, zlib.error, lzma.LZMAError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot read ({reason}); is the file whole?") from error
    return _bounded(data, path, most_bytes)


def _unpacked(file: Any, head: bytes, path: Path, most_bytes: int) -> bytes:
    """Contents of a gzip or xz stream, in steps, so that the bound holds while unpacking."""
    parts: list[bytes] = []
    size = 0
    packed = b""
    while True:
        if head[:2] == b"\x1f\x8b":
            gzip = zlib.decompressobj(wbits=31)
            unpack: Any = gzip
        else:
            unpack = lzma.LZMADecompressor(memlimit=_XZ_MEMORY)
        while not unpack.eof:
            hungry = getattr(unpack, "needs_input", True)
            if not packed and hungry:
                packed = file.read(_CHUNK)
                if not packed:
                    raise EOFError("it ends in the middle of its data")
            part = unpack.decompress(packed, _CHUNK)
            packed = getattr(unpack, "unconsumed_tail", b"")
            parts.append(part)
            size += len(part)
            if size > most_bytes:
                _bounded(b"", path, -1)
        packed = unpack.unused_data or file.read(_CHUNK)
        if not packed.strip(b"\x00"):
            return b"".join(parts)


def _bounded(data: bytes, path: Path, most_bytes: int) -> bytes:
    if len(data) > most_bytes:
        raise InputError(f"{path}: more than {MOST_BYTES >> 20} MiB of data; cut the log in parts")
    return data


def read_members(path: Path) -> dict[str, bytes]:
    """Files of a folder or of a tar archive (plain, gzip, xz): name to contents.

    Names are those of the files without the outermost folder if there is but one; contents of a
    folder's files are unpacked if they are packed, and the name then loses its ending.
    """
    if path.is_dir():
        files = {p: read_bytes(p) for p in sorted(path.iterdir()) if p.is_file()}
        return {_bare(p.name): data for p, data in files.items()}
    data = read_bytes(path)
    members: dict[str, bytes] = {}
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
            for member in archive:
                file = archive.extractfile(member) if member.isfile() else None
                if file is not None:
                    members[str(PurePosixPath(member.name))] = file.read()
    except (tarfile.TarError, OSError, EOFError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: not a tar archive ({error}); give the folder itself") from error
    folders = {name.split("/", maxsplit=1)[0] for name in members}
    if len(folders) == 1 and all("/" in name for name in members):
        members = {name.split("/", maxsplit=1)[1]: text for name, text in members.items()}
    return members


def _bare(name: str) -> str:
    return name.removesuffix(".gz").removesuffix(".xz")


@dataclass(frozen=True)
class Words:
    """The words of a text file, line by line; lines without words are left out.

    Attributes
    ----------
    where
        The file's name, for messages.
    data
        The file as (B,) uint8.
    values
        (K,) each word as a number, NaN where it is none.
    is_number
        (K,) uint8, 1 where it is one.
    first
        (L + 1,) line i holds the words first[i] to first[i + 1].
    line_starts
        (L,) first byte of each line's first word.
    line_numbers
        (L,) counted from 1.
    """

    where: str
    data: NDArray[np.uint8]
    values: Array
    is_number: NDArray[np.uint8]
    first: Rows
    line_starts: Rows
    line_numbers: NDArray[np.int32]

    @property
    def counts(self) -> Rows:
        """(L,) words of each line."""
        return np.diff(self.first)

    def error(self, line: int, reason: str) -> InputError:
        """The error that names the file, the line and the reason."""
        return InputError(f"{self.where}:{self.line_numbers[line]}: {reason}")

    def lines_of(self, keyword: str) -> Rows:
        """Lines whose first word is the keyword."""
        if not len(self.line_numbers):
            return np.zeros(0, np.int64)
        wanted = np.frombuffer(keyword.encode(), np.uint8)
        found: Rows = np.flatnonzero(_begins(self.data, self.line_starts, wanted))
        return found

    def numbers(self, lines: Rows, column: int | Rows, n_columns: int, what: str) -> Array:
        """Numbers (len(lines), n_columns) from a column on (one for all, or one a line).

        Raises
        ------
        InputError
            Naming the first line that has too few words, or a word that is no number.
        """
        begin = self.first[lines] + column
        short = np.flatnonzero(begin + n_columns > self.first[lines + 1])
        if len(short):
            raise self.error(int(lines[short[0]]), f"too few words for {what}")
        out = np.empty((len(lines), n_columns))
        bad = _gather(self.values, self.is_number, begin, out)
        if bad >= 0:
            raise self.error(int(lines[bad]), f"not a number in {what}")
        return out

    def finite(self, lines: Rows, column: int | Rows, n_columns: int, what: str) -> Array:
        """As `numbers`, and they must be finite, and no larger than a log has reason to hold."""
        values = self.numbers(lines, column, n_columns, what)
        bad = np.flatnonzero(~(np.abs(values) < LARGEST).all(axis=1))
        if len(bad):
            raise self.error(int(lines[bad[0]]), f"{what} must be finite numbers below {LARGEST:g}")
        return values

    def whole(self, lines: Rows, column: int, what: str, least: int, most: int) -> Rows:
        """Whole numbers (len(lines),) of one column, within bounds."""
        values = self.finite(lines, column, 1, what)[:, 0]
        bad = np.flatnonzero((values != np.round(values)) | (values < least) | (values > most))
        if len(bad):
            raise self.error(
                int(lines[bad[0]]), f"{what} must be a whole number from {least} to {most}"
            )
        return values.astype(np.int64)

    def table(self, n_columns: int | Sequence[int], what: str) -> Array:
        """All lines as finite numbers; each must have that many words (one of the choices)."""
        choices = (n_columns,) if isinstance(n_columns, int) else tuple(n_columns)
        counts = self.counts
        width = int(counts[0]) if len(counts) and counts[0] in choices else choices[0]
        bad = np.flatnonzero(counts != width)
        if len(bad):
            raise self.error(
                int(bad[0]), f"a line of {what} must be {width} numbers, this has {counts[bad[0]]}"
            )
        return self.finite(np.arange(len(counts)), 0, width, what)


def split_words(data: bytes, where: str) -> Words:
    """Split text at white space, commas and semicolons; `#` begins a comment.

    Numbers are read exactly, as Python's `float` reads them.

    Raises
    ------
    InputError
        If the file is binary (holds a zero byte).
    """
    text = np.frombuffer(data, np.uint8)
    n_words, n_lines, zero_line = _count(text)
    if zero_line:
        raise InputError(f"{where}:{zero_line}: holds a zero byte, so it is not a text log")
    values, kinds = np.empty(n_words), np.empty(n_words, np.uint8)
    first, line_starts = np.empty(n_lines + 1, np.int64), np.empty(n_lines, np.int64)
    line_numbers = np.empty(n_lines, np.int32)
    _fill(text, _TENS, values, kinds, first, line_starts, line_numbers)
    slow = np.flatnonzero(kinds == _SLOW)
    line_of = np.searchsorted(first, slow, side="right") - 1
    for line in np.unique(line_of):
        begin = int(line_starts[line])
        end = data.find(b"\n", begin)
        words = data[begin : end if end >= 0 else len(data)].split(b"#")[0].translate(_GAPS).split()
        for i in slow[slice(*np.searchsorted(line_of, (line, line + 1)))]:
            values[i] = float(words[i - first[line]])
    kinds[slow] = _NUMBER
    return Words(where, text, values, kinds, first, line_starts, line_numbers)


def read_words(path: Path) -> Words:
    """`split_words` of a plain, gzip or xz file."""
    return split_words(read_bytes(path), str(path))


_GAPS = bytes.maketrans(b",;", b"  ")
_TENS: Array = np.power(10.0, np.arange(23.0))  # powers of ten that doubles hold exactly


@njit()
def _is_gap(byte: int) -> bool:
    return byte == 32 or (9 <= byte <= 13) or byte == 44 or byte == 59


@njit()
def _count(text: NDArray[np.uint8]) -> tuple[int, int, int]:
    """Words, lines that have any, and the first line with a zero byte (0 for none)."""
    n_words, n_lines, line = 0, 0, 1
    in_word, in_comment, line_has_words = False, False, False
    for byte in text:
        if byte == 0:
            return 0, 0, line
        if byte == 10:
            line += 1
            n_lines += line_has_words
            in_word, in_comment, line_has_words = False, False, False
        elif in_comment:
            continue
        elif byte == 35:
            in_comment, in_word = True, False
        elif _is_gap(byte):
            in_word = False
        elif not in_word:
            in_word, line_has_words = True, True
            n_words += 1
    return n_words, n_lines + line_has_words, 0


@njit()
def _fill(
    text: NDArray[np.uint8],
    tens: Array,
    values: Array,
    kinds: NDArray[np.uint8],
    first: Rows,
    line_starts: Rows,
    line_numbers: NDArray[np.int32],
) -> None:
    """Second pass: where the words are and what numbers they spell."""
    n_bytes = len(text)
    i, word, line, row = 0, 0, 1, 0
    line_has_words = False
    while i < n_bytes:
        byte = text[i]
        if byte == 10:
            line += 1
            line_has_words = False
            i += 1
        elif byte == 35:
            while i < n_bytes and text[i] != 10:
                i += 1
        elif _is_gap(byte):
            i += 1
        else:
            if not line_has_words:
                first[row], line_starts[row], line_numbers[row] = word, i, line
                row += 1
                line_has_words = True
            value, kind, i = _number(text, i, tens)
            values[word], kinds[word] = value, kind
            word += 1
    first[row] = word


@njit()
def _number(text: NDArray[np.uint8], begin: int, tens: Array) -> tuple[float, int, int]:
    """The word at `begin`: its number, its kind, and the byte after it.

    Up to 2^53 and 22 decimal places one division of exact doubles is the correctly rounded
    number; what lies beyond is left to Python.
    """
    n_bytes, i = len(text), begin
    negative = text[i] == 45
    if negative or text[i] == 43:
        i += 1
    mantissa, digits, places, kind = np.int64(0), 0, 0, 1
    seen_point = False
    while i < n_bytes:
        byte = text[i]
        if 48 <= byte <= 57:
            digits += 1
            if mantissa < 900719925474099:  # ten times this and 9 is still below 2^53
                mantissa = mantissa * 10 + (byte - 48)
                places += seen_point
            else:
                kind = 2
        elif byte == 46 and not seen_point:
            seen_point = True
        else:
            break
        i += 1
    exponent = 0
    if digits > 0 and i < n_bytes and (text[i] == 101 or text[i] == 69):
        i += 1
        minus = i < n_bytes and text[i] == 45
        if minus or (i < n_bytes and text[i] == 43):
            i += 1
        figures = 0
        while i < n_bytes and 48 <= text[i] <= 57:
            exponent = min(exponent * 10 + (text[i] - 48), 9999)
            figures += 1
            i += 1
        if minus:
            exponent = -exponent
        if figures == 0:
            digits = 0
    end = i
    while end < n_bytes and text[end] != 35 and not _is_gap(text[end]):
        end += 1
    if end != i or digits == 0:
        special = _special(text, i if digits == 0 else end, end)
        if special != 0.0 and i <= begin + 1:
            return -special if negative else special, 1, end
        return np.nan, 0, end
    scale = exponent - places
    if kind == 2 or scale > 22 or scale < -22:
        return 0.0, 2, end
    value = float(mantissa)
    value = value * tens[scale] if scale >= 0 else value / tens[-scale]
    return -value if negative else value, 1, end


@njit()
def _special(text: NDArray[np.uint8], begin: int, end: int) -> float:
    """`inf` or `nan` in any case; 0 for anything else."""
    if end - begin != 3:
        return 0.0
    a, b, c = text[begin] | 32, text[begin + 1] | 32, text[begin + 2] | 32
    if a == 105 and b == 110 and c == 102:
        return np.inf
    if a == 110 and b == 97 and c == 110:
        return np.nan
    return 0.0


@njit()
def _begins(text: NDArray[np.uint8], starts: Rows, word: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Whether each of the words that start there is this word."""
    n_bytes, length = len(text), len(word)
    same = np.zeros(len(starts), np.bool_)
    for k in range(len(starts)):
        begin = starts[k]
        end = begin + length
        if end > n_bytes or (end < n_bytes and text[end] != 35 and not _is_gap(text[end])):
            continue
        same[k] = True
        for j in range(length):
            if text[begin + j] != word[j]:
                same[k] = False
                break
    return same


@njit()
def _gather(values: Array, is_number: NDArray[np.uint8], begin: Rows, out: Array) -> int:
    """Copy rows of words; the first row with a word that is no number, or -1."""
    for row in range(len(begin)):
        for j in range(out.shape[1]):
            k = begin[row] + j
            if is_number[k] != 1:
                return row
            out[row, j] = values[k]
    return -1
