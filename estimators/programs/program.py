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
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Protocol

import numpy as np
from pydantic import Field

from estimators.peers import MissingPackageError
from sim.arrays import Array
from sim.errors import InputError, printable, require
from sim.options import options
from sim.worlds.grid import OccupancyGrid
from sim.worlds.world import World

Seconds = Annotated[float, Field(gt=0.0, le=1e6)]  # the longest that something may take

MRPT_PROGRAM, AMCL_PROGRAM = "build/peers/mrpt", "build/peers/amcl"
_COMPILED = {MRPT_PROGRAM: "make peers", AMCL_PROGRAM: "make peers NAV2=FOLDER"}  # by what
_TAIL = 2000  # bytes of its messages that are kept
_CHUNK = 1 << 16
_SAID = 20  # lines of its messages, of which one is shown
# Line of an error, which not all languages put last
_ERROR = re.compile(r"[\w.]*(Error|Exception): |what\(\): |panic: |ERROR: |FATAL: ")
_PATIENCE_S = 2.0  # to end by itself once its input is closed
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


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
            how = _COMPILED.get(name)
            remedy = f"`{how}` compiles it" if how else "give its path"
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


def environment() -> dict[str, str]:
    """Variables of a program: none of this package's own, one thread unless more are set."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("ESTIMA_")}
    return {**dict.fromkeys(ONE_THREAD, "1"), **own}


class Process(Protocol):
    """A process that leads a group of its own, with its pipes."""

    stdin: Any
    stdout: Any
    stderr: Any
    pid: int

    def ended(self) -> int | None:
        """Exit code; None if it still runs."""
        ...

    def end(self) -> float:
        """End it with its group, however it goes; its processor time, s."""
        ...


class Started(subprocess.Popen[bytes]):
    """A process that this one starts by a command.

    Raises
    ------
    ProgramError
        If it cannot be started.
    """

    def __init__(self, words: Sequence[str]) -> None:
        pipe = subprocess.PIPE
        try:
            super().__init__(
                words,
                stdin=pipe,
                stdout=pipe,
                stderr=pipe,
                start_new_session=True,
                env=environment(),
            )
        except (OSError, ValueError) as error:
            name = os.path.basename(words[0])
            raise ProgramError(f"{name} cannot be started ({error})") from error

    def ended(self) -> int | None:
        """Exit code, whether it is reaped or not; None if it still runs."""
        if self.returncode is not None:
            return self.returncode
        found = os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG)
        if found is None:
            return None
        return found.si_status if found.si_code == os.CLD_EXITED else -found.si_status

    def end(self) -> float:
        """End it with its group, and reap it; its processor time, s."""
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)  # before it is reaped, while the number is its own
        _, status, usage = os.wait4(self.pid, 0)
        self.returncode = os.waitstatus_to_exitcode(status)
        return usage.ru_utime + usage.ru_stime


def measure_line(said: bytes | bytearray) -> int:
    """Bytes of the line that begins here; 0 while its end is not there."""
    return said.find(b"\n") + 1


class Program:
    """A child process that answers.

    Parameters
    ----------
    name
        What errors call it.
    measure
        Gives the bytes of the answer that begins here, or 0 while that is not known.
    """

    def __init__(
        self,
        name: str,
        process: Process,
        measure: Callable[[bytes | bytearray], int] = measure_line,
    ) -> None:
        self.name, self._process, self._measure = name, process, measure
        pipes: Any = (self._process.stdin, self._process.stdout, self._process.stderr)
        self._stdin, self._stdout, self._stderr = (pipe.fileno() for pipe in pipes)
        self._selector = selectors.DefaultSelector()
        for pipe in (self._stdin, self._stdout, self._stderr):
            fcntl.fcntl(pipe, fcntl.F_SETFL, fcntl.fcntl(pipe, fcntl.F_GETFL) | os.O_NONBLOCK)
        for pipe in (self._stdout, self._stderr):
            self._selector.register(pipe, selectors.EVENT_READ)
        self._said, self._messages = bytearray(), bytearray()
        self._finalizer = weakref.finalize(self, _end, self._process, 0.0)

    def ask(self, message: bytes, limit_s: float, most_bytes: int) -> bytes:
        """Write a message, and read the one answer.

        Raises
        ------
        ProgramError
            If none comes within the limits.
        """
        deadline = time.monotonic() + limit_s
        self._read_ready(0.0)
        if self._said:
            raise self._error(f"wrote {_quoted(self._said)} without being asked")
        unsent = self._written(memoryview(message))
        while not 0 < (size := self._measure(self._said)) <= len(self._said):
            if max(size, len(self._said)) > most_bytes:
                raise self._error(f"wrote more than {most_bytes} bytes in one answer")
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
        answer, rest = bytes(self._said[:size]), self._said[size:]
        if rest:
            raise self._error(f"wrote {_quoted(rest)} after its answer {_quoted(answer.rstrip())}")
        self._said.clear()
        return answer

    def wait(self, limit_s: float) -> None:
        """Wait until the program ends; what it writes is passed over.

        Raises
        ------
        ProgramError
            If it does not end within the limit, or not with code 0.
        """
        self._process.stdin.close()
        deadline = time.monotonic() + limit_s
        while (code := self._process.ended()) is None:
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
        """Processor time that it has taken so far, with processes that it waited for, s.

        Raises
        ------
        ProgramError
            If it has ended, or the system does not say.
        """
        pid = self._process.pid
        try:
            own_s = time.clock_gettime((~pid << 3) | 2)  # CPUCLOCK_SCHED of a process
            said = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2]
        except OSError as error:
            raise self._error("does not say its processor time") from error
        return own_s + sum(map(int, said.split()[13:15])) / os.sysconf("SC_CLK_TCK")

    def close(self, patience_s: float = _PATIENCE_S) -> float:
        """Let it end, with its whole process group; return the processor time that it took, s.

        What has not ended by itself by then is ended. Of processes that it started, those count
        for which it waited.
        """
        self._selector.close()
        with suppress(OSError):
            self._process.stdin.close()
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
            if (code := self._process.ended()) is not None:
                what = f"ended with code {code}" if code >= 0 else f"was ended by signal {-code}"
                break
            if what != "closed its output":
                break
            time.sleep(0.01)
        with suppress(OSError):
            self._messages += os.read(self._stderr, _CHUNK)[-_TAIL:]
        lines = self._messages.decode(errors="replace").strip().splitlines()
        self.close(0.0)
        last = f": {printable(_telling(lines))[:300]}" if lines else ""
        return ProgramError(f"{self.name} {what}{last}")


def _telling(lines: Sequence[str]) -> str:
    """The line of a program's last words that says most: of an error, or else the last."""
    return next(
        (line for line in reversed(lines[-_SAID:]) if _ERROR.match(line.strip())), lines[-1]
    )


def start(words: Sequence[str]) -> Program:
    """Start a command.

    Raises
    ------
    ProgramError
        If it cannot be started.
    """
    return Program(os.path.basename(words[0]), Started(words))


def _end(process: Process, patience_s: float) -> float:
    """End a process and its group, if it does not end by itself; return its processor time, s."""
    deadline = time.monotonic() + patience_s
    while process.ended() is None and time.monotonic() < deadline:
        time.sleep(0.002)
    spent_s = process.end()
    for pipe in (process.stdin, process.stdout, process.stderr):
        with suppress(OSError):
            pipe.close()
    return spent_s


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
