"""An estimator in any language: a child process that replies to each JSON line with one.

docs/programs.md is the protocol. The program never gets the truth: a message holds what a Frame
does, and the first what the Prior does.
"""

import dataclasses
from typing import Any

import numpy as np
import orjson

from estimators.base import Belief, Estimate, Prior, since_start
from estimators.programs.program import (
    Program,
    ProgramError,
    ProgramOptions,
    Seconds,
    draw_seed,
    explain_mismatch,
    map_message,
    start,
)
from sim.arrays import Array
from sim.errors import describe_unknown
from sim.formats.trajectory import FARTHEST_M, sound_covariances
from sim.options import options
from sim.recording import Frame
from sim.sensors.base import sensor_settings

PROTOCOL = 1
_KEYS = ("mean", "covariance", "status", "means", "covariances", "stamps")  # of answers
_STEP_BYTES, _FINISH_BYTES = 1 << 20, 1 << 28  # of an answer


@options("estimator")
class ExternalOptions(ProgramOptions):
    """Options of a program that is asked Frame by Frame."""

    start_s: Seconds = 30.0
    """Longest time for the answer to `reset`, s."""
    step_s: Seconds = 10.0
    """Longest time for the answer to a Frame, s."""
    finish_s: Seconds = 600.0
    """Longest time for the answer to `finish`, s."""


class External(ExternalOptions):
    """Ask a child process for each belief."""

    program_seconds = 0.0
    _program: Program | None = None

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start the program, and tell it what is known."""
        message = {"type": "reset", **self._introduce(prior, rng)}
        if self._program is not None:
            self._program.close()
        self._program, self._stamps = self._start(), list[float]()
        self._ask(message, self.start_s, "reset")

    def _start(self) -> Program:
        return start(self.words)

    def _introduce(self, prior: Prior, rng: np.random.Generator) -> dict[str, Any]:
        """What is known at the start."""
        return {
            "protocol": PROTOCOL,
            "seed": draw_seed(rng),
            "robot": dataclasses.asdict(prior.robot),
            "sensors": {name: sensor_settings(one) for name, one in prior.sensors.items()},
            "prior": prior.start and vars(prior.start),
            "map": map_message(prior.map),
        }

    def step(self, frame: Frame) -> Belief:
        """Send the Frame, and take the belief that comes back."""
        message = {"type": "frame", **vars(frame)}
        answer = self._ask(message, self.step_s, self._named(frame))
        self._check_keys(answer)
        mean = self._numbers(answer, "mean", (3,))
        covariance = np.zeros((3, 3))
        if answer.get("covariance") is not None:
            covariance = self._covariances(answer, "covariance", (3, 3))
        status = answer.get("status")
        return Belief(mean, covariance, {} if status is None else {"status": str(status)[:300]})

    def _named(self, frame: Frame) -> str:
        """The Frame that comes next, by its time, for messages."""
        self._stamps.append(frame.stamp)
        return f"the Frame at {since_start(self._stamps, -1)}"

    def finish(self) -> Estimate | None:
        """Ask for a revised trajectory, which there may be, and let the program end."""
        answer = self._ask({"type": "finish"}, self.finish_s, "finish", _FINISH_BYTES)
        self._check_keys(answer)
        found = None
        if answer.get("means") is not None:
            n = len(answer["means"]) if isinstance(answer["means"], list) else 0
            stamps = np.array(self._stamps)
            if answer.get("stamps") is not None:
                stamps = self._numbers(answer, "stamps", (n,))
            covariances = np.zeros((n, 3, 3))
            if answer.get("covariances") is not None:
                covariances = self._covariances(answer, "covariances", (n, 3, 3))
            means = self._numbers(answer, "means", (len(stamps), 3))
            if not len(stamps) or (np.diff(stamps) <= 0.0).any():
                raise self._wrong("must answer with stamps that increase, and some")
            if why := explain_mismatch(stamps, self._stamps):
                raise self._wrong(f"must answer with stamps of the Frames; its path {why}")
            found = Estimate(stamps, means, covariances, "revised")
        assert self._program is not None
        self.program_seconds = self._program.close()
        return found

    def _ask(
        self, message: Any, limit_s: float, what: str, most_bytes: int = _STEP_BYTES
    ) -> dict[str, Any]:
        assert self._program is not None
        self._asked = what
        try:
            text = self._program.ask(self._encode(message), limit_s, most_bytes)
        except ProgramError as error:
            raise ProgramError(f"{error} (asked: {what})") from error
        try:
            answer = self._decode(text)
        except ValueError:
            answer = None
        if not isinstance(answer, dict):
            shown = text[:60].decode(errors="replace")
            raise self._wrong(f"got {shown!r}, which is not a JSON object")
        if answer.get("error") is not None:
            raise self._wrong(f"the error {str(answer['error'])[:300]}")
        return answer

    @staticmethod
    def _encode(message: Any) -> bytes:
        return orjson.dumps(message, option=orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_APPEND_NEWLINE)

    @staticmethod
    def _decode(data: bytes) -> Any:
        return orjson.loads(data)

    def _check_keys(self, answer: dict[str, Any]) -> None:
        for key in answer:
            if key not in _KEYS:
                raise self._wrong(describe_unknown(key, _KEYS))

    def _numbers(self, answer: dict[str, Any], key: str, shape: tuple[int, ...]) -> Array:
        """Numbers of an answer, of a shape."""
        try:
            found = np.array(answer.get(key), object)
        except ValueError:  # ragged
            found = np.zeros(0, object)
        if not {int, float}.issuperset(map(type, found.flat)) or found.shape != shape:
            sizes = " x ".join(map(str, shape))
            raise self._wrong(
                f"must answer with {key}, {sizes} numbers; got {answer.get(key)!r:.60}"
            )
        numbers = found.astype(np.float64)
        if np.abs(numbers).max(initial=0.0) > FARTHEST_M:
            raise self._wrong(f"must answer with {key}, numbers up to {FARTHEST_M:g}")
        return numbers

    def _covariances(self, answer: dict[str, Any], key: str, shape: tuple[int, ...]) -> Array:
        found = self._numbers(answer, key, shape)
        if not sound_covariances(found.reshape(-1, 3, 3)).all():
            raise self._wrong(
                f"must answer with {key}, symmetric and without a negative variance; leave out "
                "unknown values"
            )
        return found

    def _wrong(self, what: str) -> ProgramError:
        assert self._program is not None
        self._program.close(0.0)
        return ProgramError(f"{self._program.name}, asked for {self._asked}: {what}")
