"""Statistics of the claims, recomputed from results/tables apart from the project's own code.

Nothing of `experiments` is imported. Run `python tests/independent_check.py` in a clone: it prints
each statistic beside that of results/claims.csv.
"""

import csv
import math
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

from scipy.stats import beta, t

RESULTS = Path(__file__).resolve().parents[1] / "results"
Found = tuple[float, float, float]  # value, and the ends of its interval


def table(name: str, folder: Path = RESULTS) -> Iterator[dict[str, str]]:
    """Rows of a CSV file."""
    with (folder / name).open(newline="") as file:
        yield from csv.DictReader(line for line in file if not line.startswith("#"))


def mean(values: Iterable[float]) -> float:
    """Arithmetic mean."""
    kept = list(values)
    return math.fsum(kept) / len(kept)


def share(hits: int, trials: int) -> Found:
    """Share with its Clopper-Pearson interval at 95 %."""
    low = float(beta.ppf(0.025, hits, trials - hits + 1)) if hits else 0.0
    high = float(beta.ppf(0.975, hits + 1, trials - hits)) if hits < trials else 1.0
    return hits / trials, low, high


def ratio(first: dict[str, float], second: dict[str, float]) -> Found:
    """Geometric mean of ratios paired by key, with the 95 % t interval of its logarithm."""
    logs = [math.log(first[key] / second[key]) for key in first]
    n, middle = len(logs), mean(logs)
    spread = math.sqrt(math.fsum((value - middle) ** 2 for value in logs) / (n - 1) / n)
    half = float(t.ppf(0.975, n - 1)) * spread
    return math.exp(middle), math.exp(middle - half), math.exp(middle + half)


def pb4() -> Found:
    """Least share of the nine manoeuvres' ends in the 95 % ellipse, k = 1e-6 m."""
    cases = [
        (int(row["in_ellipse"]), int(row["runs"]))
        for row in table("tables/puzzlebot2024_coverage.csv")
        if float(row["k_m"]) == 1e-6
    ]
    return share(*min(cases, key=lambda case: case[0] / case[1]))


def dc5() -> Found:
    """Position error of point-to-line over that of point-to-point, in small rooms."""
    errors: dict[str, dict[str, float]] = defaultdict(dict)
    for row in table("tables/decristoforis2020_metrics.csv"):
        if row["class"] == "room_small":
            errors[row["metric"]][row["seed"]] = float(row["error_m"])
    return ratio(errors["point_to_line"], errors["point_to_point"])


def gi4() -> Found:
    """Position error with landmarks up to 3 m over that with 10 m, all visible, filter as printed.

    Errors are those of the revised path; repeats over a recording are pooled as squares.
    """
    squares: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in table("tables/gil2008_distance.csv"):
        own = (row["filter"], row["noise"], row["n_seen"], row["occluded"])
        if own == ("paper", "paper", "0", "True"):
            far = f"{float(row['max_distance_m']):g}"
            squares[far][row["seed"]].append(float(row["revised_ate_rmse_m"]) ** 2)
    rms = {
        far: {s: math.sqrt(mean(v)) for s, v in worlds.items()} for far, worlds in squares.items()
    }
    return ratio(rms["3"], rms["10"])


def mx1() -> Found:
    """Mean error of M2 over that of M1 on the UMH route, worlds as the unit."""
    errors: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in table("tables/maximo2024_weighting.csv"):
        if row["geometry"] == "umh":
            errors[row["method"]][row["seed"]].append(float(row["error_m"]))
    worlds = {m: {seed: mean(v) for seed, v in errors[m].items()} for m in ("M1", "M2")}
    return ratio(worlds["M2"], worlds["M1"])


def mx4() -> Found:
    """Share of starts on the UMH route from which M2 is localized within 40 steps."""
    settled = [
        float(row["settled_at"] or "nan")
        for row in table("tables/maximo2024_starts.csv")
        if row["geometry"] == "umh"
    ]
    return share(sum(at <= 40.0 for at in settled), len(settled))


def rl4() -> Found:
    """Largest deviation of the Khepera's diameters and axles from the published ones."""
    off = max(
        abs(float(row["value"]) / float(row["published"]) - 1.0)
        for row in table("tables/real_logs_wheels.csv")
        if row["published"]
    )
    return off, off, off


# Each with the words by which its row in claims.csv is known
CHECKS = {
    "PB4": (pb4, ("least share of ends in the 95 % ellipse", "k = 1e-06")),
    "DC5": (dc5, ("position error, point to line over point to point", "room_small")),
    "GI4": (gi4, ("position error, dmax = 3 m over 10 m", "as printed", "all visible")),
    "MX1": (mx1, ("error of M2 over M1", "UMH")),
    "MX4": (mx4, ("share of starts", "UMH")),
    "RL4": (rl4, ("largest deviation of Khepera",)),
}


def claimed(key: str, words: tuple[str, ...], folder: Path = RESULTS) -> Found:
    """The statistic as claims.csv has it."""
    for row in table("claims.csv", folder):
        if row["id"] == key and all(word in row["statistic"] for word in words):
            return float(row["value"]), float(row["low"]), float(row["high"])
    raise LookupError(f"claims.csv has no statistic of {key} with {' and '.join(words)}")


def same(first: Found, second: Found) -> bool:
    """Whether two statistics are the same number, to the rounding of the tables."""
    pairs = zip(first, second, strict=True)
    return all(math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-9) for a, b in pairs)


def main() -> int:
    """Print each statistic by both; 0 if all agree."""
    agreed = True
    for key, (recomputed, words) in CHECKS.items():
        ours, theirs = recomputed(), claimed(key, words)
        agreed &= same(ours, theirs)
        said = "same" if same(ours, theirs) else "DIFFERS"
        print(f"{key}  {said}  {', '.join(words)}: {ours} here, {theirs} in claims.csv")
    return 0 if agreed else 1


if __name__ == "__main__":
    sys.exit(main())
