"""What a benchmark reports, how it takes time, and on which machine."""

from __future__ import annotations

import dataclasses
import io
import json
import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal

from experiments.runs.machine import machine


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
        How it was taken, in a few words.
    """

    name: str
    value: float
    unit: str
    goal: float | None = None
    better: Literal["lower", "higher"] = "lower"
    note: str = ""

    @property
    def reached(self) -> bool | None:
        """Whether the goal is reached; None without a goal."""
        if self.goal is None:
            return None
        return self.value <= self.goal if self.better == "lower" else self.value >= self.goal


def median_time_s(
    function: Callable[..., object],
    inputs: Iterable[tuple[Any, ...]] = ((),),
    *,
    at_least_s: float = 0.3,
    repeats: int = 5,
) -> float:
    """Median duration of one call, s.

    Parameters
    ----------
    function
        What to time, as a user calls it. The first round over the inputs is not counted, so
        that nothing is compiled or read while the clock runs.
    inputs
        Argument tuples to go round; every call is timed on its own, so that a function is not
        timed on one input that the processor has learnt.
    at_least_s, repeats
        Go round until both this much time and this many rounds have passed.
    """
    arguments = list(inputs)
    for given in arguments:
        function(*given)
    times_ns: list[int] = []
    rounds = 0
    until = time.perf_counter() + at_least_s
    while rounds < repeats or time.perf_counter() < until:
        for given in arguments:
            begun = time.perf_counter_ns()
            function(*given)
            times_ns.append(time.perf_counter_ns() - begun)
        rounds += 1
    return statistics.median(times_ns) * 1e-9


def as_json(results: list[Measurement]) -> str:
    """One object: the machine, and the results in order."""
    rows = [dataclasses.asdict(result) for result in results]
    return json.dumps({"machine": machine(), "results": rows}, indent=2)


def as_table(results: list[Measurement]) -> str:
    """The same for people: value, goal and whether it is reached."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=", ".join(f"{key} {value}" for key, value in machine().items()))
    table.add_column("name", no_wrap=True)
    for column in ("value", "goal"):
        table.add_column(column, justify="right", no_wrap=True)
    for column in ("unit", "", "note"):
        table.add_column(column)
    words = {None: "", True: "reached", False: "MISSED"}
    for r in results:
        sign = "<=" if r.better == "lower" else ">="
        goal = "" if r.goal is None else f"{sign} {r.goal:g}"
        table.add_row(r.name, f"{r.value:.4g}", goal, r.unit, words[r.reached], r.note)
    text = io.StringIO()
    Console(file=text, width=120).print(table)
    return text.getvalue().rstrip()
