"""The runs of a sweep: which there are, what each is called, and how they are packed into jobs.

The product of the swept values is never written out. Runs that differ only in plain values make
a Family: one configuration, and the values that change in it. A run is a number in its family.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from hydra.core.override_parser.types import Override, RangeSweep
from numpy.typing import NDArray
from omegaconf import DictConfig, ListConfig, OmegaConf

from experiments.runs.compose import (
    Composed,
    Composer,
    open_composer,
    parse_override,
    searched,
    set_value,
)
from experiments.runs.experiment import Experiment
from experiments.runs.key import decides_recording, leaf_digests
from experiments.runs.schema import Leaf, leaves, value_at
from sim.errors import InputError, require

Numbers = NDArray[np.int64]
Digests = NDArray[np.uint64]
_MOST_RUNS = 10**8  # of a sweep; a million take 0.3 GiB in the planner
_TOO_MANY = f"a sweep has at most {_MOST_RUNS:,} runs; give fewer values, or several sweeps"
_UNNAMED = "run"  # the default of conf/config.yaml
_MOST_CHECKED = 1000  # runs of a family that are checked before the first begins


@dataclass(frozen=True)
class Axis:
    """Values that a sweep gives to a key.

    Attributes
    ----------
    leaves
        The key's place, and those of the keys that follow it.
    values
        Plain values; a range is kept as one.
    """

    leaves: tuple[Leaf, ...]
    values: Sequence[Any]

    def digests(self, counts: Callable[[Leaf], bool] = lambda _: True) -> Digests:
        """What each value adds to a run's digest, beyond the first one; see `Experiment.key`.

        Parameters
        ----------
        counts
            Whether a leaf counts; by default all do.
        """
        counted = [counts(leaf) for leaf in self.leaves]
        found: Digests = self._each[counted].sum(axis=0, dtype=np.uint64)
        return found - found[:1]

    @functools.cached_property
    def _each(self) -> Digests:
        """Digest of each leaf with each value."""
        every = itertools.chain(*(leaf_digests(leaf, self.values) for leaf in self.leaves))
        shape = len(self.leaves), len(self.values)
        return np.fromiter(every, np.uint64, math.prod(shape)).reshape(shape)


@dataclass(frozen=True)
class Family:
    """Runs that differ only in plain values: the product of the axes.

    Attributes
    ----------
    first
        One run; the axes change its values.
    axes
        What changes; the last one changes fastest.
    """

    first: Experiment
    axes: tuple[Axis, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values of each axis."""
        return tuple(len(axis.values) for axis in self.axes)

    def experiment(self, number: int) -> Experiment:
        """One of the runs."""
        places = zip(self.axes, np.unravel_index(number, self.shape), strict=True)
        return self.first.with_leaves(
            (leaf, axis.values[int(place)]) for axis, place in places for leaf in axis.leaves
        )

    def keys(self) -> Digests:
        """Keys of all the runs, in the shape of the axes."""
        return _sums(self.experiment(0).key, [axis.digests() for axis in self.axes])

    def recordings(self) -> Digests:
        """A digest for each run that is the same for runs of the same recording."""
        counts = functools.partial(decides_recording, from_file=self.first.is_read)
        first = self.experiment(0).recording_key[:16]
        return _sums(first, [axis.digests(counts) for axis in self.axes])

    def spread(self, most: int = _MOST_CHECKED) -> list[int]:
        """All runs of a small family; of a large one, runs along each axis, its ends included."""
        if math.prod(self.shape) <= most:
            return list(range(math.prod(self.shape)))
        each = max(2, most // len(self.axes))
        found = {0}
        for i, length in enumerate(self.shape):
            for place in np.linspace(0, length - 1, min(each, length)).astype(int):
                at = [0] * len(self.axes)
                at[i] = int(place)
                found.add(int(np.ravel_multi_index(at, self.shape)))
        return sorted(found)

    def as_json(self, numbers: Numbers) -> Any:
        """The family and the numbers of some of its runs, as plain values."""
        axes = [
            [a.leaves, {"range": [a.values.start, a.values.stop, a.values.step]}]
            if isinstance(a.values, range)
            else [a.leaves, a.values]
            for a in self.axes
        ]
        return [self.first.config, self.first.choices, axes, numbers.tolist()]

    @classmethod
    def experiments(cls, stored: Any) -> Iterator[Experiment]:
        """Runs of what `as_json` gave."""
        config, choices, axes, numbers = stored
        family = cls(
            Experiment(config, choices),
            tuple(
                Axis(
                    tuple(map(tuple, leaves)),
                    range(*values["range"]) if isinstance(values, dict) else values,
                )
                for leaves, values in axes
            ),
        )
        return map(family.experiment, numbers)


@dataclass(frozen=True)
class Plan:
    """All runs of a sweep, in the order of the arguments.

    Attributes
    ----------
    families
        What they are made of.
    family, number
        (N,) family of each run, and its number there.
    keys
        (N,) `Experiment.key` as a number.
    recordings
        (N,) the same for runs of the same recording.
    """

    families: Sequence[Family]
    family: Numbers
    number: Numbers
    keys: Digests
    recordings: Digests

    def experiment(self, i: int) -> Experiment:
        """One of the runs."""
        return self.families[int(self.family[i])].experiment(int(self.number[i]))

    def name_by(self, arguments: Sequence[str], config_dir: str | None) -> Plan:
        """The plan, with a name of its own where none is given: a digest of its arguments.

        So the same command goes on where it stopped, and two sweeps do not pool their rows.

        Raises
        ------
        InputError
            If its runs have several names.
        """
        names = {f.first.name for f in self.families}
        swept_keys = {leaf[0] for f in self.families for axis in f.axes for leaf in axis.leaves}
        for key in ("picture", "keep"):
            one = len({json.dumps(f.first.label(key)) for f in self.families}) == 1
            require(
                one and key not in swept_keys,
                f"{key} decides no result: give it one value, not several, in a sweep",
            )
        swept_ = any(("name",) in axis.leaves for f in self.families for axis in f.axes)
        require(
            len(names) == 1 and not swept_,
            "name is the folder of all the rows; a sweep has one, not several",
        )
        given = any(argument.lstrip("+").startswith("name=") for argument in arguments)
        if given or names != {_UNNAMED}:
            return self
        last = {argument.partition("=")[0]: argument for argument in arguments}  # that one is swept
        text = json.dumps([sorted(last.values()), config_dir and str(Path(config_dir).resolve())])
        name = f"sweep_{hashlib.sha256(text.encode()).hexdigest()[:8]}"
        families = [replace(f, first=f.first.with_values(name=name)) for f in self.families]
        return replace(self, families=families)

    def split(self, runs: Numbers, n_jobs: int) -> Iterator[tuple[int, list[Any]]]:
        """Pack runs into about `n_jobs` jobs: how many each has, and these as plain values."""
        for places in pack_jobs(self.recordings[runs], n_jobs):
            share = runs[places]
            changes = np.flatnonzero(np.diff(self.family[share])) + 1
            parts = np.split(share, changes)
            yield (
                len(share),
                [self.families[self.family[p[0]]].as_json(self.number[p]) for p in parts],
            )


def plan_experiments(
    arguments: Sequence[str], config_dir: str | None = None
) -> Iterator[Experiment]:
    """Runs of all combinations, in the order of the arguments."""
    plan = make_plan(arguments, config_dir)
    return map(plan.experiment, range(len(plan.keys)))


def make_plan(arguments: Sequence[str], config_dir: str | None = None) -> Plan:
    """Plan all combinations of a sweep's arguments.

    Raises
    ------
    InputError
        If an override is wrong, or a key is unknown.
    """
    with open_composer([*searched(config_dir), *arguments]) as composer:
        arguments = composer.words
        given = [parse_override(text) for text in arguments]
        fixed = [o.input_line or "" for o in given if not o.is_sweep_override()]
        study = composer.compose(fixed)
        parts = []
        for part in _sweeps(study.cfg):
            lines = [f"{key}={value}" for key, value in {**study.params, **part}.items()]
            parts.append(parse_swept([*lines, *arguments]))
        n_runs = sum(math.prod(map(len, part.values())) for part in parts)
        require(n_runs <= _MOST_RUNS, f"{n_runs:.3g} runs: {_TOO_MANY}")
        grids = [_grid(part, composer) for part in parts]
    families = [family for part in grids for family in part[0]]
    offsets = np.cumsum([0, *(len(part[0]) for part in grids)])
    return Plan(
        families,
        np.concatenate([part[1] + low for part, low in zip(grids, offsets, strict=False)]),
        *(np.concatenate([part[i] for part in grids]) for i in (2, 3, 4)),
    )


def _sweeps(study: DictConfig) -> Sequence[Mapping[str, Any]]:
    """The sweeps of a study; one of no further values if there are none."""
    sweeps = study.get("sweeps") or ListConfig([{}])
    sound = isinstance(sweeps, ListConfig) and all(isinstance(part, DictConfig) for part in sweeps)
    require(sound, f"sweeps must be a list of mappings of keys to values, got {sweeps}")
    return list(sweeps)


def parse_swept(lines: Sequence[str]) -> dict[str, Sequence[Any]]:
    """The swept values by key; a later line replaces an earlier one of its key.

    A plain number or truth value is given as such, a range of whole numbers as a range; what else
    there is, as the override's text.
    """
    choices: dict[str, Sequence[Any]] = {}
    for override in map(parse_override, lines):
        key = override.get_key_element()
        if override.is_delete():
            choices[key] = [override.input_line or key]
        elif not override.is_sweep_override():
            choices[key] = [f"{key}={override.get_value_element_as_str()}"]
        elif not override.is_discrete_sweep():
            raise InputError(
                f"{override.input_line}: a sweep takes lists and ranges of values, such as "
                f"{key}=0.1,0.2 or '{key}=range(0,1,0.1)'"
            )
        else:
            choices[key] = _values(override, key)
            require(len(choices[key]), f"{override.input_line}: no value; give one or more")
    return choices


def _values(override: Override, key: str) -> Sequence[Any]:
    """Values of a list, a range or a glob."""
    value = override.value()
    if isinstance(value, RangeSweep):
        require(value.step, f"{override.input_line}: the step of a range must not be 0")
        length = (value.stop - value.start) // value.step  # type: ignore[operator]
        require(length <= _MOST_RUNS, f"{override.input_line}: {_TOO_MANY}")
        whole = value.range()
        if isinstance(whole, range) and not value.shuffle:
            return whole
    elements = list(override.sweep_iterator())
    if all(isinstance(e, (int, float)) or e is None for e in elements):
        return elements
    return [f"{key}={text}" for text in override.sweep_string_iterator()]


def _grid(
    choices: Mapping[str, Sequence[Any]], composer: Composer
) -> tuple[list[Family], Numbers, Numbers, Digests, Digests]:
    """Families of the product, and of each run: family, number, key and recording."""
    shape = tuple(map(len, choices.values()))
    if not math.prod(shape):
        none, no_digest = np.zeros(0, np.int64), np.zeros(0, np.uint64)
        return [], none, none, no_digest, no_digest
    inner = [
        key for key in choices if len(choices[key]) > 1 and _may_follow(composer, key, choices)
    ]
    outer = [key for key in choices if key not in inner]
    texts = {key: [_text(key, value) for value in choices[key]] for key in outer}
    for combination in itertools.product(*texts.values()):  # an axis is one in all
        _, axes = _composed(composer, combination, {key: choices[key] for key in inner})
        for key in [key for key in inner if key not in axes]:
            inner.remove(key)
            outer.append(key)
    outer = [key for key in choices if key not in inner]
    texts = {key: [_text(key, value) for value in choices[key]] for key in outer}
    family, number = np.empty(shape, np.int64), np.empty(shape, np.int64)
    keys, recordings = np.empty(shape, np.uint64), np.empty(shape, np.uint64)
    families: list[Family] = []
    for places in itertools.product(*(range(len(choices[key])) for key in outer)):
        at = dict(zip(outer, places, strict=True))
        lines = [texts[key][place] for key, place in at.items()]
        found, axes = _composed(composer, lines, {key: choices[key] for key in inner})
        first = Experiment(*found.resolve()).with_values(picture=False)
        made = Family(first, tuple(axes[key] for key in inner))
        composer.check_values([axis.values for axis in made.axes])
        cells = tuple(at.get(key, slice(None)) for key in choices)
        family[cells] = len(families)
        number[cells] = np.arange(math.prod(made.shape)).reshape(made.shape)
        keys[cells], recordings[cells] = made.keys(), made.recordings()
        families.append(made)
    return families, family.ravel(), number.ravel(), keys.ravel(), recordings.ravel()


def _may_follow(composer: Composer, key: str, choices: Mapping[str, Sequence[Any]]) -> bool:
    """Whether a swept key's values are plain, and no other override is above or below it."""
    values = choices[key]
    overrides = [composer.parse(v) for v in values if isinstance(v, str)]
    return (
        not key.endswith("_target_")
        and all(
            composer.is_plain(o)
            and (isinstance(o.value(), (str, int, float)) or o.value() is None)
            and "${" not in str(o.value())
            for o in [*overrides, composer.parse(f"{key}=x")]
        )
        and not any(
            (other.startswith(f"{key}.") or key.startswith(f"{other}."))
            and composer.is_plain(composer.parse(f"{other}=x"))
            for other in choices
            if other[0] not in "+~"
        )
    )


def _composed(
    composer: Composer, overrides: Sequence[str], followed: Mapping[str, Sequence[Any]]
) -> tuple[Composed, dict[str, Axis]]:
    """Configuration with the first of the followed values; and the axes, where they can be.

    A key is an axis where all that depends on it takes its value unchanged, and where no file and
    no code is chosen by it.
    """
    found = composer.compose(overrides)
    cfg = found.cfg
    values = {
        key: each
        if isinstance(each, range)
        else [composer.parse(v).value() if isinstance(v, str) else v for v in each]
        for key, each in followed.items()
    }
    was_leaf = {key for key in values if not OmegaConf.is_config(value_at(cfg, key))}
    for key, each in values.items():
        set_value(cfg, key, each[0])
    following = _following(OmegaConf.to_container(cfg, resolve=False))
    axes = {}
    for key in was_leaf if following is not None else ():
        leaf = tuple(key.split("."))
        of_key = (leaf, *(following or {}).get(leaf, ()))
        if not any(map(_decides_more, of_key)):
            axes[key] = Axis(of_key, values[key])
    return found, axes


def _text(key: str, value: Any) -> str:
    """A swept value as an override."""
    return value if isinstance(value, str) else f"{key}={'null' if value is None else value}"


def _following(tree: Any) -> dict[Leaf, list[Leaf]] | None:
    """Leaves by the leaf whose value they take, `${robot.kr}`.

    None if a value is worked out in any other way, such as `${data}/map.npy`.
    """
    raw = dict(leaves(tree))
    found: dict[Leaf, list[Leaf]] = {}
    for leaf, value in raw.items():
        root, n_steps = leaf, 0
        while isinstance(value, (str, list)) and "${" in json.dumps(value):
            n_steps += 1
            whole = re.fullmatch(r"\$\{([\w.]+)\}", value) if isinstance(value, str) else None
            root = tuple(whole[1].split(".")) if whole else ()
            if root not in raw or n_steps > len(raw):  # a circle
                return None
            value = raw[root]
        if root != leaf:
            found.setdefault(root, []).append(leaf)
    return found


def _decides_more(leaf: Leaf) -> bool:
    """Whether a leaf decides more than its own value: a recording, code, or how rays are cast."""
    return leaf[0] in ("recording", "simulation") or leaf[-1] in ("_target_", "command")


def _sums(first: str, steps: Sequence[Digests]) -> Digests:
    """A digest plus every combination of the axes' steps, modulo 2^64."""
    total = np.array(int(first, 16), np.uint64)
    for step in steps:
        total = np.add.outer(total, step)
    return total


def pack_jobs(recordings: Digests, n_jobs: int) -> list[Numbers]:
    """Places of runs in about `n_jobs` jobs; those of one recording stay together if they can.

    Parameters
    ----------
    recordings
        (N,) the same for runs of the same recording.
    """
    _, first, group = np.unique(recordings, return_index=True, return_inverse=True)
    order = np.argsort(first[group], kind="stable")  # the recordings as they first appear
    edges = np.flatnonzero(np.diff(group[order], append=-1)) + 1
    size, low, jobs = max(1, -(-len(order) // n_jobs)), 0, []
    while low < len(order):
        fits = edges[np.searchsorted(edges, low + size, side="right") - 1]
        high = int(fits) if low < fits <= low + size else min(low + size, len(order))
        jobs.append(order[low:high])
        low = high
    return jobs
