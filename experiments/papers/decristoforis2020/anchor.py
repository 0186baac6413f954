"""The configuration at free settings, and at a claim's anchor."""

from collections.abc import Mapping
from typing import Any

from experiments.judging.free_settings import free_settings
from experiments.papers.decristoforis2020.settings import (
    HALVINGS,
    ONE_DEGREE_BEAMS,
    QUARTER_HZ,
    TURNS_HZ,
)


def anchored(claim: str) -> list[str]:
    """Overrides of the configuration at a claim's anchor."""
    anchor = free_settings("decristoforis2020")[claim].anchor
    return overrides_at(anchor.settings if anchor else {})


def overrides_at(values: Mapping[str, Any]) -> list[str]:
    """Overrides at free settings: both wheels slip alike, and the laser has its beams' turns."""
    given = [f"{name}={value}" for name, value in values.items() if name != HALVINGS]
    if "robot.kr" in values:
        given.append(f"robot.kl={values['robot.kr']}")
    if HALVINGS in values:
        rate_hz = TURNS_HZ / 2.0 ** int(values[HALVINGS])
        given.append(f"sensors.laser.rate_hz={rate_hz}")
        given += [f"sensors.laser.n_beams={ONE_DEGREE_BEAMS}"] * (rate_hz > QUARTER_HZ)
    return given
