"""The runs of a sweep: expand the swept values, compose each combination, pack them into jobs."""

import itertools
from collections.abc import Iterator, Mapping, Sequence

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, ListConfig, OmegaConf

from experiments.runs import paths
from experiments.runs.console import unknown_key
from experiments.runs.experiment import Experiment, check_overrides, composed, searched
from sim.errors import InputError


def planned(arguments: Sequence[str], config_dir: str | None = None) -> Iterator[Experiment]:
    """Runs of all combinations, in the order of the arguments."""
    with initialize_config_dir(str(paths.CONF), version_base="1.3"):
        composer = _Composer(config_dir)
        composer.extra += [a for a in arguments if a.lstrip("+~").startswith("hydra.")]
        arguments = [a for a in arguments if a not in composer.extra]
        given = OverridesParser.create().parse_overrides(list(arguments))
        fixed = [o.input_line or "" for o in given if not o.is_sweep_override()]
        check_overrides(fixed)
        study = compose("config", overrides=composer.extra + fixed, return_hydra_config=True)
        params: dict[str, str] = dict(study.hydra.sweeper.get("params") or {})
        for part in study.get("sweeps") or [{}]:
            lines = [f"{key}={value}" for key, value in {**params, **part}.items()]
            for overrides in combinations([*lines, *arguments]):
                yield composer.experiment(overrides)


def combinations(lines: Sequence[str]) -> Iterator[list[str]]:
    """Every combination of the swept values; a later line replaces an earlier one of its key."""
    choices: dict[str, list[str]] = {}
    for override in OverridesParser.create().parse_overrides(list(lines)):
        key = override.get_key_element()
        if not override.is_sweep_override():
            choices[key] = [f"{key}={override.get_value_element_as_str()}"]
        elif override.is_discrete_sweep():
            choices[key] = [f"{key}={value}" for value in override.sweep_string_iterator()]
        else:
            raise InputError(f"{override.input_line}: only lists and ranges of values can be swept")
        if override.is_delete():
            choices[key] = [override.input_line or key]
    for combination in itertools.product(*choices.values()):
        yield list(combination)


class _Composer:
    """Compose many configurations that share most of their choices.

    Hydra composes each choice of options once; plain values are then put in place.
    """

    def __init__(self, config_dir: str | None) -> None:
        self._is_group: dict[str, bool] = {}
        self._bases: dict[tuple[str, ...], tuple[DictConfig, Mapping[str, str]]] = {}
        self.extra = searched(config_dir)

    def experiment(self, overrides: list[str]) -> Experiment:
        """Resolve one combination."""
        parsed = OverridesParser.create().parse_overrides(overrides)
        plain = [o for o in parsed if self._is_plain(o)]
        options = tuple(o.input_line or "" for o in parsed if not self._is_plain(o))
        if options not in self._bases:
            self._bases[options] = composed([*self.extra, *options])
        base, choices = self._bases[options]
        cfg = base.copy()
        OmegaConf.set_struct(cfg, True)
        for override in plain:
            key = override.key_or_group
            if not _has(cfg, key):
                raise InputError(unknown_key(key, cfg))
            OmegaConf.update(cfg, key, override.value(), merge=True)
        return Experiment.resolved(cfg, choices).replaced(picture=False)

    def _is_plain(self, override: Override) -> bool:
        """Whether it only sets a value, rather than choosing an option or adding a key."""
        if override.is_add() or override.is_force_add() or override.is_delete():
            return False
        key = override.key_or_group
        if key not in self._is_group:  # slow to ask for
            loader = GlobalHydra.instance().config_loader()
            self._is_group[key] = bool(loader.get_group_options(key))
        return not self._is_group[key]


def _has(cfg: DictConfig, key: str) -> bool:
    """Whether the configuration has the key, even if its value is still missing."""
    parent, _, leaf = key.rpartition(".")
    node = OmegaConf.select(cfg, parent) if parent else cfg
    if isinstance(node, ListConfig):
        return leaf.isdecimal() and int(leaf) < len(node)
    return isinstance(node, DictConfig) and leaf in node.keys()  # noqa: SIM118 `in node` says no to ???


def packed(runs: Sequence[Experiment], n_jobs: int) -> list[list[Experiment]]:
    """Runs in about `n_jobs` jobs; those of one recording stay together while there are enough."""
    groups: dict[str, list[Experiment]] = {}
    for run in runs:
        groups.setdefault(run.recording_key, []).append(run)
    size = max(1, -(-len(runs) // n_jobs))
    jobs: list[list[Experiment]] = [[]]
    for group in groups.values():
        for part in (group[low : low + size] for low in range(0, len(group), size)):
            if jobs[-1] and len(jobs[-1]) + len(part) > size:
                jobs.append([])
            jobs[-1] += part
    return jobs
