"""Speeds and accuracies on one core, with their goals."""

import importlib

from experiments.bench.measure import as_json as json_text
from experiments.bench.measure import as_table
from sim.errors import nearest, require

# name -> modules of this package, each with `run()`
SUITES = {
    "sim": ("simulation",),
    "sweep": ("sweep",),
    "sweep_scale": ("sweep_scale",),
    "icp": ("icp",),
    "fastslam": ("fastslam",),
    "teams": ("teams",),
    "topological": ("topological",),
    "mcl": ("mcl",),
    "formats": ("formats",),
    "smoothing": ("smoothing",),
    "graph_slam": ("graph_slam",),
    "compile": ("compile",),
    "growth": ("growth",),
    "external": ("external",),
    "bound": ("bound",),
    "score": ("score",),
    "worlds": ("worlds",),
}


def run_bench(name: str, *, as_json: bool, against: str | None = None) -> str:
    """Run one suite, or `all`; return the results as a table or as one JSON object.

    Parameters
    ----------
    against
        A git revision that runs in turn, to give each figure its ratio.

    Raises
    ------
    InputError
        For an unknown name.
    """
    known = (*SUITES, "all")
    require(name in known, f"no benchmark named {name}; {nearest(name, known)}")
    suites = [suite for suite in SUITES if name in (suite, "all")]
    if against is not None:
        from experiments.bench.against import run_against

        results = [result for suite in suites for result in run_against(suite, against)]
    else:
        results = [
            result
            for suite in suites
            for module in SUITES[suite]
            for result in importlib.import_module(f"experiments.bench.{module}").run()
        ]
    return json_text(results) if as_json else as_table(results)
