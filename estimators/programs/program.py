"""A program of any language as a child process: asked line by line, within limits.

It runs in a process group of its own, which is ended as a whole. Whatever it does (crash, silence,
another line than asked for, too many) becomes a `ProgramError`, and never a wait without end.
"""

import fcntl
import os
import re
import selectors
import shlex
import shutil
import signal
import subprocess
import time
import weakref
from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from estimators.peers import MissingPackageError
from sim.arrays import Array
from sim.errors import InputError, printable, require
from sim.options import options
from sim.worlds.grid import OccupancyGrid
from sim.worlds.world import World

Seconds = Annotated[float, Field(gt=0.0, le=1e6)]  # the longest that something may take

PEERS_PROGRAM = "build/peers/mrpt"  # of the estimators mrpt_*
_TAIL = 2000  # bytes of its messages that are kept
_CHUNK = 1 << 16
_PATIENCE_S = 2.0  # to end by itself once its input is closed
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class ProgramError(Exception):
    """A program did not do what was asked of it; the run's Status says what."""


@options("estimator")
class ProgramOptions:
    """Options of every program that is an estimator."""

    command: Any = None
    """The program and its arguments, a list such as [./my_filter, --fast], or a line."""
    global_or_grid: bool = False
    """Whether `estima conform` compares it in distribution when the world is moved."""

    def __post_init__(self) -> None:
        if shutil.which(name := self.words[0]) is None:
            remedy = "`make peers` compiles it" if name == PEERS_PROGRAM else "give its path"
            raise MissingPackageError(
                f"estimator.command: no program {name} that can be run; {remedy}"
            )

    @cached_property
    def words(self) -> list[str]:
        """The command's words, as a shell reads a line."""
        command = self.command
        try:
            words = shlex.split(command) if isinstance(command, str) else command
        except ValueError as error:
            raise InputError(f"estimator.command: {error}; got {command!r}") from error
        texts = isinstance(words, Sequence) and words and all(isinstance(w, str) for w in words)
        require(
            texts,
            "estimator.command must be a program and its arguments, such as [python3, mine.py], "
            f"got {command!r}",
        )
        return list(words)


class Program:
    """A child process.

    Parameters
    ----------
    words
        The program and its arguments.
    """

    def __init__(self, words: Sequence[str]) -> None:
        self.name = os.path.basename(words[0])
        environment = {k: v for k, v in os.environ.items() if not k.startswith("ESTIMA_")}
        environment = {**dict.fromkeys(_ONE_THREAD, "1"), **environment}
        try:
            self._process = subprocess.Popen(
                words,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,
                env=environment,
            )
        except (OSError, ValueError) as error:
            raise ProgramError(f"{self.name} cannot be started ({error})") from error
        pipes: Any = (self._process.stdin, self._process.stdout, self._process.stderr)
        self._stdin, self._stdout, self._stderr = (pipe.fileno() for pipe in pipes)
        self._selector = selectors.DefaultSelector()
        for pipe in (self._stdin, self._stdout, self._stderr):
            fcntl.fcntl(pipe, fcntl.F_SETFL, fcntl.fcntl(pipe, fcntl.F_GETFL) | os.O_NONBLOCK)
        for pipe in (self._stdout, self._stderr):
            self._selector.register(pipe, selectors.EVENT_READ)
        self._said, self._messages = bytearray(), bytearray()
        self._finalizer = weakref.finalize(self, _end, self._process, 0.0)

    def ask(self, line: bytes, limit_s: float, most_bytes: int) -> bytes:
        """Write a line, and read the one line of the answer.

        Raises
        ------
        ProgramError
            If none comes within the limits.
        """
        deadline = time.monotonic() + limit_s
        self._read_ready(0.0)
        if self._said:
            raise self._error(f"wrote {_quoted(self._said)} without being asked")
        unsent = self._written(memoryview(line))
        while b"\n" not in self._said:
            if len(self._said) > most_bytes:
                raise self._error(f"wrote more than {most_bytes} bytes in one line")
            left_s = deadline - time.monotonic()
            if left_s <= 0.0:
                raise self._error(f"gave no answer within {limit_s:g} s")
            if self._stdout not in self._selector.get_map():
                raise self._error("closed its output")
            if unsent and self._stdin not in self._selector.get_map():
                self._selector.register(self._stdin, selectors.EVENT_WRITE)
            ready = self._read_ready(left_s)
            if unsent and self._stdin in ready:
                unsent = self._written(unsent)
                if not unsent:
                    self._selector.unregister(self._stdin)
        answer, _, rest = bytes(self._said).partition(b"\n")
        if rest:
            raise self._error(f"wrote {_quoted(rest)} after its answer {_quoted(answer)}")
        self._said.clear()
        return answer

    def wait(self, limit_s: float) -> None:
        """Wait until the program ends; what it writes is passed over.

        Raises
        ------
        ProgramError
            If it does not end within the limit, or not with code 0.
        """
        self._process.stdin.close()  # type: ignore[union-attr]
        deadline = time.monotonic() + limit_s
        while (code := _ended(self._process)) is None:
            if time.monotonic() > deadline:
                raise self._error(f"did not end within {limit_s:g} s")
            if self._selector.get_map():
                self._read_ready(0.02)
            else:  # it closed its output, and may go on
                time.sleep(0.02)
            self._said.clear()
        if code != 0:
            raise self._error("failed")

    def spent_s(self) -> float:
        """Processor time that it has taken so far, s; without that of processes it started."""
        return time.clock_gettime((~self._process.pid << 3) | 2)  # CPUCLOCK_SCHED of a process

    def close(self, patience_s: float = _PATIENCE_S) -> float:
        """Let it end, with its whole process group; return the processor time that it took, s.

        What has not ended by itself by then is ended. Of processes that it started, those count
        for which it waited.
        """
        self._selector.close()
        with suppress(OSError):
            self._process.stdin.close()  # type: ignore[union-attr]
        spent_s: float | None = self._finalizer.detach() and _end(self._process, patience_s)
        return spent_s or 0.0

    def _written(self, unsent: memoryview) -> memoryview:
        try:
            return unsent[os.write(self._stdin, unsent) :]
        except BlockingIOError:
            return unsent
        except OSError:  # it ended; what it said comes first
            return unsent[len(unsent) :]

    def _read_ready(self, timeout_s: float) -> set[int]:
        """Read what is there, or wait for it; return the pipes that were ready."""
        ready = {key.fd for key, _ in self._selector.select(timeout_s)}
        for pipe, kept in ((self._stderr, self._messages), (self._stdout, self._said)):
            if pipe not in ready:
                continue
            part = os.read(pipe, _CHUNK)
            kept += part
            if not part:
                self._selector.unregister(pipe)
        del self._messages[:-_TAIL]
        return ready

    def _error(self, what: str) -> ProgramError:
        """Error that says what went wrong, how the program ended, and its last message."""
        for _ in range(20):  # so that a crash is told as such
            if (code := _ended(self._process)) is not None:
                what = f"ended with code {code}" if code >= 0 else f"was ended by signal {-code}"
                break
            if what != "closed its output":
                break
            time.sleep(0.01)
        with suppress(OSError):
            self._messages += os.read(self._stderr, _CHUNK)[-_TAIL:]
        lines = self._messages.decode(errors="replace").strip().splitlines()
        self.close(0.0)
        last = f": {printable(lines[-1])[:300]}" if lines else ""
        return ProgramError(f"{self.name} {what}{last}")


def _ended(process: subprocess.Popen[bytes]) -> int | None:
    """Exit code of a process that has ended and is not reaped; None while it runs."""
    if process.returncode is not None:
        return process.returncode
    found = os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG)
    if found is None:
        return None
    return found.si_status if found.si_code == os.CLD_EXITED else -found.si_status


def _end(process: subprocess.Popen[bytes], patience_s: float) -> float:
    """End a process and its group; return its processor time, s."""
    deadline = time.monotonic() + patience_s
    while _ended(process) is None and time.monotonic() < deadline:
        time.sleep(0.002)
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)  # before it is reaped, while the number is its own
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    for pipe in (process.stdin, process.stdout, process.stderr):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()
    return usage.ru_utime + usage.ru_stime


def _quoted(text: bytes | bytearray) -> str:
    return repr(re.sub(r"\s+", " ", bytes(text[:60]).decode(errors="replace")))


def draw_seed(rng: np.random.Generator) -> int:
    """Seed for a program, from which that of the study cannot be got by trying.

    It comes from the generator's seed sequence, which `estimators.base.detach` hides.
    """
    return int(rng.bit_generator.seed_seq.generate_state(1)[0])


def map_message(known_map: Any) -> dict[str, Any] | None:
    """A map as plain arrays: a world's walls and landmarks, or a grid; where it starts is left out.

    Raises
    ------
    InputError
        For a map of another kind.
    """
    if known_map is None:
        return None
    if isinstance(known_map, World):
        keys = ("walls", "wall_z_m", "landmarks", "descriptors")
        return {"kind": "world", **{k: np.ascontiguousarray(getattr(known_map, k)) for k in keys}}
    if isinstance(known_map, OccupancyGrid):
        fields = {k: np.ascontiguousarray(v) if isinstance(v, np.ndarray) else v
                  for k, v in vars(known_map).items()}  # fmt: skip
        return {"kind": "grid", **fields}
    raise InputError(
        f"a program takes a world or a grid as its map, got a {type(known_map).__name__}; set "
        "prior.map=none, world or GRID.yaml"
    )


def explain_mismatch(stamps: Array, frame_stamps: Sequence[float]) -> str:
    """Why an answer's stamps are not those of the Frames; empty if they overlap."""
    first, last = frame_stamps[0], frame_stamps[-1]
    if stamps[0] <= last and stamps[-1] >= first:
        return ""
    spans = (f"{a:.13g} to {b:.13g} s" for a, b in ((stamps[0], stamps[-1]), (first, last)))
    return "is from {}, the Frames from {}".format(*spans)
