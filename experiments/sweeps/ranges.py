"""What a study's YAML says of its tuning: a budget, seeds, and a range for each option."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, Strict

from sim.errors import require
from sim.options import build, options

FIRST_JUDGED_SEED = 1000  # below 100 are those to tune on (claims are judged from here on)

Scalar = float | int | str | bool | None
Interval = Annotated[
    Annotated[tuple[int, int], Strict(False)] | Annotated[tuple[float, float], Strict(False)],
    "two numbers, the lower first",
]
Seed = Annotated[int, Field(ge=0, le=99)]


@options("range")
class Range:
    """Values that an option may take: an interval, or a choice."""

    interval: Interval | None = None
    """Its ends, included; whole numbers if both ends are."""
    log: bool = False
    """Whether an interval is even in the log."""
    choice: Annotated[
        tuple[Scalar, ...], Strict(False), Field(min_length=2), "a list of two plain values or more"
    ] = ()
    """The values of a choice."""
    default: Any = None
    """Of a program's setting: the value that the program takes if none is given."""

    def __post_init__(self) -> None:
        require(
            bool(self.choice) != bool(self.interval) and not (self.log and self.choice),
            "range.interval or range.choice: give {interval: [low, high]}, perhaps with log: true, "
            "or {choice: [a, b]}",
        )
        if self.interval is not None:
            low, high = self.interval
            require(
                low < high, f"range.interval must be two numbers, the lower first, got {low, high}"
            )
            require(not self.log or low > 0, "range.interval in the log must begin above 0")

    def has(self, value: Any) -> bool:
        """Whether an option may take a value."""
        if self.interval is None:
            return value in self.choice
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        return number and self.interval[0] <= value <= self.interval[1]


@options("tune")
class Tuning:
    """The `tune` of a study."""

    trials: Annotated[int, Field(ge=2)]
    """Settings that are tried for every estimator, the default included."""
    seeds: Annotated[
        tuple[Seed, ...],
        Strict(False),
        Field(min_length=1),
        f"different whole numbers from 0 to 99 (those from {FIRST_JUDGED_SEED} on are judged)",
    ]
    """Of the recordings that it is tuned on."""
    estimators: Annotated[
        dict[str, Annotated[dict[str, Any], Field(min_length=1)]],
        Field(min_length=1),
        "a mapping of estimators to ranges of their options",
    ]
    """By name, the `Range` of each of its options."""

    def __post_init__(self) -> None:
        require(len(set(self.seeds)) == len(self.seeds), f"tune.seeds has one twice: {self.seeds}")
        for name, ranges in self.estimators.items():
            for key, settings in ranges.items():
                ranges[key] = build(Range, settings, f"tune.estimators.{name}.{key}")
