"""The key `team` of a study: how many robots drive, what they know, and who talks to whom."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from estimators.team import Communication
from experiments.runs.schema import Config, unknown
from sim.errors import require
from sim.options import Count, options

_OWN = ("robot", "sensors", "route")  # groups in which a robot of a team may differ


@options("team")
class TeamSettings:
    """The key `team`."""

    size: Count
    """How many of the robots drive."""
    starts: Literal["known", "unknown"]
    """`known`: each robot has a prior. `unknown`: robot 0 alone has one."""
    communication: Communication
    """See `estimators.team.Communication`."""
    robots: list[dict[str, Any]]
    """For each robot, keys of `robot`, `sensors` and `route` in which it differs; {} for none."""

    def __post_init__(self) -> None:
        require(
            self.size <= len(self.robots),
            f"team.size must be from 1 to the {len(self.robots)} of team.robots, got {self.size}",
        )
        require(
            self.starts == "known" or self.communication.kind != "never",
            "team.starts=unknown: a robot that hears nothing of the others is never placed; set "
            "another team.communication",
        )


def own_config(config: Config, settings: TeamSettings, number: int) -> Config:
    """Configuration of one of the robots, which has no key `team`.

    Raises
    ------
    InputError
        If the robot has a key that its group has not.
    """
    own = {key: value for key, value in config.items() if key != "team"}
    for group, values in settings.robots[number].items():
        where = f"team.robots[{number}].{group}"
        require(group in _OWN, f"unknown key {where}; known: {', '.join(_OWN)}")
        require(isinstance(values, Mapping), f"{where} must hold keys, got {values!r}")
        for key in values:
            known = (f"{where}.{name}" for name in own[group])
            require(key in own[group], unknown(f"{where}.{key}", known))
        own[group] = {**own[group], **values}
    return own
