"""Commands on the project: reproduce, bench, cache."""

from __future__ import annotations

from typing import Annotated

import typer

from experiments.runs import paths


def reproduce(
    full: Annotated[bool, typer.Option("--full", help="The judged profile.")] = False,
    paper: Annotated[str | None, typer.Option(help="Only this paper.")] = None,
    figures_only: Annotated[
        bool, typer.Option("--figures-only", help="Draw again what is in results/.")
    ] = False,
) -> None:
    """Make the papers' figures, tables and claims, in results/quick/ or, in full, in results/.

    Examples
    --------
      estima reproduce --paper puzzlebot2024

      estima reproduce --full

      estima reproduce --figures-only
    """
    from experiments.reproduce import redraw
    from experiments.reproduce import reproduce as reproduce_papers

    if figures_only:
        redraw(only=paper)
    else:
        reproduce_papers(full=full, only=paper)


def bench(
    name: Annotated[
        str,
        typer.Argument(
            help="compile, external, fastslam, formats, graph_slam, growth, icp, mcl, sim, "
            "smoothing, sweep, sweep_scale, teams, topological, or all."
        ),
    ] = "all",
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Measure speeds and accuracies on one core, beside their goals.

    Example: estima bench sim --json
    """
    from experiments.bench import run_bench

    print(run_bench(name, as_json=as_json))


def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Delete the recordings.")] = False,
) -> None:
    """Show the cache of simulated recordings, or clear it.

    ESTIMA_CACHE_GIB sets its limit; the least recently used recordings are dropped first.

    Example: estima cache --clear
    """
    from experiments.runs.cache import files, folder, limit_bytes, trim

    if clear:
        print(f"{trim(0.0)} recordings deleted")
    kept = files()
    size, limit = sum(size for _, size in kept) / 2**30, limit_bytes() / 2**30
    print(f"{paths.short(folder())}: {len(kept)} recordings, {size:.2f} of {limit:g} GiB")
