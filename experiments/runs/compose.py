"""Compose the configuration outside the Hydra application."""

from __future__ import annotations

from collections.abc import Sequence

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from omegaconf import OmegaConf

from experiments.runs.experiment import Config
from experiments.runs.version import ROOT


def compose(overrides: Sequence[str]) -> Config:
    """Resolved configuration as plain values, with Hydra's overrides applied."""
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        config = hydra_compose("config", overrides=list(overrides))
    resolved: Config = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
    return resolved
