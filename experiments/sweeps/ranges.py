"""What a study's YAML says of its tuning: a budget, seeds, and a range for each option."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sim.errors import require

FIRST_JUDGED_SEED = 1000  # below 100 are those to tune on (claims are judged from here on)
_LAST_TUNING_SEED = 99

Scalar = float | int | str | bool | None


@dataclass(frozen=True)
class Range:
    """Values that an option may take: an interval, or a choice.

    Attributes
    ----------
    low, high, log
        Of an interval, ends included; whole numbers if both ends are. `log`: even in the log.
    choice
        The values of a choice; empty for an interval.
    """

    low: float = 0.0
    high: float = 0.0
    log: bool = False
    choice: tuple[Scalar, ...] = ()

    @classmethod
    def of(cls, where: str, settings: Any) -> Range:
        """Read `{interval: [low, high], log: true}` or `{choice: [a, b, ...]}`."""
        wanted = "{interval: [low, high]}, perhaps with log: true, or {choice: [a, b]}"
        keys = set(settings) if isinstance(settings, Mapping) else set()
        sound = keys in ({"interval"}, {"interval", "log"}, {"choice"})
        require(sound, f"{where} must be {wanted}, got {settings!r}")
        if "choice" in keys:
            choice = settings["choice"]
            plain = isinstance(choice, Sequence) and not isinstance(choice, str)
            plain = plain and all(
                v is None or isinstance(v, (bool, int, float, str)) for v in choice
            )
            require(
                plain and len(choice) > 1,
                f"{where}.choice must be a list of two plain values or more, got {choice!r}",
            )
            return cls(choice=tuple(choice))
        ends, log = settings["interval"], settings.get("log", False)
        numbers = isinstance(ends, Sequence) and len(ends) == 2 and all(map(_is_number, ends))
        require(
            numbers and ends[0] < ends[1],
            f"{where}.interval must be two numbers, the lower first, got {ends!r}",
        )
        require(isinstance(log, bool), f"{where}.log must be true or false, got {log!r}")
        require(not log or ends[0] > 0, f"{where}: an interval in the log begins above 0")
        return cls(ends[0], ends[1], log)

    @property
    def whole(self) -> bool:
        """Whether it is an interval of whole numbers."""
        return isinstance(self.low, int) and isinstance(self.high, int)

    def has(self, value: Any) -> bool:
        """Whether a value lies in it."""
        return value in self.choice or (_is_number(value) and self.low <= value <= self.high)


@dataclass(frozen=True)
class Tuning:
    """The `tune` of a study.

    Attributes
    ----------
    trials
        Settings that are tried for every estimator, the default included.
    seeds
        Of the recordings that it is tuned on, below 100.
    estimators
        By name, the ranges of its options.
    """

    trials: int
    seeds: tuple[int, ...]
    estimators: Mapping[str, Mapping[str, Range]]

    @classmethod
    def of(cls, study: str, settings: Any) -> Tuning:
        """Read it from a study's YAML.

        Raises
        ------
        InputError
            Naming the key, and what it must hold.
        """
        keys = ("trials", "seeds", "estimators")
        sound = isinstance(settings, Mapping) and set(settings) == set(keys)
        require(
            sound,
            f"study={study}: tune must hold {', '.join(keys)}, got "
            f"{sorted(settings) if isinstance(settings, Mapping) else settings!r}; see "
            "conf/study/peers.yaml",
        )
        trials, seeds, estimators = (settings[key] for key in keys)
        require(
            _is_whole(trials) and trials >= 2,
            f"tune.trials must be a whole number, at least 2, got {trials!r}",
        )
        own = isinstance(seeds, Sequence) and all(map(_is_whole, seeds))
        own = own and all(0 <= seed <= _LAST_TUNING_SEED for seed in seeds)
        require(
            own and len(set(seeds)) == len(seeds) > 0,
            f"tune.seeds must be a list of different whole numbers from 0 to {_LAST_TUNING_SEED}, "
            f"got {seeds!r}: those from {FIRST_JUDGED_SEED} on are judged",
        )
        require(
            isinstance(estimators, Mapping) and len(estimators) > 0,
            f"tune.estimators must map estimators to ranges of their options, got {estimators!r}",
        )
        ranges = {}
        for name, options in estimators.items():
            where = f"tune.estimators.{name}"
            some = isinstance(options, Mapping) and len(options) > 0
            require(some, f"{where} must map options to ranges, got {options!r}")
            ranges[name] = {key: Range.of(f"{where}.{key}", r) for key, r in options.items()}
        return cls(trials, tuple(seeds), ranges)


def _is_number(value: Any) -> bool:
    plain = isinstance(value, (int, float)) and not isinstance(value, bool)
    return plain and math.isfinite(value)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
