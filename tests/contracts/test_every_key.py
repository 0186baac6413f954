"""Every key of conf/ changes a result, or is refused with a reason.

Each key of what an option names gets another value, and the recording or the estimates are made
again, as short as can be. `ACTS` says where a key acts that does not act in the usual drive, and
`NO_RESULT` which keys decide no result, and why.
"""

import hashlib
import types
from functools import cache
from typing import Annotated, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from omegaconf import OmegaConf

from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.paths import CONF
from experiments.runs.schema import GROUPS, KEYS, OPTIONS, TeamSettings, leaves
from sim.errors import InputError
from sim.options import find
from sim.recording import arrays_of, digest_of
from sim.robot.drive import DifferentialDrive
from tests.fixtures.key_tables import ACTS, BASES, NO_RESULT, PLACES, TRIED


def values_of(kind):
    """Values that a type names."""
    if get_origin(kind) is Literal:
        return get_args(kind)
    if get_origin(kind) in (Union, types.UnionType, Annotated):
        return [value for part in get_args(kind) for value in values_of(part)]
    return ()


def others(value, kind):
    """Other values that a key may take, the likely ones first."""
    named = [other for other in values_of(kind) if other != value]
    if named:
        return named
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, (int, float)):
        tried = [value * 2, value * 0.5, value + 1, value + 0.1, value - 1, 3, 0.3, -value, 0]
        return [other for other in tried if other != value]
    if isinstance(value, list) and all(isinstance(v, (int, float)) for v in value):
        return [[type(v)(2 * v + (v == 0)) for v in value]]
    return [0.5, 2, 33.0, 0.01, [0.5, 1.0], "true", [[1, 1], [3, 1], [3, 3]]]


def digest_of_recording(experiment):
    team = experiment.simulate_team()
    return "".join(digest_of(arrays_of(robot), {}) for robot in team.robots)


def digest_of_world(experiment):
    world = experiment.world()
    arrays = {k: v for k, v in vars(world).items() if isinstance(v, np.ndarray)}
    return digest_of(arrays | world.places, {})


def digest_of_estimates(experiment):
    """What the estimates are, and how the runs ended."""
    digest = hashlib.sha256()

    def note(_, __, *paths):
        for path in paths:
            if path is not None:
                for array in (path.stamps, path.means, path.covariances):
                    digest.update(np.ascontiguousarray(array).tobytes())

    for row in evaluate(experiment, on_estimate=note):
        digest.update(f"{row['status']} {row['status_code']}".encode())
        digest.update(repr(sorted((k, v) for k, v in row.items() if "rmse" in k)).encode())
    return digest.hexdigest()


DIGESTS = {"world": digest_of_world, "estimator": digest_of_estimates}


def acts(usual, experiment, leaf, kind, digests):
    """Whether another value of a key changes a result or is refused."""
    value = experiment.config
    for name in leaf:
        value = value[name]
    tried = TRIED.get(".".join(leaf)) or others(value, kind)
    refusals = 0
    for other in tried:
        changed = experiment.with_leaves([(leaf, other)])
        try:
            changed.check()
            if any(digest(changed) != was for digest, was in zip(digests, usual, strict=True)):
                return True
        except InputError:
            refusals += 1
    return refusals == len(tried)


def idle_keys(base, places, digests, option=""):
    """Keys below some places that change nothing and are not refused.

    Parameters
    ----------
    base
        Overrides of the experiment in which they are tried.
    """

    @cache
    def case(more):
        experiment = Experiment.compose([*base, *more])
        return experiment, [digest(experiment) for digest in digests]

    idle = set()
    for place in places(case(())[0]):
        settings = case(())[0].config
        for name in place.split("."):
            settings = settings[name]
        kinds = kinds_of(place, settings)
        for leaf, _ in leaves({"": settings}):
            key = ".".join((place, *leaf[1:]))
            if leaf[-1] == "_target_" or {key, f"{option} {key}"} & NO_RESULT.keys():
                continue
            experiment, usual = case(tuple(ACTS.get(f"{option} {key}", ACTS.get(key, ()))))
            kind = kinds.get(leaf[1]) if len(leaf) > 1 else None
            if not acts(usual, experiment, tuple(key.split(".")), kind, digests):
                idle.add(key)
    return idle


def kinds_of(place, settings):
    """Types of the keys of a place."""
    if not isinstance(settings, dict):
        return {}
    named = {**OPTIONS, "team": TeamSettings, "robot": DifferentialDrive}.get(place)
    if "_target_" in settings:
        named = find(settings["_target_"], place)
    return get_type_hints(named, include_extras=True)


def options_to_try():
    """One option of each class that conf/ names."""
    seen, options = set(), []
    for group in GROUPS:
        for path in sorted((CONF / group).glob("*.yaml")):
            text = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
            targets = frozenset(
                part["_target_"]
                for part in (text, *text.values())
                if isinstance(part, dict) and "_target_" in part
            )
            if (group, targets) not in seen:
                seen.add((group, targets))
                options.append(f"{group}={path.stem}")
    return options


@pytest.mark.slow
@pytest.mark.parametrize("option", [o for o in options_to_try() if o not in NO_RESULT])
def test_every_key_of_an_option_acts_or_is_refused(option):
    group = option.partition("=")[0]
    digests = [DIGESTS.get(group, digest_of_recording)]
    if group == "sensors":
        digests.append(digest_of_estimates)  # of what is believed of them

    def places(experiment):
        sensors = [f"sensors.{name}" for name in experiment.config["sensors"]]
        return sensors if group == "sensors" else [group]

    base = [*BASES.get(option, BASES[group]), option]
    assert idle_keys(base, places, digests, option) == set()


@pytest.mark.slow
@pytest.mark.parametrize("place", PLACES)
def test_every_other_key_acts_or_is_refused(place):
    digests = [digest_of_recording] if place in ("simulation", "people") else [digest_of_estimates]
    assert idle_keys(PLACES[place], lambda _: [place], digests) == set()


def test_no_key_is_left_out():
    """But those of other projects' methods, whose packages are extras."""
    keys = {*OmegaConf.load(CONF / "config.yaml"), *KEYS} - {"defaults", "hydra"}
    assert keys <= {*BASES, *PLACES, *NO_RESULT}
    folders = {path.name for path in CONF.iterdir() if path.is_dir()}
    assert folders == {*GROUPS, "study", "suite"}
    where_it_is_computed = {"plan", "job", "jobs"}  # tests/experiments/sweeps/test_plan.py
    assert {*OmegaConf.load(CONF / "job.yaml")} - {"defaults", "hydra"} == where_it_is_computed


def test_options_that_are_named_are_there():
    named = [key.split(" ")[0] for key in {*BASES, *NO_RESULT, *ACTS} if "=" in key]
    for group, _, name in (option.partition("=") for option in named):
        assert (CONF / group / f"{name}.yaml").exists(), f"{group}={name}"


def test_a_key_without_effect_is_found(monkeypatch):
    """Planted: a world that ignores one of its arguments."""
    monkeypatch.setitem(DIGESTS, "world", lambda _: "the same")
    base = [*BASES["world"], "world=room"]
    idle = idle_keys(base, lambda _: ["world"], [lambda _: "the same"])
    assert "world.width_m" in idle or len(idle) > 2
