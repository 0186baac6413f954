"""The study of maximo2024: weightings M1-M3, particles, starts, kidnapping, clouds of a campus.

The route is the unit of inference. Each world is a route, or the real Oxford positions, with
queries and descriptors of its own. Parameters are chosen on seeds below 100 by `tune`, and judged
on seeds from 1000 on.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import pandas as pd
from joblib import Parallel, delayed

from experiments.evaluation.verdict import Profile
from experiments.papers.maximo2024.examples import write_examples
from experiments.papers.maximo2024.places import GEOMETRIES
from experiments.papers.maximo2024.settings import (
    GRID_B,
    GRID_SIGMA_L,
    GRID_SIGMA_M,
    HELD,
    JUDGED_SEED,
    METHODS,
    N_CAMPUSES,
    N_QUALITY_WORLDS,
    N_REPEATS,
    N_STARTS,
    N_WORLDS,
    POSITIONS,
    PRINTED_1,
    PRINTED_2,
    RECOVERED_WITHIN,
    TOLERANCE,
)
from experiments.papers.maximo2024.worlds import (
    Rows,
    campus_rows,
    case_of,
    cluster_row,
    kidnapping_rows,
    localize,
    options,
    particle_rows,
    quality_rows,
    starts,
    weighting_rows,
)
from experiments.papers.results import Results
from experiments.runs.seeds import stream


def run(profile: Profile, out: Results, on_progress: Callable[[float], None]) -> None:
    """Run all studies of the paper; write their tables, and what the figures draw.

    Parameters
    ----------
    profile
        `quick`: few worlds and repeats; `full`: what the claims are judged by.
    out
        Where tables and arrays go.
    on_progress
        Called with the share done.
    """
    campus = "campus" if profile is Profile.FULL else "campus_quick"
    oxford = "oxford_real" if POSITIONS.is_file() else "oxford"
    routes = dict.fromkeys(["oxford", "umh", oxford])  # each once
    jobs = [(campus, JUDGED_SEED + i) for i in range(N_CAMPUSES[profile])]
    jobs += [(name, JUDGED_SEED + i) for name in routes for i in range(N_WORLDS[profile])]
    parts = Parallel(n_jobs=-1, return_as="generator")(
        delayed(_rows)(name, seed, profile) for name, seed in jobs
    )
    rows: dict[str, Rows] = {}
    for done, ((name, seed), part) in enumerate(zip(jobs, parts, strict=True), start=1):
        for table, found in part.items():
            labelled = ({"geometry": name, "seed": seed, **row} for row in found)
            rows.setdefault(table, []).extend(labelled)
        on_progress(done / len(jobs))
    tables = {name: pd.DataFrame(found) for name, found in rows.items()} | {"times": times()}
    tables["table_1"] = table_1(tables["weighting"])
    tables["table_2"] = table_2(tables["particles"], tables["times"])
    for name, table in tables.items():
        out.write_table(name, table)
    write_examples(out, [oxford, "umh"], campus)


def _rows(name: str, seed: int, profile: Profile) -> dict[str, Rows]:
    """All rows of one world, by table."""
    if name.startswith("campus"):
        return campus_rows(name, seed, N_REPEATS[profile])
    case = case_of(name, seed)
    settings, tolerance_m = options(case), TOLERANCE * case.known_map.spacing_m
    by_mode = settings | {"estimate": "mode"}
    tables: dict[str, Rows] = {
        **weighting_rows(case, N_REPEATS[profile]),
        "starts": [
            {"start": start, "settled_at": settled}
            for start, settled, _ in starts(case, N_STARTS[profile], settings, tolerance_m)
        ],
        "kidnapping": kidnapping_rows(case, by_mode, 0.05, 5, RECOVERED_WITHIN + HELD),
        "clusters": [cluster_row(case.known_map, case.recording, "synthetic", seed)],
    }
    if name in GEOMETRIES:  # not again on the real positions
        tables["particles"] = particle_rows(case, N_REPEATS[profile])
        if seed < JUDGED_SEED + N_QUALITY_WORLDS[profile]:
            tables["quality"] = quality_rows(name, seed)
    return tables


def times() -> pd.DataFrame:
    """Table 2: time per node on one core, after the other jobs have ended."""
    from experiments.bench.topological import PAPER_S
    from experiments.bench.topological import run as measure

    measured = {m.name: m.value for m in measure()}
    rows = [
        (name, count, 1e-3 * measured[f"topological.node_{count}_ms"], paper_s)
        for name, counts in PAPER_S.items()
        for count, paper_s in counts.items()
    ]
    return pd.DataFrame(rows, columns=["geometry", "particles", "time_s", "paper_s"])


def table_1(weighting: pd.DataFrame) -> pd.DataFrame:
    """Errors of the methods: mean over worlds, deviation over repeats as in the paper and worlds.

    Beside them the paper's.
    """
    table = _over_worlds(weighting, "method")
    table[["paper_m", "paper_sd_m"]] = [
        PRINTED_1.get((name.removesuffix("_real"), method), (math.nan, math.nan))
        for name, method in table.index
    ]
    table["nearest_node_m"] = weighting.groupby(table.index.names)["nearest_node_m"].mean()
    return table.reset_index()


def table_2(particles: pd.DataFrame, taken: pd.DataFrame) -> pd.DataFrame:
    """Errors and times by the number of particles, beside the paper's."""
    table = _over_worlds(particles, "particles").drop(columns="sd_worlds_m")
    table = table.join(taken.set_index(table.index.names))
    table[["paper_m", "paper_sd_m"]] = [PRINTED_2[name][count] for name, count in table.index]
    table["paper_time_s"] = table.pop("paper_s")
    return table.reset_index()


def _over_worlds(table: pd.DataFrame, by: str) -> pd.DataFrame:
    """Mean error of each geometry and arm; deviations over repeats (mean of worlds) and worlds."""
    keys = ["geometry", by]
    worlds = table.groupby([*keys, "seed"], sort=False)["error_m"].agg(["mean", "std"])
    return worlds.groupby(keys, sort=False).agg(
        error_m=("mean", "mean"), sd_repeats_m=("std", "mean"), sd_worlds_m=("mean", "std")
    )


def tune(out: Results, n_worlds: int = 12) -> None:
    """Mean error of every setting of the grid on seeds 0, 1, ...; the least is in `TUNED`.

    Takes some ten minutes on two cores. All methods see the same worlds and draws.
    """
    jobs = [(name, seed) for seed in range(n_worlds) for name in GEOMETRIES]
    parts = Parallel(n_jobs=-1)(delayed(_tuning_rows)(*job) for job in jobs)
    columns = ["geometry", "method", "sigma_l", "sigma_m", "n_nearest", "error_m"]
    table = pd.DataFrame([row for part in parts for row in part], columns=columns)
    out.write_table("tuning", table.groupby(columns[:-1], as_index=False)["error_m"].mean())


def _tuning_rows(name: str, seed: int) -> list[tuple[str, str, float, float, int, float]]:
    case, rows = case_of(name, seed), []
    grid = itertools.product(METHODS, GRID_SIGMA_L, GRID_SIGMA_M, GRID_B)
    for method, sigma_l, sigma_m, n_nearest in grid:
        if method == "M2" or sigma_m == 0.1:  # M1 and M3 do not depend on it
            settings = options(case, method, (sigma_l, sigma_m, n_nearest))
            walk = localize(case, settings, stream(seed, "estimator/tuning"))
            error = float(walk.errors_m.mean())
            rows.append((name, method, sigma_l, sigma_m, n_nearest, error))
    return rows
