"""Columns of numbers as sensor_msgs/PointCloud2, and back."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sim.arrays import Values

MESSAGE = "sensor_msgs/msg/PointCloud2"
_CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
_KINDS = {code: kind for kind, code in _CODES.items()}


def fields(parts: Mapping[str, Values], height: int = 1) -> dict[str, Any]:
    """Fields of the message of named columns (N,), but for its header."""
    dtype = np.dtype([(name, values.dtype) for name, values in parts.items()])
    table = np.zeros(len(next(iter(parts.values()))), dtype)
    for name, values in parts.items():
        table[name] = values
    assert dtype.fields is not None
    step, width = dtype.itemsize, len(table) // height
    return {
        "height": height,
        "width": width,
        "fields": [
            {"name": name, "offset": offset, "datatype": _CODES[kind.str[1:]], "count": 1}
            for name, (kind, offset, *_) in dtype.fields.items()
        ],
        "point_step": step,
        "row_step": step * width,
        "data": np.frombuffer(table.tobytes(), np.uint8),
        "is_dense": True,
    }


def columns(message: Any) -> Values:
    """Points of a message as a structured array (N,).

    Raises
    ------
    ValueError
        If it does not hold the points that it promises.
    """
    order = ">" if message.is_bigendian else "<"
    dtype = np.dtype(
        {
            "names": [f.name for f in message.fields],
            "formats": [order + _KINDS[f.datatype] for f in message.fields],
            "offsets": [f.offset for f in message.fields],
            "itemsize": message.point_step,
        }
    )
    n_points, data = message.width * message.height, np.asarray(message.data, np.uint8)
    if len(data) != n_points * message.point_step:
        raise ValueError(f"a point cloud promises {n_points} points and does not hold them")
    return np.frombuffer(data.tobytes(), dtype)
