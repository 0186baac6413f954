"""The study of maximo2024: weightings M1-M3, particles, starts, kidnapping, clouds of a campus.

The route is the unit of inference. Each world is a route, or the real Oxford positions, with
queries and descriptors of its own. Parameters are those of the anchor (design.yaml, `regions`).
"""

import math
import operator
from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from estimators.topological.topological_map import from_recording
from experiments.bench import topological
from experiments.judging.jobs import Progress, Tables, tables_of
from experiments.judging.region_runs import region_jobs, remake_region
from experiments.judging.remake import Cells, Remake
from experiments.judging.results import FIRST_SEED, Arrays, Profile, Results, first_seed
from experiments.judging.sequential import run_worlds
from experiments.papers.maximo2024.claims import headlines, mx1, mx3, mx7
from experiments.papers.maximo2024.places import oxford_runs, resequence
from experiments.papers.maximo2024.settings import (
    CONTROLS,
    DRAWN_DESCRIPTOR,
    ITERATIONS,
    METHODS,
    N_CLUSTERED_CAMPUSES,
    N_KIDNAPPED_CAMPUSES,
    N_KIDNAPPED_ROUTES,
    N_REPEATS,
    N_RETRIEVED_CAMPUSES,
    N_RUN_SEEDS,
    N_STARTS,
    N_TIMINGS,
    N_WORLDS,
    POSITIONS,
    PRINTED_1,
    PRINTED_2,
    PRINTED_5,
    TOLERANCE,
)
from experiments.papers.maximo2024.worlds import (
    Case,
    Rows,
    campus_rows,
    campus_runs,
    cloud_clusters,
    cluster_labels,
    cluster_row,
    kidnappings,
    localize,
    make_case,
    options,
    particle_rows,
    reference_run,  # noqa: F401 - for judging.anchors
    region_run,
    run_rows,
    start_errors,
    starts,
    weighting_rows,
)
from experiments.runs.row import Row
from experiments.runs.seeds import stream
from sim import se2
from sim.arrays import Array
from sim.recording import Recording
from sim.sensors import Lidar3D

_REACH_M = 65.0  # of the clouds kept, from the middle of the nodes drawn
_CLOUD_GRID_M = 0.05


def run(profile: Profile, out: Results, on_progress: Progress) -> None:
    """Run all studies of the paper; write their tables, and what the figures draw.

    Parameters
    ----------
    profile
        `quick`: few worlds and repeats; `full`: those that the claims are judged on.
    out
        Where tables and arrays go.
    """
    jobs, costs = zip(*_jobs(profile), strict=True)
    regions = region_jobs("maximo2024", region_run, profile)
    calls = [(_labelled, *job) for job in jobs] + regions
    each = [*costs, *(len(regions) * [1.0])]
    tables = tables_of(operator.call, calls, lambda share: on_progress(0.6 * share), each)
    decisive = sorted(headlines(routes()))
    tables |= _joined(tables, run_worlds(
        "maximo2024", ["MX1", "MX3"], profile, partial(_block, "weighting", decisive, profile),
        lambda made: [*mx1(made["weighting"]), *mx3(made["dispersion"])],
    ))  # fmt: skip
    tables |= _joined(tables, run_worlds(
        "maximo2024", ["MX7"], profile, partial(_block, "campus", ["campus"], profile),
        lambda made: [mx7(made["campus_starts"])],
    ))  # fmt: skip
    for part in PARTS.values():
        tables |= part(profile, lambda _: None)
    first = FIRST_SEED[profile]
    tables["times"] = times(N_TIMINGS[profile], first)
    tables["table_1"] = table_1(tables["weighting"])
    tables["table_2"] = table_2(tables["particles"], tables["times"])
    drawn = {name: route_arrays(make_case(name, first), N_REPEATS[profile]) for name in routes()}
    tables["figure_5"] = figure_5(drawn)
    out.write_tables(**tables)
    for name, arrays in drawn.items():
        out.write_arrays(name, **arrays)
    out.write_arrays("campus", **campus_arrays(first))


def clouds(profile: Profile, on_progress: Progress) -> Mapping[str, pd.DataFrame]:
    """Clusters of descriptors of clouds, in campuses of their own (MX5)."""
    first, n = first_seed("maximo2024", "MX5", profile), N_CLUSTERED_CAMPUSES[profile]
    jobs = [("cloud_clusters", "campus", first + i, profile) for i in range(n)]
    return tables_of(_labelled, jobs, on_progress)


def kidnapped(profile: Profile, on_progress: Progress) -> Mapping[str, pd.DataFrame]:
    """Kidnappings on the routes and in campuses, in worlds of their own (MX8)."""
    first, worlds = first_seed("maximo2024", "MX8", profile), N_KIDNAPPED_ROUTES[profile]
    numbers = dict.fromkeys(routes(), worlds) | {"campus": N_KIDNAPPED_CAMPUSES[profile]}
    jobs = [
        ("kidnapping", name, first + i, profile) for name, n in numbers.items() for i in range(n)
    ]
    return tables_of(_labelled, jobs, on_progress)


PARTS = {"clouds": clouds, "kidnapping": kidnapped}

Job = tuple[str, str, int, Profile]  # what to run, in which world


def _block(
    what: str, names: Sequence[str], profile: Profile, seeds: Sequence[int]
) -> Mapping[str, pd.DataFrame]:
    """Tables of worlds that are added until their claims are decided."""
    jobs = [(what, name, seed, profile) for seed in seeds for name in names]
    return tables_of(_labelled, jobs)


def _joined(
    first: Mapping[str, pd.DataFrame], second: Mapping[str, pd.DataFrame]
) -> dict[str, pd.DataFrame]:
    """Tables of both, those of the same name joined."""
    return {
        name: pd.concat([first[name], table], ignore_index=True) if name in first else table
        for name, table in second.items()
    }


def _jobs(profile: Profile) -> list[tuple[Job, float]]:
    """Jobs of all worlds whose number is fixed, and how long they take, the longest first."""
    others = [*CONTROLS, *sorted(set(routes()) - headlines(routes()))]
    return [
        ((what, name, FIRST_SEED[profile] + i, profile), cost)
        for what, (names, n, cost) in {
            "runs": (["oxford_runs"] * POSITIONS.is_file(), N_RUN_SEEDS, 10.0),
            "route": (routes(), N_WORLDS, 6.0),
            "weighting": (others, N_WORLDS, 3.0),
        }.items()
        for i in range(n[profile])
        for name in names
    ]


REMADE = {
    "campus_starts": 30.0,
    "clusters": 2.0,
    "cloud_clusters": 15.0,
    "dispersion": 4.0,
    "kidnapping": 1.5,
    "particles": 4.0,
    "runs": 15.0,
    "starts": 1.0,
    "weighting": 4.0,
    "region_MX1": 15.0,
}  # not means and times


_OWN_JOBS = ("cloud_clusters", "kidnapping")


def are_here(table: pd.DataFrame) -> NDArray[np.bool_]:
    """Which rows can be made here: those of the real positions only with them."""
    if "geometry" not in table:
        return np.full(len(table), POSITIONS.is_file())
    real = table["geometry"].isin(("oxford_real", "oxford_runs"))
    return np.asarray(~real | POSITIONS.is_file())


def remake(table: str, row: Cells) -> Remake:
    """The call that makes a row again."""
    if table.startswith("region_"):
        return remake_region("maximo2024", region_run, table, row)
    name = row["geometry"]
    of_route = dict.fromkeys(("starts", "clusters", "particles"), "route")
    what = {**of_route, "dispersion": "weighting"}.get(table, table)
    what = "campus" if name == "campus" and table not in _OWN_JOBS else what
    return _labelled, (what, name, int(row["seed"]), Profile.FULL, table, row.get("method"))


def _labelled(
    what: str,
    name: str,
    seed: int,
    profile: Profile,
    only: str | None = None,
    method: str | None = None,
) -> Tables:
    """All rows of a job, by table, with the geometry and seed of its world.

    Parameters
    ----------
    only, method
        The table and weighting that are wanted, where the others cost more time; None for all.
    """
    return {
        table: [{"geometry": name, "seed": seed, **row} for row in rows]
        for table, rows in _rows(what, name, seed, profile, only, method).items()
    }


def _rows(
    what: str, name: str, seed: int, profile: Profile, only: str | None, method: str | None
) -> dict[str, Rows]:
    """All rows of a job, by table."""
    n_repeats = N_REPEATS[profile]
    if what == "cloud_clusters":
        return {what: list(cloud_clusters(seed))}
    if what == "kidnapping":
        return {what: list(kidnappings(name, seed, profile))}
    if what == "campus":
        is_early = seed < FIRST_SEED[profile] + N_RETRIEVED_CAMPUSES
        return campus_rows(seed, profile, with_retrieval=is_early)
    if what == "runs":
        names, n_fewer = oxford_runs(POSITIONS), max(n_repeats // 5, 1)
        return {"runs": [{"run": n, **row} for n in names for row in run_rows(n, seed, n_fewer)]}
    case = make_case(name, seed)
    if what == "weighting":
        return weighting_rows(case, n_repeats, METHODS if method is None else (method,))
    settings, tolerance_m = options(case), TOLERANCE * case.known_map.spacing_m
    found: dict[str, Iterable[Row]] = {  # made as they are read
        "starts": (
            {"start": start, "settled_at": settled}
            for start, settled, _ in starts(case, N_STARTS[profile], settings, tolerance_m)
        ),
        "clusters": map(cluster_row, [case.known_map], [case.recording], ["synthetic"], [seed]),
        "particles": particle_rows(case, n_repeats),
        "start_errors": [start_errors(case, settings)],
    }
    return {table: list(rows) for table, rows in found.items() if only in (None, table)}


def times(n_repeats: int, seed: int) -> pd.DataFrame:
    """Table 2: time per node on one core, timed repeatedly after the other jobs have ended.

    Routes and numbers of particles take turns, so that a machine that slows down slows all alike.
    """
    experiments = {name: make_case(name, seed).experiment for name in sorted(headlines(routes()))}
    rows = [
        (name, count, repeat, topological.node_s(experiment, count), paper_s)
        for repeat in range(n_repeats)
        for name, experiment in experiments.items()
        for count, paper_s in topological.PAPER_S[name.removesuffix("_real")].items()
    ]
    return pd.DataFrame(rows, columns=["geometry", "particles", "repeat", "time_s", "paper_s"])


def table_1(weighting: pd.DataFrame) -> pd.DataFrame:
    """Errors of the methods beside the paper's.

    Means over worlds; deviations over repeats, as in the paper, and over worlds.
    """
    table = _over_worlds(weighting, "method")
    table[["paper_m", "paper_sd_m"]] = [
        PRINTED_1.get((name.partition("_")[0], method), (math.nan, math.nan))
        for name, method in table.index
    ]
    table["nearest_node_m"] = weighting.groupby(table.index.names)["nearest_node_m"].mean()
    return table.reset_index()


def table_2(particles: pd.DataFrame, taken: pd.DataFrame) -> pd.DataFrame:
    """Errors and times by the number of particles, beside the paper's."""
    table = _over_worlds(particles, "particles").drop(columns="sd_worlds_m")
    table = table.join(taken.groupby(table.index.names)[["time_s", "paper_s"]].median())
    table[["paper_m", "paper_sd_m"]] = [
        PRINTED_2[name.partition("_")[0]][count] for name, count in table.index
    ]
    table["paper_time_s"] = table.pop("paper_s")
    return table.reset_index()


def figure_5(drawn: dict[str, Arrays]) -> pd.DataFrame:
    """Mean error of each start along the route, of all repeats, and its deviation; the paper's."""
    unknown = ((math.nan, math.nan),) * 3
    rows = [
        (name, int(np.isnan(errors).sum()), np.nanmean(errors), np.nanstd(errors), *printed)
        for name, arrays in drawn.items()
        for errors, printed in zip(
            arrays["start_errors_m"], PRINTED_5.get(name, unknown), strict=True
        )
    ]
    columns = ["geometry", "start", "error_m", "sd_m", "paper_m", "paper_sd_m"]
    return pd.DataFrame(rows, columns=columns)


def _over_worlds(table: pd.DataFrame, by: str) -> pd.DataFrame:
    """Mean error of each geometry and arm; deviations over repeats (mean of worlds) and worlds."""
    keys = ["geometry", by]
    worlds = table.groupby([*keys, "seed"], sort=False)["error_m"].agg(["mean", "std"])
    return worlds.groupby(keys, sort=False).agg(
        error_m=("mean", "mean"), sd_repeats_m=("std", "mean"), sd_worlds_m=("mean", "std")
    )


# What the figures draw


def route_arrays(case: Case, n_repeats: int) -> Arrays:
    """Nodes, their clusters and queries; errors of M2 from three starts, particles of a fourth run.

    Returns
    -------
    dict
        `nodes_m` (N, 2), `clusters` (N,), `queries_m` (K, 2); `start_errors_m` (3, K), means of
        the repeats, NaN before the start; at `ITERATIONS` `means_m` (4, 2) and `particles_m`
        (4, M, 2).
    """
    n = len(case.recording.frame_stamps)
    errors = np.full((3, n), np.nan)
    for i, start in enumerate((0, n // 4, n // 2)):
        part = resequence(case.recording, np.arange(start, n))
        rngs = [stream(case.seed, f"estimator/figure_5/{start}", k) for k in range(n_repeats)]
        walks = [localize(case, options(case), rng, part).errors_m for rng in rngs]
        errors[i, start:] = np.mean(walks, axis=0)
    rng, part = stream(case.seed, "estimator/figure", 6), case.recording.cut(ITERATIONS[-1] + 1)
    found = localize(case, options(case), rng, part, keep=("particles",)).estimate
    steps = list(ITERATIONS)
    return {
        "nodes_m": case.known_map.positions_m,
        "clusters": cluster_labels(case.known_map, case.seed),
        "queries_m": case.recording.truth_at(case.recording.frame_stamps)[:, :2],
        "start_errors_m": errors.astype(np.float32),
        "means_m": found.means[steps, :2],
        "particles_m": np.array(found.extras["particles"])[steps, :, :2].astype(np.float32),
    }


def campus_arrays(seed: int) -> Arrays:
    """Nodes, their clusters, queries and walls; clouds of four nodes and of four queries.

    Returns
    -------
    dict
        `nodes_m` (N, 2), `clusters` (N,), `queries_m` (K, 2), `walls_m` (W, 2, 2); where the
        clouds were taken, `map_spots_m` and `query_spots_m` (4, 2), and what they show above
        ground, `map_clouds_m` and `query_clouds_m` (P, 2).
    """
    experiments = campus_runs(seed)
    mapping, taking = (experiment.recording() for experiment in experiments)
    spacing_m = experiments[0].options_of("prior.map")["spacing_m"]
    known = from_recording(mapping, DRAWN_DESCRIPTOR, spacing_m)
    # where most is seen within 40 m
    seen = np.convolve(np.sum(known.slices_m < 40.0, axis=1), np.ones(4), "valid")
    nodes = known.positions_m[np.argmax(seen) + np.arange(4)]
    between = nodes + 0.4 * np.diff(nodes, axis=0, append=nodes[-1:])
    map_spots, map_clouds = _clouds(mapping, nodes)
    query_spots, query_clouds = _clouds(taking, between)
    return {
        "nodes_m": known.positions_m,
        "clusters": cluster_labels(known, seed),
        "queries_m": taking.truth_at(taking.frame_stamps)[:, :2],
        "walls_m": taking.known_world.walls.reshape(-1, 2, 2),
        "map_spots_m": map_spots,
        "map_clouds_m": map_clouds,
        "query_spots_m": query_spots,
        "query_clouds_m": query_clouds,
    }


def _clouds(recording: Recording, points_m: Array) -> tuple[Array, NDArray[np.float32]]:
    """Where the clouds nearest to points (4, 2) were taken, and what they show above ground."""
    lidar, clouds = recording.sensor("lidar3d", Lidar3D), recording.log("lidar3d")
    poses = recording.truth_at(clouds.stamps)
    rows = [int(np.argmin(np.hypot(*(poses[:, :2] - point).T))) for point in points_m]
    shown = []
    for row in rows:
        points = lidar.points_in_sensor(clouds["ranges_m"][row])
        points = points[points[:, 2] + lidar.mount.z_m > 0.3]
        shown.append(se2.transform(poses[row], points[:, :2]))
    drawn = np.concatenate(shown)
    drawn = drawn[np.hypot(*(drawn - points_m.mean(axis=0)).T) < _REACH_M]
    cells = np.unique(np.round(drawn / _CLOUD_GRID_M), axis=0)  # finer than a picture shows
    return poses[rows, :2], (_CLOUD_GRID_M * cells).astype(np.float32)


def routes() -> list[str]:
    """Data sets of the paper: the real Oxford positions are among them where they are at hand."""
    return ["oxford", *(["oxford_real"] if POSITIONS.is_file() else []), "umh"]
