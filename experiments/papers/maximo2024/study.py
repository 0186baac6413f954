"""The studies of maximo2024: weightings M1-M3, particles, starts, clouds of a campus, kidnapping.

The route is the unit of inference: each world is a route (or the real Oxford positions) with
queries and descriptors of its own. Parameters are chosen on seeds below 100 by `tune`, and judged
on seeds from 1000 on.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from estimators import descriptors as describers
from estimators.base import Prior
from estimators.topological_map import TopologicalMap, from_recording
from estimators.topological_mcl import TopologicalMcl
from experiments.papers.maximo2024.places import (
    GEOMETRIES,
    Geometry,
    PlaceWorld,
    described,
    oxford_positions,
    place_world,
    resequenced,
)
from experiments.report.claims import Claim
from experiments.runs.compose import compose
from experiments.runs.experiment import default_cache, make_recording, make_world
from experiments.runs.row import write_frame
from experiments.runs.seeds import stream
from experiments.runs.version import ROOT
from sim.recording import Recording

Array = NDArray[np.float64]
Tables = dict[str, pd.DataFrame]
Profile = Literal["quick", "full"]
Rows = list[dict[str, object]]

PAPER = "maximo2024"
JUDGED_SEED = 1000  # seeds 0-99 are for tuning
POSITIONS = ROOT.parent / "shared" / "data" / "oxford_positions" / "positions.csv.gz"
METHODS = ("M1", "M2", "M3")
PER_NODE = (2, 4, 6, 8)  # table 2
N_REPEATS = 10  # of the filter in each world, as in the paper
# The filter as printed.
AS_PRINTED: dict[str, Any] = {
    "motion": "paper",
    "resampling": "always",
    "scheme": "multinomial",
    "injection": 0.0,
    "estimate": "mean",
    "refine": False,
}
# sigma_l in spacings, sigma_m, B: the least mean error of each method, by `tune`.
TUNED: dict[tuple[str, str], tuple[float, float, int]] = {
    ("oxford", "M1"): (4.0, 0.1, 2),
    ("oxford", "M2"): (4.0, 0.1, 2),
    ("oxford", "M3"): (4.0, 0.1, 1),
    ("umh", "M1"): (2.0, 0.1, 2),
    ("umh", "M2"): (2.0, 0.4, 2),
    ("umh", "M3"): (2.0, 0.1, 2),
}
GRID_SIGMA_L = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
GRID_SIGMA_M = (0.05, 0.1, 0.2, 0.4)
GRID_B = (1, 2, 3, 5, 10, 20)
QUALITIES = (0.4, 0.8, 1.2, 1.6)  # noise weights of the map over descriptor quality
SHARED_SIGMA = (2.0, 0.1)  # of that map, for all methods
# Tables 1 and 2: mean error and deviation, m.
PRINTED_1 = {
    ("oxford", "M1"): (11.54, 0.38),
    ("oxford", "M2"): (9.61, 0.26),
    ("oxford", "M3"): (205.79, 38.88),
    ("umh", "M1"): (1.72, 0.38),
    ("umh", "M2"): (0.40, 0.01),
    ("umh", "M3"): (0.44, 0.01),
}
PRINTED_2 = {
    "oxford": {794: (9.62, 1.09), 1588: (9.73, 0.32), 2382: (9.73, 0.31), 3176: (9.25, 0.45)},
    "umh": {272: (0.40, 0.03), 544: (0.42, 0.02), 816: (0.42, 0.03), 1088: (0.41, 0.01)},
}
TOLERANCE = 1.5  # spacings: an estimate this near is right
HELD = 10  # steps that it has to stay so
WITHIN = 40  # steps to localise in
RECOVERED_WITHIN = 20  # nodes
CAMPUS_SPACING_M = 5.0
CAMPUS_SHIFT_M = 1.0  # the queries' lane beside the map's


def run(
    profile: Profile,
    out: Path,
    on_progress: Callable[[float], None],
    positions: Path | None = POSITIONS,
) -> Tables:
    """Run all studies of the paper and write their tables to `out`.

    Parameters
    ----------
    profile
        `quick`: few worlds and repeats; `full`: what the claims are judged by.
    out
        Folder of the tables.
    on_progress
        Called with the share done.
    positions
        The Oxford positions (`places.oxford_positions`), if they are at hand.
    """
    full = profile == "full"
    real = oxford_positions(positions)
    n_worlds, repeats = (24, N_REPEATS) if full else (3, 2)
    names = ["oxford", "umh", *(["oxford_real"] if real is not None else [])]
    tasks = {
        "weighting": (names, n_worlds, repeats),
        "particles": (names[:2], n_worlds, repeats),
        "starts": (names, n_worlds, 20 if full else 10),
        "kidnapping": (names, n_worlds, 5),
        "quality": (names[:2], 20 if full else 2, 1),
        "clusters": (names, n_worlds, 1),
    }
    campus = "campus" if full else "campus_quick"
    jobs: list[Job] = [
        ("campus", campus, JUDGED_SEED + i, repeats, None) for i in range(4 if full else 1)
    ]
    jobs += [
        (kind, name, JUDGED_SEED + i, count, real)
        for kind, (routes, worlds, count) in tasks.items()
        for name in routes
        for i in range(worlds)
    ]
    tables: dict[str, Rows] = {}
    for done, part in enumerate(_parallel(jobs), start=1):
        for name, rows in part.items():
            tables.setdefault(name, []).extend(rows)
        on_progress(done / len(jobs))
    frames = {name: pd.DataFrame(rows) for name, rows in tables.items()}
    frames["times"] = times()
    frames["table_1"], frames["table_2"] = table_1(frames["weighting"]), table_2(frames)
    for name, frame in frames.items():
        write_frame(frame, out / f"{PAPER}_{name}.csv")
    return frames


Job = tuple[str, str, int, int, Array | None]


def _parallel(jobs: Sequence[Job]) -> Iterable[dict[str, Rows]]:
    from joblib import Parallel, delayed

    done: Iterable[dict[str, Rows]] = Parallel(n_jobs=-1, return_as="generator")(
        delayed(_job)(*job) for job in jobs
    )
    return done


def _job(kind: str, name: str, seed: int, count: int, real: Array | None) -> dict[str, Rows]:
    if kind == "campus":
        return campus_rows(name, seed, count)
    if kind == "quality":
        return {"quality": quality_rows(name, seed)}
    world = world_of(name, seed, real)
    if kind == "weighting":
        return weighting_rows(world, name, seed, count)
    if kind == "particles":
        return {"particles": particle_rows(world, name, seed, count)}
    if kind == "starts":
        return {"starts": start_rows(world, name, seed, count)}
    if kind == "kidnapping":
        return {"kidnapping": kidnapping_rows(world, name, seed, count)}
    return {"clusters": [cluster_row(world.known_map, world.recording, name, "synthetic", seed)]}


def world_of(name: str, seed: int, real: Array | None = None) -> PlaceWorld:
    """World of a geometry; `oxford_real` stands on the real positions."""
    nodes = real if name == "oxford_real" else None
    return place_world(GEOMETRIES[name.removesuffix("_real")], seed, nodes)


def options(name: str, method: str, spacing_m: float, **more: Any) -> dict[str, Any]:
    """The filter as printed with the parameters chosen for a geometry.

    The campus takes those of UMH, untuned, in its own spacings.
    """
    like = "oxford" if name.startswith("oxford") else "umh"
    sigma_l, sigma_m, n_nearest = TUNED[like, method]
    chosen = {
        "weighting": method,
        "sigma_l_m": sigma_l * spacing_m,
        "sigma_m": sigma_m,
        "n_nearest": n_nearest,
        "particles_per_node": 4,
    }
    return {**AS_PRINTED, **chosen, **more}


@dataclasses.dataclass(frozen=True)
class Walk:
    """A filter's run: errors (T,) m, dispersions (T,) m, means (T, 3), particles where kept."""

    errors_m: Array
    dispersions_m: Array
    means: Array
    particles: dict[int, Array]
    refined: NDArray[np.bool_]


def localize(
    known_map: TopologicalMap,
    recording: Recording,
    settings: dict[str, Any],
    rng: np.random.Generator,
    keep: Sequence[int] = (),
    n_steps: int | None = None,
) -> Walk:
    """Localize globally; the dispersion is the particles' mean distance from the estimate."""
    estimator = TopologicalMcl(**settings)
    estimator.reset(Prior(recording.robot, recording.sensors, map=known_map), rng)
    truth = recording.truth_at(recording.frame_stamps)
    means, spread, particles, refined = [], [], {}, []
    for i, frame in enumerate(recording.frames()):
        if i == n_steps:
            break
        belief = estimator.step(frame)
        cloud, weights = belief.extras["particles"], np.exp(belief.extras["log_weights"])
        away = np.hypot(*(cloud[:, :2] - belief.mean[:2]).T)
        means.append(belief.mean)
        spread.append(float(weights @ away / weights.sum()))
        refined.append(belief.extras.get("refinement") == "ok")
        if i in keep:
            particles[i] = cloud
    found = np.array(means)
    errors = np.hypot(*(found[:, :2] - truth[: len(found), :2]).T)
    return Walk(errors, np.array(spread), found, particles, np.array(refined))


def settled_at(errors_m: Array, tolerance_m: float, held: int = HELD) -> float:
    """First step from which the error stays within the tolerance for `held` steps, or NaN."""
    right = (errors_m <= tolerance_m).astype(int)
    if len(right) < held:
        return math.nan
    runs = np.convolve(right, np.ones(held, int), "valid")
    first = np.flatnonzero(runs == held)
    return float(first[0]) if len(first) else math.nan


def weighting_rows(world: PlaceWorld, name: str, seed: int, repeats: int) -> dict[str, Rows]:
    """Table 1 and figure 4: errors of each method over the whole route, and dispersions.

    `M2_mode` is M2 with the mode's mean as its estimate in place of eq. (4).
    """
    errors: Rows = []
    steps: Rows = []
    spacing = world.known_map.spacing_m
    nearest = _nearest_m(world)
    for method in (*METHODS, "M2_mode"):
        more = {"estimate": "mode"} if method == "M2_mode" else {}
        walks = [
            localize(
                world.known_map,
                world.recording,
                options(name, method[:2], spacing, **more),
                stream(seed, "estimator/topological_mcl", repeat),
            )
            for repeat in range(repeats)
        ]
        for repeat, walk in enumerate(walks):
            errors.append(
                {
                    "geometry": name,
                    "seed": seed,
                    "method": method,
                    "repeat": repeat,
                    "error_m": float(walk.errors_m.mean()),
                    "late_error_m": float(walk.errors_m[WITHIN:].mean()),
                    "nearest_node_m": float(nearest.mean()),
                }
            )
        spread = np.mean([walk.dispersions_m[: WITHIN + 1] for walk in walks], axis=0)
        off = np.mean([walk.errors_m[: WITHIN + 1] for walk in walks], axis=0)
        for step, (dispersion, error) in enumerate(zip(spread, off, strict=True)):
            steps.append(
                {
                    "geometry": name,
                    "seed": seed,
                    "method": method,
                    "step": step,
                    "dispersion_m": float(dispersion),
                    "error_m": float(error),
                }
            )
    return {"weighting": errors, "dispersion": steps}


def _nearest_m(world: PlaceWorld) -> Array:
    """Distance (K,) of each query to the nearest node: what a topological estimate cannot beat."""
    taken = world.recording.truth_at(world.recording.frame_stamps)[:, :2]
    gaps: Array = np.hypot(
        *(taken[:, None] - world.known_map.positions_m[None]).transpose(2, 0, 1)
    ).min(axis=1)
    return gaps


def particle_rows(world: PlaceWorld, name: str, seed: int, repeats: int) -> Rows:
    """Table 2: errors of M2 by the number of particles a node."""
    rows: Rows = []
    for per_node in PER_NODE:
        settings = options(name, "M2", world.known_map.spacing_m, particles_per_node=per_node)
        for repeat in range(repeats):
            rng = stream(seed, f"estimator/{per_node}", repeat)
            walk = localize(world.known_map, world.recording, settings, rng)
            rows.append(
                {
                    "geometry": name,
                    "seed": seed,
                    "per_node": per_node,
                    "particles": per_node * len(world.known_map),
                    "repeat": repeat,
                    "error_m": float(walk.errors_m.mean()),
                    "late_error_m": float(walk.errors_m[WITHIN:].mean()),
                }
            )
    return rows


def times() -> pd.DataFrame:
    """Table 2: time a node on one core, undisturbed by the other jobs."""
    from experiments.bench.topological import PAPER_S, run

    measured = {m.name: m.value for m in run()}
    rows = [
        {
            "geometry": name,
            "particles": count,
            "time_s": 1e-3 * measured[f"topological.node_{count}_ms"],
            "paper_s": paper_s,
        }
        for name, counts in PAPER_S.items()
        for count, paper_s in counts.items()
    ]
    return pd.DataFrame(rows)


def table_1(weighting: pd.DataFrame) -> pd.DataFrame:
    """Errors of the methods: mean over worlds, deviation over repeats as in the paper and worlds.

    Beside them the paper's.
    """
    rows: Rows = []
    for (name, method), part in weighting.groupby(["geometry", "method"], sort=False):
        worlds = part.groupby("seed")["error_m"]
        paper_m, paper_sd_m = PRINTED_1.get((name.removesuffix("_real"), method), (math.nan,) * 2)
        rows.append(
            {
                "geometry": name,
                "method": method,
                "error_m": float(worlds.mean().mean()),
                "sd_repeats_m": float(worlds.std(ddof=1).mean()),
                "sd_worlds_m": float(worlds.mean().std(ddof=1)),
                "paper_m": paper_m,
                "paper_sd_m": paper_sd_m,
                "nearest_node_m": float(part["nearest_node_m"].mean()),
            }
        )
    return pd.DataFrame(rows)


def table_2(frames: Tables) -> pd.DataFrame:
    """Errors and times by the number of particles, beside the paper's."""
    taken = frames["times"].set_index(["geometry", "particles"])
    rows: Rows = []
    for (name, count), part in frames["particles"].groupby(["geometry", "particles"], sort=False):
        worlds = part.groupby("seed")["error_m"]
        paper_m, paper_sd_m = PRINTED_2[name][count]
        rows.append(
            {
                "geometry": name,
                "particles": count,
                "error_m": float(worlds.mean().mean()),
                "sd_repeats_m": float(worlds.std(ddof=1).mean()),
                "time_s": float(taken.loc[(name, count), "time_s"]),
                "paper_m": paper_m,
                "paper_sd_m": paper_sd_m,
                "paper_time_s": float(taken.loc[(name, count), "paper_s"]),
            }
        )
    return pd.DataFrame(rows)


def start_rows(world: PlaceWorld, name: str, seed: int, count: int) -> Rows:
    """Figure 5: M2 from starts all along the route."""
    rows: Rows = []
    spacing = world.known_map.spacing_m
    n = len(world.recording.frame_stamps)
    length = WITHIN + HELD
    for start in np.linspace(0, n - length - 1, count).astype(int):
        part = resequenced(world.recording, np.arange(start, start + length))
        rng = stream(seed, "estimator/starts", int(start))
        walk = localize(world.known_map, part, options(name, "M2", spacing), rng)
        rows.append(
            {
                "geometry": name,
                "seed": seed,
                "start": int(start),
                "settled_at": settled_at(walk.errors_m, TOLERANCE * spacing),
            }
        )
    return rows


def kidnapping_rows(world: PlaceWorld, name: str, seed: int, trials: int) -> Rows:
    """Carry the robot off and see whether M2 comes back, without and with injection."""
    rows: Rows = []
    n, spacing = len(world.recording.frame_stamps), world.known_map.spacing_m
    after = RECOVERED_WITHIN + HELD
    draws = stream(seed, "kidnapping")
    for trial in range(trials):
        before = np.arange(30) + draws.integers(0, n // 2 - 40)
        there = np.arange(after) + draws.integers(n // 2, n - after)
        part = resequenced(world.recording, np.concatenate([before, there]))
        for injection in (0.0, 0.05):
            settings = options(name, "M2", spacing, injection=injection, estimate="mode")
            rng = stream(seed, "estimator/kidnapping", trial)
            walk = localize(world.known_map, part, settings, rng)
            rows.append(
                {
                    "geometry": name,
                    "seed": seed,
                    "trial": trial,
                    "injection": injection,
                    "known_before": bool(walk.errors_m[29] <= TOLERANCE * spacing),
                    "settled_at": settled_at(walk.errors_m[30:], TOLERANCE * spacing),
                }
            )
    return rows


def quality_rows(name: str, seed: int) -> Rows:
    """Map of M1-M3 over the descriptors' noise and B, with the same sigmas for all methods."""
    rows: Rows = []
    geometry: Geometry = GEOMETRIES[name]
    for noise in QUALITIES:
        world = place_world(dataclasses.replace(geometry, noise_weight=noise), seed)
        quality = _retrieval(world.known_map, world.recording)
        for n_nearest in GRID_B:
            for method in METHODS:
                settings = options(
                    name,
                    method,
                    1.0,
                    sigma_l_m=SHARED_SIGMA[0] * world.known_map.spacing_m,
                    sigma_m=SHARED_SIGMA[1],
                    n_nearest=n_nearest,
                    particles_per_node=2,
                )
                walk = localize(
                    world.known_map,
                    world.recording,
                    settings,
                    stream(seed, "estimator/quality"),
                    n_steps=136,
                )
                rows.append(
                    {
                        "geometry": name,
                        "seed": seed,
                        "noise_weight": noise,
                        "recall_at_1": quality["recall_at_1"],
                        "n_nearest": n_nearest,
                        "method": method,
                        "error_m": float(walk.errors_m.mean()),
                        "dispersion_m": float(walk.dispersions_m[10]),
                    }
                )
    return rows


def _retrieval(known_map: TopologicalMap, recording: Recording) -> dict[str, float]:
    """Retrieval quality; right is a node within 25 m in Oxford, else within 1.5 spacings."""
    assert recording.places is not None
    kind = describers.KINDS.get(known_map.descriptor)
    compare = kind.distances if kind else describers.euclidean
    taken = recording.places.descriptors
    distances = np.array([compare(row, known_map.descriptors) for row in taken])
    here = recording.truth_at(recording.places.stamps)[:, :2]
    offsets = np.hypot(*(here[:, None] - known_map.positions_m[None]).transpose(2, 0, 1))
    within_m = 25.0 if known_map.spacing_m > 15.0 else 1.5 * known_map.spacing_m
    return describers.retrieval(distances, offsets, within_m)


def cluster_labels(known_map: TopologicalMap, seed: int) -> NDArray[np.int64]:
    """Label (N,) of each node by k-means with 40 clusters, of the best of five starts."""
    from scipy.cluster.vq import kmeans2

    features = known_map.descriptors.astype(np.float64)
    best: tuple[float, NDArray[np.int64]] | None = None
    for start in range(5):
        rng = stream(seed, "clusters", start)
        centres, labels = kmeans2(features, min(40, len(features)), minit="++", seed=rng)
        cost = float(np.sum((features - centres[labels]) ** 2))
        if best is None or cost < best[0]:
            best = cost, labels.astype(np.int64)
    assert best is not None
    return best[1]


def cluster_row(
    known_map: TopologicalMap, recording: Recording, name: str, descriptor: str, seed: int
) -> dict[str, object]:
    """Figure 2: share of nodes with a route neighbour in their cluster; retrieval beside."""
    labels = cluster_labels(known_map, seed)
    same = labels[1:] == labels[:-1]
    beside = np.append(same, False) | np.append(False, same)
    return {
        "geometry": name,
        "seed": seed,
        "descriptor": descriptor,
        "nodes": len(known_map),
        "contiguous": float(beside.mean()),
        **_retrieval(known_map, recording),
    }


def campus_runs(name: str, seed: int) -> tuple[Recording, Recording]:
    """Mapping run and query run through one campus, the queries one lane to the left.

    `campus` is driven by PyBullet, `campus_quick` by the kinematic robot. Ray casting is exact:
    the same faces, at a tenth of the time.
    """
    physics = "bullet" if name == "campus" else "kinematic"
    settings = [
        "study=maximo2024_campus",
        f"world_seed={seed}",
        f"simulation.physics={physics}",
        "simulation.rays=exact",
    ]
    mapping = compose([*settings, f"seed={seed}"])
    taking = compose([*settings, f"seed={seed + 500}"])
    way = make_world(mapping).waypoints
    along = np.gradient(way, axis=0)
    along[[0, -1]] = way[1] - way[-2]  # the tour is closed
    left = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(*along.T)[:, None]
    taking["route"]["waypoints"] = (way + CAMPUS_SHIFT_M * left).tolist()
    cache = default_cache()
    return make_recording(mapping, cache), make_recording(taking, cache)


def campus_rows(name: str, seed: int, repeats: int) -> dict[str, Rows]:
    """All that is judged on simulated clouds, in one campus."""
    mapping, taking = campus_runs(name, seed)
    tables: dict[str, Rows] = {"clusters": []}
    for descriptor in describers.KINDS:
        known = from_recording(mapping, descriptor, CAMPUS_SPACING_M)
        queries = described(taking, descriptor)
        fine = from_recording(mapping, descriptor, GEOMETRIES["umh"].spacing_m)
        row = cluster_row(fine, queries, name, descriptor, seed)
        tables["clusters"].append(row | _retrieval(known, queries))
        if descriptor == "scan_context":
            kept, kept_queries = known, queries
    # As the paper has it: one query a node, the filter as printed, nothing tuned for it
    poses = kept_queries.truth_at(kept_queries.frame_stamps)
    gone = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    marks = np.arange(0.0, gone[-1], kept.spacing_m)
    rows = np.unique(np.searchsorted(gone, marks))
    one_a_node = dataclasses.replace(resequenced(kept_queries, rows), clouds=None)
    geometry = dataclasses.replace(GEOMETRIES["umh"], name=name)
    tables |= weighting_rows(PlaceWorld(geometry, kept, one_a_node), name, seed, repeats)
    tables["campus_starts"] = _campus_starts(kept, kept_queries, name, seed)
    tables["kidnapping"] = _campus_kidnapping(kept, kept_queries, name, seed)
    return tables


def _campus_starts(known: TopologicalMap, queries: Recording, name: str, seed: int) -> Rows:
    """Default filter from 60 starts: when it is localised, and how well where it refines."""
    rows: Rows = []
    n, length = len(queries.frame_stamps), WITHIN + HELD
    for start in np.linspace(0, n - length - 1, 60).astype(int):
        part = resequenced(queries, np.arange(start, start + length))
        walk = localize(known, part, {}, stream(seed, "estimator/starts", int(start)))
        settled = settled_at(walk.errors_m, known.spacing_m)
        after = walk.errors_m[int(settled) :] if math.isfinite(settled) else np.zeros(0)
        rows.append(
            {
                "geometry": name,
                "seed": seed,
                "start": int(start),
                "spacing_m": known.spacing_m,
                "settled_at": settled,
                "rms_m": float(np.sqrt(np.mean(after**2))) if len(after) else math.nan,
                "median_m": float(np.median(after)) if len(after) else math.nan,
                "refined": float(walk.refined.mean()),
            }
        )
    return rows


def _campus_kidnapping(known: TopologicalMap, queries: Recording, name: str, seed: int) -> Rows:
    """Default filter by odometry, carried half a round away, without and with injection."""
    rows: Rows = []
    bare = dataclasses.replace(queries, clouds=None)
    n, after = len(queries.frame_stamps), 4 * RECOVERED_WITHIN
    per_node = known.spacing_m / np.median(np.abs(np.diff(queries.wheels.position_m[:, 0])))
    draws = stream(seed, "kidnapping")
    for trial in range(25):
        before = np.arange(30) + draws.integers(0, n // 2 - 40)
        there = np.arange(after) + draws.integers(n // 2, n - after)
        part = resequenced(bare, np.concatenate([before, there]))
        for injection in (0.0, 0.02):
            rng = stream(seed, "estimator/kidnapping", trial)
            walk = localize(known, part, {"injection": injection}, rng)
            settled = settled_at(walk.errors_m[30:], TOLERANCE * known.spacing_m)
            rows.append(
                {
                    "geometry": name,
                    "seed": seed,
                    "trial": trial,
                    "injection": injection,
                    "known_before": bool(walk.errors_m[29] <= TOLERANCE * known.spacing_m),
                    "settled_at": settled / per_node,
                }
            )
    return rows


def tune(n_worlds: int = 12, out: Path = ROOT / "results" / "tables") -> pd.DataFrame:
    """Mean error of every setting of the grid on seeds 0, 1, ...; the least is `TUNED`.

    Takes some ten minutes on two cores. All methods see the same worlds and draws.
    """
    from joblib import Parallel, delayed

    jobs = [(name, seed) for seed in range(n_worlds) for name in GEOMETRIES]
    parts = Parallel(n_jobs=-1)(delayed(_tuning_rows)(*job) for job in jobs)
    table = pd.DataFrame([row for part in parts for row in part])
    keys = ["geometry", "method", "sigma_l", "sigma_m", "n_nearest"]
    means = table.groupby(keys, as_index=False)["error_m"].mean()
    write_frame(means, out / f"{PAPER}_tuning.csv")
    return means


def _tuning_rows(name: str, seed: int) -> Rows:
    world = world_of(name, seed)
    rows: Rows = []
    grid = [
        (method, sigma_l, sigma_m, n_nearest)
        for method in METHODS
        for sigma_l in GRID_SIGMA_L
        for sigma_m in (GRID_SIGMA_M if method == "M2" else (0.1,))  # M1 and M3 do not feel it
        for n_nearest in GRID_B
    ]
    for method, sigma_l, sigma_m, n_nearest in grid:
        settings = options(
            name,
            method,
            1.0,
            sigma_l_m=sigma_l * world.known_map.spacing_m,
            sigma_m=sigma_m,
            n_nearest=n_nearest,
        )
        walk = localize(
            world.known_map, world.recording, settings, stream(seed, "estimator/tuning")
        )
        rows.append(
            {
                "geometry": name,
                "seed": seed,
                "method": method,
                "sigma_l": sigma_l,
                "sigma_m": sigma_m,
                "n_nearest": n_nearest,
                "error_m": float(walk.errors_m.mean()),
            }
        )
    return rows


def claims(tables: Tables, *, quick: bool) -> list[Claim]:
    """Judge MX1-MX5 and what is judged on clouds, by the tables."""
    from experiments.papers.maximo2024.claims import judge

    command = f"estima reproduce --paper {PAPER}" + ("" if quick else " --full")
    return [claim.completed(study=PAPER, command=command, quick=quick) for claim in judge(tables)]


def figures(tables: Tables) -> dict[str, Figure]:
    """Draw all figures of the paper, by file name."""
    from experiments.papers.maximo2024.figures import pages

    return pages(tables)
