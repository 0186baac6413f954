"""Compose configurations with Hydra: options of groups first, then defaults, then plain values."""

from __future__ import annotations

import functools
import re
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override
from hydra.errors import OverrideParseException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import InterpolationKeyError, OmegaConfBaseException

from experiments.runs import paths
from experiments.runs.calibration import mean_slip, read_calibrations
from experiments.runs.console import TRUSTING
from experiments.runs.schema import (
    GROUPS,
    KEYS,
    Config,
    check_shape,
    compose_files,
    describe_unknown_key,
    fill,
    leaves,
    value_at,
)
from experiments.runs.targets import named_code
from sim.errors import InputError, describe_unknown, naming, printable, require
from sim.files import read_text, sha256_of, write_text
from sim.yaml_file import read_yaml

_SEARCHED = "hydra.searchpath="
_OF_STUDIES = ("study", "sweeps", "tune", "team")  # top-level keys beside those of a run
_READ_OF_HYDRA = ("hydra/launcher", "hydra.launcher", "hydra.searchpath")
_REMEDIES = {  # by the beginning of a setting that nothing reads
    "hydra/sweeper": "-m runs every combination of the values; an optimizer may call estima.sweep "
    "from Python",
    "hydra.sweeper": "give the values themselves, such as seed=1,2",
    "hydra.verbose": "nothing is logged; a failed run's row says how",
    "": "rows go to results/runs/NAME: set name, or ESTIMA_RESULTS for another folder",
}


@dataclass(frozen=True)
class Composed:
    """A composed configuration, whose interpolations are not resolved.

    Attributes
    ----------
    cfg
        The configuration, filled up with the defaults of what it names.
    choices
        Name of the chosen option of each configuration group.
    params
        `hydra.sweeper.params` of a study's file: values by key, as texts.
    """

    cfg: DictConfig
    choices: Mapping[str, str]
    params: Mapping[str, str]

    def resolve(self) -> tuple[Config, dict[str, str]]:
        """Plain values, and the choice of each group.

        Raises
        ------
        InputError
            If a key is missing, or is not a mapping where it must be one.
        """
        _believe(self.cfg)
        try:
            config: Config = OmegaConf.to_container(self.cfg, resolve=True)  # type: ignore[assignment]
        except InterpolationKeyError as error:
            raise InputError(
                f"{error.full_key} follows a key that is missing: {str(error).splitlines()[0]}; "
                f"keep that key, or set {error.full_key} too"
            ) from error
        for of_sweeps in ("sweeps", "tune"):
            config.pop(of_sweeps, None)
        check_shape(config)
        simulation = config["simulation"]
        if simulation.get("rays") is None:
            kinematic = simulation.get("physics") == "kinematic"  # it has no engine to cast rays
            simulation["rays"] = "exact" if kinematic else "bullet"
        # an option of a folder, such as peers/kiss_icp, is called by its last part
        named = {group: str(self.choices.get(group)).rpartition("/")[2] for group in GROUPS}
        return config, named


class Composer:
    """Compose many configurations that share most of their choices.

    Hydra composes each choice of options once; plain values are then put in place.

    Parameters
    ----------
    words
        The user's overrides, which may name study files.
    data
        Further overrides, from a row or a suite's file. Neither they nor study files may name code.
    source
        Where `data` come from.
    """

    def __init__(
        self, words: Sequence[str] = (), data: Sequence[str] = (), source: object = ""
    ) -> None:
        named, studies = name_study_files(words)
        others, more = name_study_files(data)
        studies |= more
        self._source = source if data else next(iter(studies), None)
        self._own = frozenset(_code_of_user(named) if self._source is not None else ())
        searching = [word for word in [*named, *others] if word.startswith(_SEARCHED)]
        check_overrides(searching)
        self.words = [word for word in [*named, *others] if word not in searching]
        self.extra = _merged(
            [*searching, *(searched(folder)[0] for folder in studies.values())],
            only_folders=bool(data),
        )
        self.parse = functools.lru_cache(maxsize=4096)(parse_override)
        self._is_group: dict[str, bool] = {}
        self._bases: dict[tuple[str, ...], Composed] = {}

    def compose(self, overrides: Sequence[str]) -> Composed:
        """Compose a configuration.

        Raises
        ------
        InputError
            If an override names an unknown key.
        """
        check_overrides(overrides)
        each = [self.parse(override) for override in overrides]
        for override in each:
            require(
                not override.is_sweep_override(),
                f"{override.input_line}: several values; add -m to run each, or quote a text that "
                f"has commas: \"{override.key_or_group}='...'\"",
            )
        for key in [o.key_or_group for o in each] if self._source is not None else ():
            require(not key.startswith("hydra"), f"{self._source}: {key} cannot be set by a file")
        options, plain = ([o for o in each if self.is_plain(o) == kind] for kind in (False, True))
        base = self._base(options, [o for o in plain if o.key_or_group.endswith("_target_")])
        _check_calibrated(each)
        cfg = base.cfg.copy()
        for override in plain:
            key = override.key_or_group
            chosen = base.choices.get(key.partition(".")[0])
            with naming(f"estimator={chosen}") if key.startswith("estimator.") else nullcontext():
                set_value(cfg, key, override.value())
        self._check(cfg)
        if any(isinstance(o.value(), dict) for o in plain):
            fill(cfg)
        return Composed(cfg, base.choices, base.params)

    def _check(self, cfg: DictConfig) -> None:
        """Check what data name, before anything that it names is imported."""
        if self._source is not None:
            try:
                self.check_values(OmegaConf.to_container(cfg, resolve=True))
            except OmegaConfBaseException:  # a key that is given later
                self.check_values(OmegaConf.to_container(cfg, resolve=False))

    def check_values(self, tree: Any) -> None:
        """Check that what data put into a configuration names no code.

        Raises
        ------
        InputError
            If it does, and the user has not said that it is trusted.
        """
        if self._source is None or paths.is_trusting():
            return
        strange = named_code(tree) - _targets_of_conf() - self._own
        require(
            not strange,
            f"{self._source} names code to run, {min(strange, default='')}; {TRUSTING}",
        )

    def _base(self, options: Sequence[Override], targets: Sequence[Override]) -> Composed:
        """The configuration of some options, and of targets in place of theirs, filled up."""
        key = tuple(o.input_line or "" for o in (*options, *targets))
        if key not in self._bases:
            composed = compose_files([o.input_line or "" for o in options], self.extra)
            cfg, choices = composed.cfg, composed.choices
            _check_added(options, {choice.partition("@")[0] for choice in choices})
            require(
                not isinstance(cfg.get("study"), DictConfig),
                f"study={choices.get('study')}: its keys would not be those of the run; make its "
                "first line `# @package _global_`",
            )
            for override in targets:
                set_value(cfg, override.key_or_group, override.value())
            self._check(cfg)
            _check_stated(cfg, choices.get("study"))
            fill(cfg)
            for override in options:
                deleted = override.is_delete() and value_at(cfg, override.key_or_group) is not None
                require(
                    not deleted,
                    f"{override.input_line}: {override.key_or_group} cannot be left out; set it",
                )
            self._bases[key] = Composed(cfg, choices, composed.params)
        return self._bases[key]

    def is_plain(self, override: Override) -> bool:
        """Whether it only sets a value, rather than choosing an option or adding a key."""
        key, adds = override.key_or_group, override.is_add() or override.is_force_add()
        if adds or override.is_delete() or key.startswith("hydra."):
            return False
        if key not in self._is_group:
            # as the loader's get_group_options, which copies all sources first, at 10 ms a key
            sources = GlobalHydra.instance().config_loader().get_sources()
            self._is_group[key] = any(
                source.is_group(key) and source.list(key, ObjectType.CONFIG) for source in sources
            )
        return not self._is_group[key]


@contextmanager
def open_composer(
    words: Sequence[str] = (), data: Sequence[str] = (), source: object = ""
) -> Iterator[Composer]:
    """Yield a composer of the project's configuration and of words; see `Composer`."""
    with initialize_config_dir(str(paths.CONF), version_base="1.3"):
        yield Composer(words, data, source)


def _merged(searching: Sequence[str], *, only_folders: bool) -> list[str]:
    """One override in place of several that make Hydra look for options elsewhere too."""
    places = [place for word in searching for place in _places(parse_override(word))]
    for place in places if only_folders else ():
        require(place.startswith("file://"), f"hydra.searchpath: {place} is not a folder")
    return [f"{_SEARCHED}[{','.join(map(paths.quoted, places))}]"] if places else []


@functools.cache
def _targets_of_conf() -> frozenset[str]:
    """Every class and function that a file of conf/ names; data may name them too."""
    texts = (path.read_text(encoding="utf-8") for path in paths.CONF.rglob("*.yaml"))
    return frozenset(name for text in texts for name in re.findall(r"_target_: *([\w.]+)", text))


def _places(override: Override) -> list[str]:
    """Folders in which an override makes Hydra look; none of another override."""
    value = override.value() if override.key_or_group == "hydra.searchpath" else None
    return list(map(str, value)) if isinstance(value, list) else []


def _code_of_user(words: Sequence[str]) -> Iterator[str]:
    """Code that the user names: in words, by the options they choose, in folders of options."""
    for override in map(parse_override, words):
        key, values = override.key_or_group, [override.value()]
        if isinstance(values[0], ChoiceSweep):
            texts = override.sweep_string_iterator()
            values = [parse_override(f"{key}={text}").value() for text in texts]
        for value in values:
            yield from named_code({key.rpartition(".")[2]: value})
            if key in GROUPS and isinstance(value, str):
                option = paths.CONF / key / f"{value}.yaml"
                yield from named_code(read_yaml(option)) if option.is_file() else ()
        for place in _places(override):
            folder = Path(place.removeprefix("file://"))
            for path in (path for group in GROUPS for path in (folder / group).rglob("*.yaml")):
                yield from named_code(read_yaml(path))


def find_option(group: str, name: str, config_dir: str | Path | None = None) -> str:
    """The option of a group that has this name, such as `peers/kiss_icp`; else the name itself."""
    folders = [paths.CONF, *([Path(config_dir)] if config_dir else [])]
    every = (option for folder in folders for option in paths.option_names(group, folder))
    return next((option for option in every if option.rpartition("/")[2] == name), name)


def compose_options(overrides: Sequence[str]) -> DictConfig:
    """A configuration, not resolved, of overrides that may name a study's file."""
    with open_composer(overrides) as composer:
        return composer.compose(composer.words).cfg


def parse_override(text: str) -> Override:
    """One override of Hydra's grammar; InputError if it is none."""
    known = GlobalHydra.instance()  # knows which keys are groups
    parser = OverridesParser.create(known.config_loader() if known.is_initialized() else None)
    try:
        (override,) = parser.parse_overrides([text])
    except OverrideParseException as error:
        raise InputError(
            f"{printable(text)}: not KEY=VALUE; close all brackets and quotes, leave no item "
            "empty, and put quotes round what holds other characters"
        ) from error
    return override


def set_value(cfg: DictConfig, key: str, value: Any) -> None:
    """Set a key that the configuration has.

    Raises
    ------
    InputError
        If it has none of that name.
    """
    parent, _, leaf = key.rpartition(".")
    node = value_at(cfg, parent) if parent else cfg
    names: Collection[Any] = node.keys() if isinstance(node, DictConfig) else ()
    if isinstance(node, ListConfig):
        names = [str(place) for place in range(len(node))]
    if leaf not in names:
        raise InputError(describe_unknown_key(key, cfg))
    OmegaConf.update(cfg, key, value, merge=True)


def _believe(cfg: DictConfig) -> None:
    """Put the slip of a calibration in the place of a simulated robot's."""
    given = cfg.get("calibration")
    if given is None:
        return
    given = OmegaConf.to_object(given) if isinstance(given, ListConfig) else given
    slip = mean_slip(read_calibrations(given))
    require(
        cfg.get("recording") is not None,
        "calibration belongs to a real log: set recording too, made by `estima convert LOG -o "
        "FILE.npz`",
    )
    for key in ("kr", "kl"):
        OmegaConf.update(cfg, f"robot.{key}", slip[key])
    if cfg.estimator.get("forward_slip_m") == 0.0:
        OmegaConf.update(cfg, "estimator.forward_slip_m", slip["forward_slip_m"])


def searched(config_dir: str | Path | None) -> list[str]:
    """Override that makes Hydra look for options in another folder too; none for None.

    Raises
    ------
    InputError
        If the folder does not exist, or the YAML of one of its options cannot be read.
    """
    if config_dir is None:
        return []
    folder = Path(config_dir).resolve()
    require(folder.is_dir(), f"{config_dir}: no such folder of options")
    require("${" not in str(folder), f"{folder}: Hydra takes ${{ for a value; rename the folder")
    for path in folder.glob("*.yaml"):
        if re.search(r"^_target_:", read_text(path), re.M):
            raise InputError(f"{path}: an option lies in the folder of its group, as estimator/")
    for group in (*GROUPS, "study"):
        for path in sorted((folder / group).rglob("*.yaml")):
            _check_option(path)
    return [f"{_SEARCHED}[{paths.quoted(f'file://{folder}')}]"]


def name_study_files(overrides: Sequence[str]) -> tuple[list[str], dict[Path, Path]]:
    """Overrides in which `study=FILE.yaml` is a name, and by file the folder that has its copy.

    Hydra knows an option by its name in a folder of its group. A file of conf/ is an option.

    Raises
    ------
    InputError
        If the file does not exist, or its keys would not be those of the configuration.
    """
    named: list[str] = []
    copies: dict[Path, Path] = {}
    for override in overrides:
        path = Path(override.removeprefix("study="))
        if not override.startswith("study=") or path.suffix != ".yaml":
            named.append(override)
            continue
        require(path.exists(), f"{override}: no such file")
        place, own = path.resolve(), paths.CONF.resolve() / "study"
        if place.is_relative_to(own):
            named.append(f"study={place.relative_to(own).with_suffix('').as_posix()}")
            continue
        _check_option(path)  # what is wrong is said of the file, not of its copy
        text = read_text(path)
        copies[path] = paths.results() / "cache" / "studies" / sha256_of(path)[:16]
        write_text(copies[path] / "study" / path.name, text)
        named.append(f"study={path.stem}")
    return named, copies


def _check_option(path: Path) -> None:
    """Check an option's file within bounds, which Hydra does not know.

    It has none of Hydra's settings that nothing here reads.
    """
    option = read_yaml(path)
    option = {} if option is None else option
    require(
        isinstance(option, dict) and all(isinstance(key, str) for key in option),
        f"{path}: an option holds keys and their values",
    )
    defaults = option.get("defaults")
    entries = [e for e in defaults if isinstance(e, dict)] if isinstance(defaults, list) else []
    set_here = [group for entry in entries for group in entry if "/hydra/" in str(group)]
    set_here += [
        ".".join(map(str, leaf))
        for leaf, value in leaves({"hydra": option.get("hydra")})
        if value not in (None, {}) and leaf[:3] != ("hydra", "sweeper", "params")
    ]
    require(
        not set_here,
        f"{path}: {''.join(set_here[:1])}: of Hydra's settings a file's hydra.sweeper.params alone "
        "has an effect; give hydra/launcher and hydra.launcher on the command line",
    )


def _check_calibrated(overrides: Sequence[Override]) -> None:
    """Check that a calibration's slip is not set as if the robot were simulated."""
    calibrated = any(o.key_or_group == "calibration" and o.value() is not None for o in overrides)
    for override in overrides if calibrated else ():
        key = override.key_or_group.removeprefix("robot.")
        require(
            override.key_or_group not in ("robot.kr", "robot.kl"),
            f"{override.input_line}: the calibration has its own {key}; set estimator.{key} to "
            "believe another, or leave calibration out",
        )


def _check_added(overrides: Sequence[Override], groups: Collection[str]) -> None:
    """Check that no override adds a key that nothing reads.

    A study's YAML may have keys of its own; the command line sets those without a +.
    """
    for override in overrides:
        if override.is_add() or override.is_force_add():
            key = override.key_or_group.partition(".")[0]
            require(key in KEYS or override.key_or_group in groups, describe_unknown(key, KEYS))


def _check_stated(cfg: DictConfig, study: str | None) -> None:
    """Check that a study's keys are read, or its own: labels, and what other keys follow."""
    known = (*KEYS, *_OF_STUDIES)
    for key, value in cfg.items_ex(resolve=False):
        is_label = not isinstance(value, DictConfig | ListConfig)
        if key in known or (is_label and not get_close_matches(str(key), known, cutoff=0.75)):
            continue
        require(
            re.search(rf"\$\{{{key!s}\b", OmegaConf.to_yaml(cfg)),
            f"study={study}: {describe_unknown(str(key), known)}",
        )


def check_overrides(overrides: Sequence[str]) -> None:
    """Check what Hydra itself does not.

    Each override has a key, groups have names, and of Hydra's own settings there are only those
    that are read here.

    Raises
    ------
    InputError
        Naming the override, and what to do instead.
    """
    for text in overrides:
        key = text.lstrip("+~").partition("=")[0]
        known = f"; a file? recording={text} takes it" if Path(text).suffix else f", as {key}=1"
        require("=" in text or text[:1] == "~", f"{text}: write KEY=VALUE{known}")
        remedy = next(said for start, said in _REMEDIES.items() if key.startswith(start))
        require(
            re.match(r"hydra\b", key) is None or key.startswith(_READ_OF_HYDRA),
            f"{text}: {key} has no effect here; {remedy}",
        )
        digits = sys.get_int_max_str_digits()
        require(
            re.search(rf"\d{{{digits + 1}}}", text) is None,
            f"{text[:40]}...: a number of more than {digits} digits; shorten it",
        )
    for override in map(parse_override, overrides):
        key, value = override.key_or_group, override.value()
        require(key, f"{override.input_line}: no key before the =")
        if key == "hydra.searchpath" and isinstance(value, list):
            for entry in value:
                scheme, _, place = str(getattr(entry, "text", entry)).rpartition("://")
                there = scheme not in ("", "file") or Path(place).is_dir()
                require(there, f"{override.input_line}: no folder {place}")
        named = override.is_sweep_override() or (isinstance(value, str) and value)
        listed = (
            f"; for one run each, -m {key}={value[0]},..."
            if isinstance(value, list) and value
            else ""
        )
        require(
            named or override.is_delete() or key not in (*GROUPS, "study"),
            f"{override.input_line}: {key} must name one of `estima options {key}`{listed}",
        )
