"""What a calibration returns."""

import dataclasses
import json
from dataclasses import dataclass

from experiments.evaluation.statistics import Interval

_UNITS = {"kr": "m", "kl": "m", "bias_right": "", "bias_left": "", "track_m": "m"}


@dataclass(frozen=True)
class CalibrationResult:
    """Parameters of a robot, with 95 % intervals.

    Attributes
    ----------
    method
        `wheel_truth`, `sampled` or `linearised`.
    kr, kl
        Slip variance per metre, m.
    bias_right, bias_left
        The encoder reads (1 + bias) times the ground travel; None if assumed to be zero.
    track_m
        Effective distance of the wheels; None if assumed to be the nominal one.
    n_used
        Number of intervals or runs used.
    """

    method: str
    kr: Interval
    kl: Interval
    bias_right: Interval | None
    bias_left: Interval | None
    track_m: Interval | None
    n_used: int

    @property
    def found(self) -> dict[str, Interval]:
        """The parameters that were estimated, by name."""
        parameters = {name: getattr(self, name) for name in _UNITS}
        return {name: value for name, value in parameters.items() if value is not None}

    def as_json(self) -> str:
        """One JSON object: each parameter with its interval, null where it was not estimated."""
        return json.dumps(dataclasses.asdict(self), indent=2)

    def as_text(self) -> str:
        """One line a parameter."""
        lines = [f"{self.method.replace('_', ' ')}, from {self.n_used} samples"]
        for name, found in self.found.items():
            interval = f"[{found.low:.4g}, {found.high:.4g}]"
            lines.append(f"  {name:<10} {found.value:12.5g} {interval:>26} {_UNITS[name]}".rstrip())
        return "\n".join(lines)
