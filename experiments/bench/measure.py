"""What a benchmark reports, how it takes time, and on which machine."""

import io
import json
import resource
import statistics
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, Literal, TypeVar

import numpy as np

from estimators.base import Belief, Estimator
from experiments.runs.evaluate import limit_blas
from experiments.runs.version import describe_machine
from sim.compiled import njit, processor_s
from sim.recording import Frame

T = TypeVar("T")


@dataclass(frozen=True)
class Measurement:
    """One figure, and what it should be.

    Attributes
    ----------
    name
        Dotted, stable over versions: `sim.scan_exact_30_us`.
    value, unit
        The figure.
    goal
        What it should reach, in the same unit; None for a figure that only informs.
    better
        Which direction is better.
    note
        How it was measured, in a few words.
    ratio, ratio_low, ratio_high
        To another revision's figure, measured in turn, with its 95 % interval.
    """

    name: str
    value: float
    unit: str
    goal: float | None = None
    better: Literal["lower", "higher"] = "lower"
    note: str = ""
    ratio: float | None = None
    ratio_low: float | None = None
    ratio_high: float | None = None

    @property
    def reached(self) -> bool | None:
        """Whether the goal is reached; None without a goal."""
        if self.goal is None:
            return None
        return self.value <= self.goal if self.better == "lower" else self.value >= self.goal


def time_s(
    function: Callable[..., object],
    *arguments: Any,
    clock: Callable[[], float] = time.perf_counter,
) -> float:
    """Duration of one call, s: wall time, or processor time with `time.process_time`."""
    begun = clock()
    function(*arguments)
    return clock() - begun


def median_time_s(
    function: Callable[..., object],
    inputs: Iterable[tuple[Any, ...]] = ((),),
    *,
    at_least_s: float = 0.3,
    repeats: int = 5,
    clock: Callable[[], float] = time.perf_counter,
) -> float:
    """Median duration of one call, s.

    Parameters
    ----------
    function
        What to time, as a user calls it. The first round over the inputs is not counted, so
        that nothing is compiled or read while the clock runs.
    inputs
        Argument tuples to cycle through. Each call is timed on its own, so that the processor
        cannot adapt to a single input.
    at_least_s, repeats
        Cycle until both this much time and this many rounds have passed.
    clock
        As for `time_s`.
    """
    arguments = list(inputs)
    for given in arguments:
        function(*given)
    times_s: list[float] = []
    until = time.perf_counter() + at_least_s
    while len(times_s) < repeats * len(arguments) or time.perf_counter() < until:
        times_s += [time_s(function, *given, clock=clock) for given in arguments]
    return statistics.median(times_s)


def alone(function: Callable[..., T], *arguments: Any) -> tuple[T, float]:
    """What a function returns in a process of its own, and the most memory that took, MiB."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        found = pool.submit(function, *arguments).result()
        return found, pool.submit(peak_mib).result()


def peak_mib() -> float:
    """The most memory that this process has had, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def time_steps(estimator: Estimator, frames: Iterable[Frame]) -> Iterator[tuple[float, Belief]]:
    """Step through frames; yield each step's processor time, s, and its belief."""
    for frame in frames:
        begun = time.process_time()
        belief = estimator.step(frame)
        yield time.process_time() - begun, belief


@njit()
def _logistic(n: int) -> float:
    """A chain of dependent operations, which no compiler can shorten."""
    x = 0.3
    for _ in range(n):
        x = 3.9 * x * (1.0 - x)
    return x


def machine_unit_ms() -> dict[str, float]:
    """Processor time of three small pieces of work, to read figures of two machines by.

    A product of matrices by NumPy, a copy of 32 MiB, and a compiled loop.
    """
    matrix, block = np.full((256, 256), 0.5), np.ones(2**22)
    work: dict[str, Callable[[], object]] = {
        "numpy": lambda: matrix @ matrix,
        "memory": lambda: np.copyto(copy, block),
        "compiled": lambda: _logistic(100_000),
    }
    copy = np.empty_like(block)
    with limit_blas():  # its threads spin while they wait, and that counts as processor time
        return {
            name: 1e3 * median_time_s(call, at_least_s=0.05, clock=processor_s)
            for name, call in work.items()
        }


def as_json(results: list[Measurement]) -> str:
    """One object: the machine, its unit, and the results in order."""
    machine = {"machine": describe_machine(), "machine_unit_ms": machine_unit_ms()}
    return json.dumps({**machine, "results": [vars(r) for r in results]}, indent=2)


def as_table(results: list[Measurement]) -> str:
    """The same for people: value, goal and whether it is reached."""
    from rich.console import Console
    from rich.table import Column, Table

    table = Table(
        Column("name", no_wrap=True),
        Column("value", justify="right", no_wrap=True),
        Column("goal", justify="right", no_wrap=True),
        *([Column("ratio", no_wrap=True)] if (paired := any(r.ratio for r in results)) else []),
        *("unit", "", "note"),
        title=", ".join(f"{key} {value}" for key, value in describe_machine().items()),
    )
    words = {None: "", True: "reached", False: "MISSED"}
    for r in results:
        sign = "<=" if r.better == "lower" else ">="
        goal = "" if r.goal is None else f"{sign} {r.goal:g}"
        ratio = f"{r.ratio:.3f} ({r.ratio_low:.3f} to {r.ratio_high:.3f})" if r.ratio else ""
        cells = [r.name, f"{r.value:.4g}", goal, *([ratio] if paired else [])]
        table.add_row(*cells, r.unit, words[r.reached], r.note)
    text = io.StringIO()
    Console(file=text, width=120).print(table)
    return text.getvalue().rstrip()
