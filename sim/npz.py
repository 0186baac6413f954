"""Arrays of an `.npz` file that may come from anywhere: no pickles, sizes checked beforehand."""

import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.lib import format as npy

from sim.arrays import Values
from sim.errors import InputError, require
from sim.files import require_file

MOST_BYTES = 1 << 30  # unpacked; what is stored without packing may be larger
# What zipfile, NumPy and json raise for files that are not what they should be
UNREADABLE = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    EOFError,
    MemoryError,
    OverflowError,
    RuntimeError,  # encrypted, or nested too deeply
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)


def read_arrays(path: Path) -> dict[str, Values]:
    """Read all arrays of a file, by name.

    Raises
    ------
    InputError
        If it is not a file of arrays, is damaged, or promises more than it could hold.
    """
    require_file(path)
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            size, most = sum(m.file_size for m in members), max(MOST_BYTES, path.stat().st_size)
            require(size <= most, f"{path}: unpacks to {size} bytes; {most} are the most")
            arrays: dict[str, Values] = {}
            for member in members:
                name = member.filename.removesuffix(".npy")
                require(name not in arrays, f"{path}: holds the array {name} twice")
                with archive.open(member) as file:
                    arrays[name] = _array(file, member.file_size)  # type: ignore[arg-type]
            return arrays
    except UNREADABLE as error:
        raise InputError(f"{path}: truncated or no file of arrays ({error})") from error


def _array(file: BinaryIO, n_bytes: int) -> Values:
    """Read one array, which its header must not promise to be longer than the member is."""
    version = npy.read_magic(file)
    read_header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    shape, _, dtype = read_header[version](file)
    n_values = 1
    for length in shape:
        n_values *= length
    if dtype.hasobject or n_values * dtype.itemsize != n_bytes - file.tell():
        raise ValueError(f"an array of shape {shape} and type {dtype} in {n_bytes} bytes")
    file.seek(0)
    return np.asarray(npy.read_array(file, allow_pickle=False))
