"""The key `team` of a study: how many robots drive, what they know, and who talks to whom."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from estimators.team import Communication
from sim.errors import require
from sim.options import build

OWN = ("robot", "sensors", "route")  # groups in which a robot of a team may differ


@dataclass(frozen=True)
class TeamSettings:
    """The key `team`.

    Attributes
    ----------
    size
        How many of the robots drive.
    starts
        `known`: each robot has a prior. `unknown`: robot 0 alone has one.
    communication
        See `estimators.team.Communication`.
    robots
        For each robot, keys of `robot`, `sensors` and `route` in which it differs.
    """

    size: int
    starts: Literal["known", "unknown"]
    communication: Communication
    robots: list[Mapping[str, Any]]

    def __post_init__(self) -> None:
        require(
            self.starts in ("known", "unknown"),
            f"team.starts must be known or unknown, got {self.starts!r}",
        )
        require(
            isinstance(self.robots, list) and all(isinstance(r, Mapping) for r in self.robots),
            f"team.robots must list the keys of each robot, {{}} for none, got {self.robots!r}",
        )
        require(
            1 <= self.size <= len(self.robots),
            f"team.size must be from 1 to the {len(self.robots)} of team.robots, got {self.size}",
        )
        require(
            self.starts == "known" or self.communication.kind != "never",
            "team.starts=unknown: a robot that hears nothing of the others is never placed; set "
            "another team.communication",
        )


def team_settings(given: Any) -> TeamSettings:
    """Read the key `team`.

    Raises
    ------
    InputError
        If a key is missing or unknown, or a value makes no sense.
    """
    return build(TeamSettings, given, "team")


def own_config(config: Mapping[str, Any], settings: TeamSettings, number: int) -> dict[str, Any]:
    """Configuration of one of the robots, which has no key `team`.

    Raises
    ------
    InputError
        If the robot has a key that its group has not.
    """
    own = {key: value for key, value in config.items() if key != "team"}
    for group, values in settings.robots[number].items():
        where = f"team.robots[{number}].{group}"
        require(group in OWN, f"unknown key {where}; known: {', '.join(OWN)}")
        require(isinstance(values, Mapping), f"{where} must hold keys, got {values!r}")
        for key in values:
            known = ", ".join(own[group])
            require(key in own[group], f"unknown key {where}.{key}; known: {known}")
        own[group] = {**own[group], **values}
    return own
