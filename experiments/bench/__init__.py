"""Speeds and accuracies on one core, with their goals."""

import importlib

from experiments.bench.measure import as_json as json_text
from experiments.bench.measure import as_table
from sim.errors import require

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
}


def run_bench(name: str, *, as_json: bool) -> str:
    """Run one suite, or `all`; return the results as a table or as one JSON object.

    Raises
    ------
    InputError
        For an unknown name.
    """
    require(name in (*SUITES, "all"), f"unknown benchmark {name}; known: {', '.join(SUITES)}, all")
    results = [
        result
        for suite, modules in SUITES.items()
        if name in (suite, "all")
        for module in modules
        for result in importlib.import_module(f"experiments.bench.{module}").run()
    ]
    return json_text(results) if as_json else as_table(results)
