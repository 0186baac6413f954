"""What a hostile bag must not do: unpack to more than the memory holds, or run code."""

import bz2
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sim.errors import InputError, require
from sim.formats.text import MOST_BYTES

_MCAP_DATA_END = 15


def state_checksum(path: Path) -> None:
    """Write the checksum of an MCAP file's data into it, which the library leaves out."""
    data = bytearray(path.read_bytes())
    at = data.rindex(struct.pack("<BQI", _MCAP_DATA_END, 4, 0))
    struct.pack_into("<I", data, at + 9, zlib.crc32(data[:at]))
    path.write_bytes(data)


def check_bounds(path: Path) -> None:
    """Refuse files that would unpack to more than is allowed, or run code of their own."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    require(
        sum(file.stat().st_size for file in files) <= MOST_BYTES,
        f"{path}: more than {MOST_BYTES >> 20} MiB; split the bag",
    )
    left = MOST_BYTES
    for file in files:
        with file.open("rb") as stream:
            head = stream.read(16)
        if head[:8] == b"\x89MCAP0\r\n":
            left -= _unpacked_size(file, _mcap_chunks(file.read_bytes()), left)
        elif head[:13] == b"#ROSBAG V2.0\n":
            left -= _unpacked_size(file, _bag_chunks(file.read_bytes()), left)
        elif head == b"SQLite format 3\x00":
            _check_tables(file)
        elif file.name.endswith(".zstd"):
            left -= _unpacked_size(file, iter([("zstd", file.read_bytes())]), left)


def _unpacked_size(path: Path, chunks: Iterator[tuple[str, bytes]], most: int) -> int:
    """Bytes that chunks unpack to, found within bounds."""
    total = 0
    for kind, data in chunks:
        total += len(data) if kind in ("", "none") else _length(kind, data, most - total)
        require(total < most, f"{path}: unpacks to more than {MOST_BYTES >> 20} MiB")
    return total


def _length(kind: str, data: bytes, most: int) -> int:
    """Length of packed data, or `most` if it is at least that; unpacked in small steps."""
    from backports import zstd
    from lz4.frame import LZ4FrameDecompressor

    decompressors: dict[str, Any] = {
        "zstd": zstd.ZstdDecompressor,
        "bz2": bz2.BZ2Decompressor,
        "lz4": LZ4FrameDecompressor,
    }
    unpack = decompressors[kind]()
    length = 0
    while not unpack.eof and length < most:
        part = unpack.decompress(data, 1 << 20)
        data = b""
        length += len(part)
        if not part and unpack.needs_input:
            break
    return min(length, most)


def _mcap_chunks(data: bytes) -> Iterator[tuple[str, bytes]]:
    """Packing and contents of the chunks of an MCAP file."""
    at = 8
    while at + 9 <= len(data) - 8:
        operation, length = struct.unpack_from("<BQ", data, at)
        at += 9
        if length > len(data) - at:
            raise ValueError(f"a record of {length} bytes at byte {at} is longer than the file")
        if operation == 6:
            (name_length,) = struct.unpack_from("<I", data, at + 28)
            name = data[at + 32 : at + 32 + min(name_length, 100)].decode("ascii", "replace")
            (packed,) = struct.unpack_from("<Q", data, at + 32 + name_length)
            begin = at + 40 + name_length
            yield name, data[begin : begin + packed]
        if operation == _MCAP_DATA_END and length >= 4:
            (stated,) = struct.unpack_from("<I", data, at)
            if stated not in (0, zlib.crc32(data[: at - 9])):  # 0: not given
                raise ValueError("the data do not match their checksum")
        at += length


def _bag_chunks(data: bytes) -> Iterator[tuple[str, bytes]]:
    """Packing and contents of the chunks of a ROS 1 bag."""
    at = 13
    while at + 8 <= len(data):
        (header_length,) = struct.unpack_from("<I", data, at)
        header = data[at + 4 : at + 4 + header_length]
        at += 4 + header_length
        if at + 4 > len(data):
            raise ValueError(f"a header of {header_length} bytes is longer than the file")
        (length,) = struct.unpack_from("<I", data, at)
        at += 4
        if b"op=\x05" in header:
            name = header.split(b"compression=", maxsplit=1)[-1][:3]
            yield {b"bz2": "bz2", b"lz4": "lz4"}.get(name, "none"), data[at : at + length]
        at += length


def _check_tables(path: Path) -> None:
    """A bag's database holds tables and indices only; views and triggers are programs."""
    try:
        with sqlite3.connect(f"file:{path.resolve()}?mode=ro", uri=True) as database:
            kinds = database.execute("SELECT type, sql FROM sqlite_schema LIMIT 1000").fetchall()
        database.close()
    except sqlite3.Error as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: damaged database ({reason})") from error
    for kind, sql in kinds:
        require(
            kind in ("table", "index") and "virtual" not in str(sql).lower(),
            f"{path}: a database with a {kind} of its own is not a bag",
        )
