"""Checks of estimators' options; an error names the key and what it may be."""

from __future__ import annotations

import math
from collections.abc import Mapping

from sim.errors import InputError


def require_choices(choices: Mapping[str, tuple[str, tuple[str, ...]]]) -> None:
    """Raise an InputError that names the first key whose value is not among those allowed."""
    for name, (value, allowed) in choices.items():
        if value not in allowed:
            raise InputError(f"estimator.{name} must be {' or '.join(allowed)}, got {value!r}")


def require_positive(**numbers: float) -> None:
    """Raise an InputError that names the first key whose number is negative or not finite."""
    for name, number in numbers.items():
        if not (math.isfinite(number) and number >= 0.0):
            raise InputError(f"estimator.{name} must be zero or positive, got {number}")
