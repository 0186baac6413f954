"""Messages between this process and one that runs an estimator: JSON, and the arrays' bytes.

A message is two lengths (of its JSON, and of the bytes), the JSON, and the bytes, each array at a
multiple of eight; in the JSON an array is its type, shape, order and place. Nothing is unpickled,
and every array is checked.
"""

import math
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
import orjson

from sim.arrays import Values

_DTYPES = ("<f8", "<f4", "<i8", "<i4", "|u1", "|i1", "|b1")  # of the arrays that are sent
_LENGTHS = struct.Struct("<QQ")
HEAD_BYTES = _LENGTHS.size  # of a message, by which `measure` knows its size
_KEYS = {"dtype", "shape", "order", "at"}


def encode(message: Mapping[str, Any]) -> bytes:
    """A message as bytes.

    Raises
    ------
    TypeError
        If it holds something else than plain values and arrays.
    """
    parts, size = [b"", b""], 0

    def place(value: Any) -> dict[str, Any]:
        nonlocal size
        array = np.asarray(value)
        if array.dtype.str not in _DTYPES:
            raise TypeError(f"a {type(value).__name__} is sent to no other process")
        order = "C" if array.flags.c_contiguous or not array.flags.f_contiguous else "F"
        data, at = array.tobytes(order), size  # type: ignore[arg-type]
        parts.extend((data, bytes(-len(data) % 8)))
        size += len(data) + -len(data) % 8
        return {"dtype": array.dtype.str, "shape": array.shape, "order": order, "at": at}

    text = orjson.dumps(message, default=place)
    text += b" " * (-len(text) % 8)
    parts[0], parts[1] = _LENGTHS.pack(len(text), size), text
    return b"".join(parts)


def measure(said: bytes | bytearray) -> int:
    """Bytes of the message that begins here; 0 while that is not known."""
    return HEAD_BYTES + sum(_LENGTHS.unpack_from(said)) if len(said) >= HEAD_BYTES else 0


def decode(data: bytes) -> dict[str, Any]:
    """The message of `encode`; its arrays are read-only.

    Raises
    ------
    ValueError
        If it is none.
    """
    if not 0 < measure(data) == len(data):
        raise ValueError("not as many bytes as it says")
    begin = HEAD_BYTES + _LENGTHS.unpack_from(data)[0]
    message = _restored(orjson.loads(data[HEAD_BYTES:begin]), data, begin)
    if not isinstance(message, dict):
        raise ValueError("not a JSON object")
    return message


def _restored(part: Any, data: bytes, begin: int) -> Any:
    """The part of a message with its arrays, whose bytes begin here."""
    if isinstance(part, list):
        return [_restored(item, data, begin) for item in part]
    if not isinstance(part, dict):
        return part
    if part.keys() != _KEYS:
        return {name: _restored(value, data, begin) for name, value in part.items()}
    kind, shape, order, at = part["dtype"], part["shape"], part["order"], part["at"]
    known = kind in _DTYPES and isinstance(shape, list) and order in ("C", "F")
    if not known or not all(type(n) is int and n >= 0 for n in (*shape, at)):
        raise ValueError("an array without type, shape, order and place")
    size = math.prod(shape) * np.dtype(kind).itemsize
    if at % 8 or begin + at + size > len(data):
        raise ValueError(f"an array of shape {shape} that ends after its message")
    array: Values = np.ndarray(shape, kind, data if size else b"\0", begin + at if size else 0,
                               order=order)  # fmt: skip
    return array[()]  # of no axes: a number
