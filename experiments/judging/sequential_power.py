"""Error, power and size of the sequential rule by simulation, beside those of a fixed design.

Claims are drawn as paired log ratios. Without effect, under shapes from normal to heavy-tailed and
skewed, a claim is wrong if it is decided at any look. With an effect, the fixed design has the
recordings that decide the smallest effect of interest with a power of 0.9. Of the studies' claims,
the log ratio is the judged one, and its spread and smallest effect those of its design.

    python -m experiments.judging.sequential_power    # two minutes; writes into docs/papers.md
"""

import math
import re
from collections.abc import Callable, Mapping

import numpy as np
import pandas as pd
import scipy
from numpy.typing import NDArray

from experiments.evaluation.sequential import (
    SPENT,
    look_errors,
    plan_looks,
    recordings_for,
    skewed_bounds,
)
from experiments.judging.claim import SMALLEST_EFFECT, Role
from experiments.judging.claims_file import read_claims
from experiments.judging.folders import ROOMS
from experiments.judging.sequential import designs
from experiments.runs.console import progress, show
from experiments.runs.paths import SOURCE
from experiments.runs.seeds import stream
from sim.arrays import Array
from sim.files import write_text

N_CLAIMS = 10_000
CAPS = (40, 100, 200)
SHAPES: Mapping[str, Callable[[np.random.Generator, tuple[int, int]], Array]] = {  # mean 0
    "normal": lambda rng, n: rng.normal(size=n),
    "t, 3 degrees of freedom": lambda rng, n: rng.standard_t(3, size=n),
    "Gumbel, skewness 1.1": lambda rng, n: rng.gumbel(size=n) - np.euler_gamma,
    "lognormal, skewness 1.75": lambda rng, n: rng.lognormal(0.0, 0.5, n) - math.exp(0.125),
    "exponential, skewness 2": lambda rng, n: rng.exponential(size=n) - 1.0,
}
_BEGIN, _END = "<!-- measured -->", "<!-- end of what was measured -->"


def bounds_at(logs: Array, looks: tuple[int, ...], errors: Array) -> tuple[Array, Array]:
    """Bounds (C, L) of the means of claims (C, N) at each look, as `repeated_interval` has them."""
    n = np.array(looks)
    first, second, third = (np.cumsum(logs**k, axis=1)[:, n - 1] / n for k in (1, 2, 3))
    variance = np.maximum(second - first**2, 1e-300)
    skewness = (third - 3.0 * first * second + 2.0 * first**3) / variance**1.5
    low, high = skewed_bounds(n, np.sqrt(variance * n / (n - 1)), skewness, errors)
    return first + low, first + high


def mixture_errors(looks: tuple[int, ...], width: float = 4.0) -> Array:
    """Two-sided error (L,) of the t interval at each look by a mixture; without end.

    The t-test e-process with a normal mixture over the effect in standard deviations, of variance 1
    over `width` (Wang and Ramdas 2024, theorem 4.2): it exceeds 1 / SPENT beyond these t.
    """
    n = np.array(looks, float)
    share = width / (n + width)
    ratio = (SPENT**2 * share) ** (-1.0 / n)
    with np.errstate(invalid="ignore", divide="ignore"):
        square = np.where(ratio * share < 1.0, (n - 1) * (ratio - 1) / (1 - ratio * share), np.inf)
    return np.asarray(2.0 * scipy.stats.t.sf(np.sqrt(square), n - 1))


def null_errors(n_claims: int = N_CLAIMS) -> pd.DataFrame:
    """Share of claims without effect that are decided at any look, in percent: shapes by rules.

    Each is the worst of the largest samples, of 40, 100 and 200 recordings.
    """
    rows = []
    for name, draw in SHAPES.items():
        worst: dict[str, float] = {}
        for cap in CAPS:
            logs = draw(stream(cap, f"estimator/{name}"), (n_claims, cap))
            some, every = plan_looks(cap), tuple(range(20, cap + 1))
            for rule, looks, errors in (
                ("t test, once", (cap,), None),
                ("t test at each recording", every, None),
                ("6 looks", some, look_errors(some)),
                ("each recording", every, look_errors(every)),
                ("mixture, each recording", every, mixture_errors(every)),
            ):
                low, high = (
                    plain_bounds(logs, looks)
                    if errors is None
                    else bounds_at(logs, looks, np.array(errors))
                )
                wrong = float(np.mean(((low > 0.0) | (high < 0.0)).any(axis=1)))
                worst[rule] = max(worst.get(rule, 0.0), 100.0 * wrong)
        rows.append({"log ratios": name, **worst})
    return pd.DataFrame(rows)


def plain_bounds(logs: Array, looks: tuple[int, ...]) -> tuple[Array, Array]:
    """Bounds of the t interval at 95 %."""
    n = np.array(looks)
    first, second = (np.cumsum(logs**k, axis=1)[:, n - 1] / n for k in (1, 2))
    half = scipy.stats.t.ppf(0.975, n - 1) * np.sqrt(np.maximum(second - first**2, 0.0) / (n - 1))
    return first - half, first + half


def stops(
    logs: Array, looks: tuple[int, ...], errors: Array, margin: float
) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]:
    """Where claims (C, N) stop: recordings, and whether an effect, or equivalence, is decided."""
    low, high = bounds_at(logs, looks, errors)
    effect, same = (low > 0.0) | (high < 0.0), (low > -margin) & (high < margin)
    decided = effect | same
    at = np.where(decided.any(axis=1), decided.argmax(axis=1), len(looks) - 1)
    claim = np.arange(len(logs))
    return np.array(looks)[at], effect[claim, at], same[claim, at] & ~effect[claim, at]


def powers(n_claims: int = N_CLAIMS, spread: float = 0.3) -> pd.DataFrame:
    """Power and size of the rule, of the mixture and of the fixed design, by the true effect."""
    margin = math.log1p(SMALLEST_EFFECT)
    n_fixed = recordings_for(margin, spread)
    looks = plan_looks(n_fixed)
    rows = []
    for times in (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 5.0):
        rng = stream(int(10 * times), "estimator/powers")
        logs = rng.normal(times * margin, spread, size=(n_claims, n_fixed))
        row: dict[str, float] = {"effect over the smallest": times}
        for rule, at, errors in (
            ("fixed", (n_fixed,), np.array([0.05])),
            ("6 looks", looks, np.array(look_errors(looks))),
            ("mixture", looks, mixture_errors(looks)),
        ):
            n, effect, same = stops(logs, at, errors, margin)
            row[f"{rule}: effect, %"] = 100.0 * float(effect.mean())
            row[f"{rule}: equivalent, %"] = 100.0 * float(same.mean())
            if len(at) > 1:
                row[f"{rule}: runs saved, %"] = 100.0 * (1.0 - float(np.median(n)) / n_fixed)
        rows.append(row)
    return pd.DataFrame(rows)


def of_claims(n_claims: int = N_CLAIMS // 10) -> pd.DataFrame:
    """Runs saved and claims decided if the judged log ratios are the true ones, by claim.

    A claim stops when all its headlines are decided. The design's spread is that of the headline
    with the widest interval, and those of the others are in proportion.
    """
    judged = read_claims(SOURCE / "results" / "claims.csv")
    judged = judged[(judged["role"] == Role.HEADLINE) & (judged["low"] > 0.0)]
    rows = []
    for study in sorted(folder.parent.name for room in ROOMS for folder in room.glob("*/study.py")):
        for name, design in designs(study).items():
            margin = math.log1p(design.effect)
            looks, errors = design.looks, np.array(look_errors(design.looks))
            z = scipy.stats.norm.isf(np.array([0.025, errors[-1] / 2.0])) + scipy.stats.norm.ppf(
                0.9
            )
            n_fixed = round(looks[-1] * (z[0] / z[1]) ** 2)  # decides the smallest effect as often
            runs, decided = np.full(n_claims, float(looks[0])), np.ones(n_claims, bool)
            some = judged[judged["id"] == name]
            widths = np.log(some["high"] / some["low"])
            spreads = design.spread * widths / widths.max()  # over the same recordings
            for i, value, criterion in some[["value", "criterion"]].itertuples():
                shift = math.log(value / _limit(criterion))
                rng = stream(i, f"estimator/{name}")
                logs = rng.normal(shift, spreads[i], size=(n_claims, looks[-1]))
                n, effect, same = stops(logs, looks, errors, margin)
                right = effect & (np.sign(logs.mean(axis=1)) == np.sign(shift))
                runs, decided = np.maximum(runs, n), decided & (right | same)
            saved = 100.0 * (1.0 - float(np.median(runs)) / n_fixed)
            rows.append((name, design.effect, design.spread, n_fixed, looks[-1], np.median(runs),
                         saved, 100.0 * decided.mean()))  # fmt: skip
    columns = ["claim", "effect", "spread", "fixed", "cap", "median", "saved, %", "decided, %"]
    return pd.DataFrame(rows, columns=columns)


def _limit(criterion: str) -> float:
    """The criterion's limit, or that of two which is above 1."""
    numbers = [float(v) for v in re.findall(r"(?:below|above|most|least|and) ([\d.]+)", criterion)]
    return max(numbers or [1.0])


def main() -> None:
    """Write the tables into the page of the papers."""
    with progress("simulating", 3.0, summary=True) as on_progress:
        parts = []
        for i, make in enumerate((null_errors, powers, of_claims)):
            parts.append(make().to_markdown(index=False, floatfmt=".3g"))
            on_progress(i + 1.0)
    page = SOURCE / "docs" / "papers.md"
    before, _, rest = page.read_text(encoding="utf-8").partition(_BEGIN)
    after = rest.partition(_END)[2]
    write_text(page, "\n\n".join([f"{before}{_BEGIN}", *parts, f"{_END}{after}"]))
    show("\n\n".join(parts))


if __name__ == "__main__":
    main()
