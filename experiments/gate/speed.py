"""The times of estimators' steps beside those at another revision: `estima check --speed`."""

import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import pandas as pd

from experiments.bench.against import alternate, checkout, serving
from experiments.evaluation.statistics import Interval
from experiments.gate.suite import Suite, overrides_of, read_suite, suite_path
from experiments.runs import paths
from experiments.runs.compose import searched
from experiments.runs.console import progress, show
from sim.errors import require

MARGIN = 1.10  # a ratio whose whole interval lies above is red
_REPEATS = 3  # drives a turn
_STEPS = """
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
runs, made = json.loads(sys.argv[1]), {}
def answer(name):
    try:
        if name not in made:
            made[name] = Experiment.compose(runs[name])
            evaluate(made[name])  # compiles
        return {name: sum(row["cpu_time_us"] for row in evaluate(made[name]))}
    except Exception:
        return {}  # this revision has no such estimator
"""


def run_speed(
    suite_name: str, revision: str, only: Sequence[str] = (), config_dir: Path | None = None
) -> bool:
    """Compare the processor time of every estimator's step; return whether one is slower.

    Raises
    ------
    InputError
        If the suite or the revision cannot be used, or no estimator runs at both.
    """
    suite = read_suite(suite_path(suite_name), config_dir).select(only).made(elsewhere=False)
    ratios = step_ratios(suite, paths.SOURCE, checkout(revision).folder)
    names = [entry.name for entry in suite.estimators]
    require(ratios, f"{revision}: none of {', '.join(names)} runs there and here")
    show(as_text(ratios, revision, sorted(set(names) - set(ratios))))
    return bool(slower(ratios))


def step_ratios(suite: Suite, new: Path, old: Path) -> dict[str, Interval]:
    """Processor time of every estimator's step by the code of one folder over another's."""
    runs = commands(suite)
    start = partial(serving, _STEPS, [json.dumps(runs)])
    with progress("timing the steps", 1.0) as on_progress:
        return alternate(start, list(runs), new, old, on_progress=on_progress)


def commands(suite: Suite) -> dict[str, list[str]]:
    """Overrides of each estimator over its first recording, checked as those of a file are."""
    runs = {}
    for entry in suite.estimators:
        overrides = overrides_of(suite, entry, suite.first_seed)
        suite.compose(overrides)
        runs[entry.name] = [*searched(suite.config_dir), *overrides, f"repeats={_REPEATS}"]
    return runs


def slower(ratios: Mapping[str, Interval]) -> list[str]:
    """Estimators whose whole interval lies above the margin."""
    return [name for name, ratio in ratios.items() if ratio.low > MARGIN]


def as_text(ratios: Mapping[str, Interval], revision: str, missing: Sequence[str] = ()) -> str:
    """A table of the ratios, and a last line that says which are red."""
    red = slower(ratios)
    rows = [
        {
            f"step, now / {revision}": name,
            "ratio": f"{ratio.value:.3f}",
            "95 % interval": f"{ratio.low:.3f} to {ratio.high:.3f}",
            "verdict": "slower" if name in red else "",
        }
        for name, ratio in ratios.items()
    ]
    lines = [pd.DataFrame(rows).to_string(index=False)]
    lines += [f"not at both: {', '.join(missing)}"] if missing else []
    margin = f"by more than {100.0 * (MARGIN - 1.0):.0f} %"
    return "\n".join([*lines, f"slower {margin}: {', '.join(red) or 'none'}"])
