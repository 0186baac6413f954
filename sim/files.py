"""Writing files so that nothing half-written is ever read back."""

import hashlib
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sim.errors import InputError, require


def require_file(path: Path) -> None:
    """Refuse what is not a file: a folder, or a pipe or device, which could be read without end.

    A missing file is left for the reader to report.
    """
    with suppress(OSError, ValueError):
        mode = path.stat().st_mode
        folder = " in it" if stat.S_ISDIR(mode) else ""
        require(stat.S_ISREG(mode), f"{path}: not a file; name a file{folder}, or remove it")


def sha256_of(path: Path) -> str:
    """SHA-256 of a file.

    Raises
    ------
    InputError
        If it cannot be read, or is not a file.
    """
    require_file(path)
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot read it ({error.strerror})") from error


def read_head(path: Path) -> bytes:
    """First 512 bytes of a file.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    require_file(path)
    try:
        with path.open("rb") as file:
            return file.read(512)
    except OSError as error:
        raise InputError(f"{path}: cannot read ({error.strerror})") from error


def read_text(path: Path, most_bytes: int = 10_000_000) -> str:
    """Text of a file that may come from anywhere.

    Raises
    ------
    InputError
        If it cannot be read, is not a file, is longer than `most_bytes`, or is not UTF-8.
    """
    require_file(path)
    try:
        with path.open("rb") as file:
            content = file.read(most_bytes + 1)
        require(len(content) <= most_bytes, f"{path}: longer than {most_bytes} bytes; remove it")
        return content.decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: cannot read ({error.strerror}); check its name") from error
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: not UTF-8 text (byte {error.start}); save it as UTF-8"
        ) from error


def check_writable(path: Path) -> None:
    """Refuse a file that cannot be written, before anything is computed.

    Raises
    ------
    InputError
        As `write_whole` does.
    """
    part = _part_of(path)
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        part.touch()
        part.unlink()


def _part_of(path: Path) -> Path:
    """A file of this process beside the one that it will be."""
    require(path.name and not path.is_dir(), f"{path or '.'}: a folder; name the file to write")
    return path.with_name(f".{path.stem}.{os.getpid()}.{secrets.token_hex(4)}.part{path.suffix}")


@contextmanager
def writing(path: Path, remedy: str = "free some space or choose another folder") -> Iterator[None]:
    """Turn an error of the file system into one line."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot write ({error.strerror or error}); {remedy}") from error


@contextmanager
def write_whole(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """Give a path beside `path` to write to; move it into place if all went well.

    Parameters
    ----------
    durable
        Wait until the disk has the content, some milliseconds; not needed for what is checked
        against a checksum and can be made again.

    Raises
    ------
    InputError
        If the file cannot be written: full disk, no permission, a folder in its place.
    """
    part = _part_of(path)
    try:
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield part
            with part.open("rb+") as written:
                if durable:
                    os.fsync(written.fileno())
            os.replace(part, path)
    finally:
        with suppress(OSError):
            part.unlink()


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all, as `write_whole` does."""
    with write_whole(path) as part:
        part.write_text(text, encoding="utf-8")
