"""Logs: the readings of a sensor, of the wheels, and the commands, each with its own stamps."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim.arrays import Array, Ints, Values
from sim.errors import InputError, require, required
from sim.sensors.base import Reading, Schema, Sensor, split_schema


def detach(values: Values) -> Values:
    """Copy of an array that nobody can write to: its memory belongs to a `bytes`.

    It takes as long as `copy`, whose array may be made writable.
    """
    if isinstance(values, np.generic):
        return values  # of a field without axes
    return np.ndarray(values.shape, values.dtype, values.tobytes() or b"\0")


@dataclass(frozen=True)
class WheelLog:
    """Encoder readings: stamps (N,) s; position (N, 2), right and left, accumulated metres."""

    stamps: Array
    position_m: Array

    def at(self, stamps: Array) -> Array:
        """Wheel positions (T, 2) interpolated at stamps (T,), m."""
        return np.stack([np.interp(stamps, self.stamps, p) for p in self.position_m.T], axis=1)


@dataclass(frozen=True)
class Log:
    """The readings of one sensor.

    Attributes
    ----------
    schema
        What the fields are.
    stamps
        (N,) s.
    values
        Each field: (N, *shape), or all rows (K, *shape) of a ragged one.
    splits
        (N + 1,): reading i has the rows splits[i]:splits[i + 1] of each ragged field. None if no
        field is ragged.
    """

    schema: Schema
    stamps: Array
    values: Mapping[str, Values]
    splits: Ints | None = None

    @classmethod
    def of(
        cls,
        sensor: Sensor,
        stamps: Array,
        splits: Ints | None = None,
        /,
        **values: Values,
    ) -> Log:
        """Log of a sensor's readings, with the types of its schema.

        Raises
        ------
        InputError
            If they do not fit the schema.
        """
        schema, _ = split_schema(sensor.schema)
        if set(values) != set(schema):
            kind = type(sensor).__name__
            raise InputError(f"a {kind} has the fields {[*schema]}, got {[*values]}")
        typed = {name: np.asarray(values[name], field.dtype) for name, field in schema.items()}
        log = cls(schema, stamps, typed, splits)
        log.check(type(sensor).__name__)
        return log

    def __getitem__(self, name: str) -> Values:
        """All values of a field."""
        return self.values[name]

    @property
    def known_splits(self) -> Ints:
        """The splits; InputError if no field is ragged."""
        return required(self.splits, "a log without ragged fields has no splits")

    def select(self, rows: Ints, stamps: Array) -> Log:
        """Log of these readings, at other stamps; none of its fields may be ragged."""
        values = {name: array[rows] for name, array in self.values.items()}
        return dataclasses.replace(self, stamps=stamps, values=values)

    def reading(self, row: int) -> Reading:
        """One reading, as arrays of its own, from which no way leads to the log."""
        rows = slice(*self.splits[row : row + 2]) if self.splits is not None else row
        return {
            name: detach(values[rows if self.schema[name].ragged else row])
            for name, values in self.values.items()
        }

    def check(self, where: str) -> None:
        """Check presence, type and shape of all arrays.

        Raises
        ------
        InputError
            Naming the field that does not fit the schema.
        """
        n, splits = len(self.stamps), self.splits
        require(
            self.stamps.shape == (n,) and self.stamps.dtype == np.float64,
            f"{where}.stamps must be float64 of shape (N,)",
        )
        require(
            any(f.ragged for f in self.schema.values()) == (splits is not None),
            f"{where}.splits must be there if a field is ragged, and only then",
        )
        n_rows = 0
        if splits is not None:
            require(
                splits.shape == (n + 1,) and splits.dtype == np.int64,
                f"{where}.splits must be int64 of shape ({n + 1},)",
            )
            require(
                splits[0] == 0 and not (np.diff(splits) < 0).any(),
                f"{where}.splits must begin at 0 and not decrease",
            )
            n_rows = int(splits[-1])
        for name, kind in self.schema.items():
            kind.check(self.values[name], n_rows if kind.ragged else n, f"{where}.{name}")


def log_of_readings(schema: Schema, stamps: Array, readings: Sequence[Reading], where: str) -> Log:
    """Log of single readings.

    Raises
    ------
    InputError
        If they do not fit the schema.
    """
    values = {
        name: field.stack([reading[name] for reading in readings], f"{where}.{name}")
        for name, field in schema.items()
    }
    ragged = [name for name, field in schema.items() if field.ragged]
    splits = None
    if ragged:
        first, *others = ragged
        sizes = [len(reading[first]) for reading in readings]
        for name in others:
            for size, reading in zip(sizes, readings, strict=True):
                require(
                    len(reading[name]) == size,
                    f"{where}.{name} has {len(reading[name])} rows in a reading, "
                    f"{where}.{first} {size}; they must be as many",
                )
        splits = np.cumsum([0, *sizes]).astype(np.int64)
    log = Log(schema, stamps, values, splits)
    log.check(where)
    return log


@dataclass(frozen=True)
class CommandLog:
    """Commands as given: from each stamp (N,) s on, v (m/s) and omega (rad/s), (N, 2)."""

    stamps: Array
    velocity: Array
