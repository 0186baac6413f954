"""An estimator in a process of its own, which never holds the truth: `isolated=true`.

`Isolated` stands for it where the recording is, sends each Frame over a pipe and takes a belief
back; `main` runs it at the other end, in a fork of a clean process (`forked.py`). Arrays go as
their bytes (`wire.py`), so that the results are those of an estimator in this process, to the last
bit.
"""

import dataclasses
import json
import sys
from collections.abc import Collection, Mapping
from typing import Any, BinaryIO

import numpy as np

from estimators.base import Belief, Estimate, Prior, read_belief
from estimators.programs.external import External
from estimators.programs.forked import Forked
from estimators.programs.program import Program, ProgramError
from estimators.programs.wire import HEAD_BYTES, decode, encode, measure
from estimators.topological.topological_map import TopologicalMap
from sim.arrays import Values
from sim.errors import InputError, printable, require
from sim.options import build, find
from sim.recording import Frame
from sim.robot.drive import RobotGeometry
from sim.sensors.base import (
    RecordedSensor,
    schema_from_meta,
    sensor_settings,
    sensors_from_config,
    sensors_from_meta,
)
from sim.worlds.grid import OccupancyGrid
from sim.worlds.world import World

_MAPS = {kind.__name__: kind for kind in (World, OccupancyGrid, TopologicalMap)}
_LIMIT_S, _BYTES = 3600.0, 1 << 28  # of an answer


class Isolated(External):
    """Ask an estimator in a child process.

    Parameters
    ----------
    settings
        Its class, `_target_`, and options; this process does not import it.
    keep
        Names of the Belief extras that are sent back.
    """

    def __init__(self, settings: Mapping[str, Any], keep: Collection[str] = ()) -> None:
        super().__init__(
            command=[sys.executable], start_s=_LIMIT_S, step_s=_LIMIT_S, finish_s=_LIMIT_S
        )
        self._settings, self._keep = dict(settings), [*keep, "status"]

    def _start(self) -> Program:
        module = str(self._settings["_target_"]).rpartition(".")[0]
        ours = module.startswith("estimators.")
        return Program("the estimator", Forked(main, module if ours else __name__), measure)

    def _introduce(self, prior: Prior, rng: np.random.Generator) -> dict[str, Any]:
        """What is known at the start, and the generator."""
        seeds: Any = rng.bit_generator.seed_seq
        sensors = prior.sensors.items()
        return {
            "keep": self._keep,
            "robot": dataclasses.asdict(prior.robot),
            "sensors": {name: sensor_settings(one) for name, one in sensors},
            "schemas": {
                name: {key: dataclasses.asdict(field) for key, field in one.schema.items()}
                for name, one in sensors
                if isinstance(one, RecordedSensor)
            },
            "mean": prior.mean,
            "covariance": prior.covariance,
            "map": _sent_map(prior.map),
            "generator": json.dumps([seeds.entropy, rng.bit_generator.state]),
        }

    def step(self, frame: Frame) -> Belief:
        """Send the Frame, and take the belief that comes back."""
        message = {"type": "frame", **vars(frame)}
        answer = self._ask(message, self.step_s, self._named(frame))
        extras = answer.get("extras")
        return Belief(
            answer.get("mean"),  # type: ignore[arg-type]
            answer.get("covariance"),  # type: ignore[arg-type]
            extras if isinstance(extras, dict) else {},
        )

    @property
    def map(self) -> dict[str, Values] | None:
        """Map that the estimator has made so far."""
        asked = {"type": "map"}
        return None if self._program is None else _taken_map(self._ask(asked, self.step_s, "map"))

    def finish(self) -> Estimate | None:
        """Ask for the revised estimate, which there may be, and let the process end."""
        answer = self._ask({"type": "finish"}, self.finish_s, "finish")
        assert self._program is not None
        self.program_seconds = self._program.spent_s() - self._start_up_s
        self._program.close(0.0)
        if answer.get("stamps") is None:
            return None
        if (kind := answer.get("kind")) not in ("online", "revised"):
            raise ProgramError("the estimate of finish must be online or revised")
        parts = (answer.get(name) for name in ("stamps", "means", "covariances"))
        stamps, means, covariances = (np.asarray(part, np.float64) for part in parts)
        status = str(answer.get("status"))
        return Estimate(stamps, means, covariances, kind, map=_taken_map(answer), status=status)

    def _ask(
        self, message: Any, limit_s: float, what: str, most_bytes: int = _BYTES
    ) -> dict[str, Any]:
        """Ask; the estimator is made before `reset`, and what it took to start does not count."""
        if message["type"] == "reset":
            self._ask({"type": "make", "estimator": self._settings}, limit_s, "its constructor")
            assert self._program is not None
            self._start_up_s = self._program.spent_s()
        answer = super()._ask(message, limit_s, what, most_bytes)
        if answer.get("refused") is not None:
            raise InputError(printable(str(answer["refused"])))
        return answer

    _encode, _decode = staticmethod(encode), staticmethod(decode)


def _sent_map(known_map: Any) -> dict[str, Any] | None:
    if known_map is None:
        return None
    kind = type(known_map)
    require(
        kind in _MAPS.values(),
        f"isolated=true sends a {', '.join(_MAPS)} as a map, and prior.map is a {kind.__name__}",
    )
    return {"kind": kind.__name__} | {
        field.name: getattr(known_map, field.name) for field in dataclasses.fields(known_map)
    }


def _taken_map(answer: Mapping[str, Any]) -> dict[str, Values] | None:
    """Arrays of a map, by name; None of anything else."""
    made = answer.get("map")
    arrays = isinstance(made, dict) and all(isinstance(v, np.ndarray) for v in made.values())
    return made if arrays else None


# In the child


class Host:
    """The estimator at its end of the pipe."""

    def reply(self, message: dict[str, Any]) -> dict[str, Any]:
        """Answer to a message."""
        kind = message.pop("type")
        if kind == "make":
            return self._make(**message["estimator"])
        if kind == "reset":
            return self._reset(message)
        if kind == "frame":
            return self._step(Frame(**message))
        if kind == "map":
            return {"map": _map_arrays(getattr(self._estimator, "map", None))}
        found = self._estimator.finish() if hasattr(self._estimator, "finish") else None
        if found is None:
            return {}
        names = ("stamps", "means", "covariances", "kind", "status")
        return {name: getattr(found, name) for name in names} | {"map": _map_arrays(found.map)}

    def _make(self, _target_: str, **options: Any) -> dict[str, Any]:
        try:
            self._estimator = find(_target_, "estimator")(**options)
        except (TypeError, ValueError) as error:
            complaint = f"estimator ({_target_}) does not accept its values: {error}"
            raise InputError(complaint) from error
        self._who = type(self._estimator).__name__
        return {}

    def _reset(self, told: dict[str, Any]) -> dict[str, Any]:
        self._keep = told["keep"]
        schemas = {name: schema_from_meta(each) for name, each in told["schemas"].items()}
        recorded = {name: told["sensors"][name] for name in schemas}
        others = {name: told["sensors"][name] for name in told["sensors"] if name not in schemas}
        sensors = sensors_from_config(others) | sensors_from_meta(recorded, schemas)
        entropy, state = json.loads(told["generator"])
        generator = np.random.PCG64(entropy)
        generator.state = state
        mean, covariance = (_own(told[name]) for name in ("mean", "covariance"))
        prior = Prior(
            build(RobotGeometry, told["robot"], "robot"),
            {name: sensors[name] for name in told["sensors"]},
            mean,
            covariance,
            _map_from(told["map"]),
        )
        self._estimator.reset(prior, np.random.Generator(generator))
        return {}

    def _step(self, frame: Frame) -> dict[str, Any]:
        belief = self._estimator.step(frame)
        mean, covariance = read_belief(belief, self._who)
        kept = {name: belief.extras[name] for name in self._keep if name in belief.extras}
        extras = {k: v if isinstance(v, str) else np.asarray(v) for k, v in kept.items()}
        return {"mean": mean, "covariance": covariance, "extras": extras}


def _own(part: Any) -> Any:
    """An estimator's own copy, to which it may write."""
    if isinstance(part, dict):
        return {name: _own(value) for name, value in part.items()}
    return part.copy() if isinstance(part, np.ndarray) else part


def _map_from(told: Any) -> Any:
    if told is None:
        return None
    fields = _own(told)
    return _MAPS[fields.pop("kind")](**fields)


def _map_arrays(made: Any) -> Any:
    return {k: np.asarray(v) for k, v in made.items()} if isinstance(made, dict) else None


def main(asked: BinaryIO, answers: BinaryIO) -> None:
    """Answer message by message."""
    host = Host()
    while begin := asked.read(HEAD_BYTES):
        try:
            answer = encode(host.reply(decode(begin + asked.read(measure(begin) - HEAD_BYTES))))
        except Exception as error:
            refused = isinstance(error, InputError)
            text = str(error) if refused else f"{type(error).__name__}: {error}"
            answer = encode({"refused" if refused else "error": " ".join(text.split())})
        answers.write(answer)
        answers.flush()
