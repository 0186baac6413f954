"""One world of the study: a map and queries, the filter's runs in it, and their rows.

A world is a route with a synthetic field of descriptors, or a campus with simulated clouds.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from estimators.base import Estimate, Prior
from estimators.topological import descriptors as describers
from estimators.topological.topological_map import TopologicalMap, from_recording
from experiments.evaluation.metrics import position_errors_m, rms, travelled_m
from experiments.judging.free_settings import Anchor, free_settings
from experiments.judging.results import Profile
from experiments.papers.maximo2024.places import (
    N_STRETCHES,
    UMH,
    describe_clouds,
    gaps_m,
    resequence,
)
from experiments.papers.maximo2024.settings import (
    CAMPUS_SHIFT_M,
    CLUSTERED,
    HELD,
    KIDNAPPED_AFTER,
    LEAST_M,
    METHODS,
    N_CAMPUS_KIDNAPPINGS,
    N_CAMPUS_STARTS,
    N_KIDNAPPINGS,
    N_REPEATS,
    PER_NODE,
    PLACES,
    POSITIONS,
    QUICK_STEPS,
    RECOVERED_WITHIN,
    SIGMA_L,
    SIGMA_M,
    TOLERANCE,
    WITHIN,
    B,
)
from experiments.runs.evaluate import run_over
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from experiments.runs.seeds import stream
from sim.arrays import Array
from sim.errors import require
from sim.recording import Recording

Rows = list[Row]


@dataclass(frozen=True)
class Case:
    """One world of a geometry: the filter's experiment, the map and the queries.

    Attributes
    ----------
    name, seed
        Geometry, and the seed of its world and noise.
    experiment
        Composed from conf/study/maximo2024/*.yaml.
    """

    name: str
    seed: int
    experiment: Experiment
    known_map: TopologicalMap
    recording: Recording


def make_case(name: str, seed: int, *overrides: str) -> Case:
    """World of a route; `oxford_real` has the real positions, `_plane` queries off the route.

    The noise of its descriptors is that of the anchor, unless `overrides` has another.
    """
    route, _, kind = name.partition("_")
    noise = anchored(name)["recording.noise_weight"]
    lines = [f"study=maximo2024/{route}", f"seed={seed}", f"recording.noise_weight={noise}"]
    lines += overrides
    if kind == "real":
        lines.append(f"positions='{POSITIONS}'")
    if kind == "plane":
        lines.append("recording.offsets=plane")
    experiment = Experiment.compose(lines)
    recording = experiment.recording()
    return Case(name, seed, experiment, experiment.prior(recording).map, recording)


def options(
    case: Case, method: str = "M2", parameters: tuple[float, float, int] | None = None
) -> dict[str, Any]:
    """Keys of the estimator: a method, with the parameters of the geometry's anchor or others.

    The campus takes those of UMH, untuned, in units of its own spacing.

    Parameters
    ----------
    parameters
        sigma_l in node spacings, sigma_m, B.
    """
    sigma_l, sigma_m, n_nearest = parameters or _parameters(anchored(case.name))
    return {
        "weighting": method,
        "sigma_l_m": sigma_l * case.known_map.spacing_m,
        "sigma_m": sigma_m,
        "n_nearest": n_nearest,
    }


def anchored(name: str) -> Mapping[str, Any]:
    """The free settings at the anchor of a geometry; of a campus, UMH's."""
    place = PLACES.get(name.removesuffix("_plane"), "UMH")
    at = free_settings("maximo2024")["MX1"].printed[place].anchor
    require(at is not None, f"maximo2024/design.yaml: MX1 has no anchor on {place}")
    return cast(Anchor, at).settings


@dataclass(frozen=True)
class Walk:
    """A filter's run: errors (T,) m, dispersions (T,) m, and the estimate itself."""

    errors_m: Array
    dispersions_m: Array
    estimate: Estimate


def localize(
    case: Case,
    settings: dict[str, Any],
    rng: np.random.Generator,
    recording: Recording | None = None,
    keep: Sequence[str] = (),
) -> Walk:
    """Localize globally.

    Parameters
    ----------
    settings
        Keys of the estimator in place of the experiment's.
    recording
        In place of the case's own.
    keep
        Further Belief extras to record.
    """
    taken = case.recording if recording is None else recording
    estimate, _ = run_over(
        taken,
        case.experiment.with_estimator(**settings).estimator(),
        Prior(taken.robot, taken.sensors, map=case.known_map),
        rng,
        keep=("dispersion_m", "refinement", *keep),
    )
    errors = position_errors_m(taken.truth_at(taken.frame_stamps), estimate.means)
    return Walk(errors, np.array(estimate.extras["dispersion_m"]), estimate)


def settling_step(errors_m: Array, tolerance_m: float) -> float:
    """First step from which the error stays within the tolerance for `HELD` steps, or NaN."""
    if len(errors_m) < HELD:
        return math.nan
    right = (errors_m <= tolerance_m).astype(int)
    first = np.flatnonzero(np.convolve(right, np.ones(HELD, int), "valid") == HELD)
    return float(first[0]) if len(first) else math.nan


def weighting_rows(case: Case, n_repeats: int, methods: Sequence[str] = METHODS) -> dict[str, Rows]:
    """Table 1 and figure 4: errors of each method over the whole route, and dispersions."""
    tables: dict[str, Rows] = {"weighting": [], "dispersion": []}
    nearest_m = _nearest_node_m(case)
    for method in methods:
        settings = options(case, method)
        walks = _repeated(case, settings, "estimator/topological_mcl", n_repeats)
        label = {"method": method, "n_nearest": settings["n_nearest"]}
        tables["weighting"] += [
            {**label, **row, "nearest_node_m": nearest_m} for row in _errors(walks)
        ]
        spread = np.mean([walk.dispersions_m[: WITHIN + 1] for walk in walks], axis=0)
        error = np.mean([walk.errors_m[: WITHIN + 1] for walk in walks], axis=0)
        tables["dispersion"] += [
            {**label, "step": i, "dispersion_m": float(away), "error_m": float(off)}
            for i, (away, off) in enumerate(zip(spread, error, strict=True))
        ]
    return tables


def _nearest_node_m(case: Case) -> float:
    """Mean distance of the queries to the nearest node, m."""
    taken = case.recording.truth_at(case.recording.frame_stamps)[:, :2]
    return float(gaps_m(taken, case.known_map.positions_m).min(axis=1).mean())


def run_rows(positions_run: str, seed: int, n_repeats: int) -> Iterator[Row]:
    """Table 1 on the positions of any Oxford run."""
    case = make_case("oxford_real", seed, f"positions_run={positions_run}")
    label = {"nodes": len(case.known_map), "nearest_node_m": _nearest_node_m(case)}
    for method in METHODS:
        walks = _repeated(case, options(case, method), "estimator/topological_mcl", n_repeats)
        yield from ({"method": method, **label, **row} for row in _errors(walks))


def particle_rows(case: Case, n_repeats: int) -> Iterator[Row]:
    """Table 2: errors of M2 by the number of particles per node."""
    for per_node in PER_NODE:
        settings = options(case) | {"particles_per_node": per_node}
        walks = _repeated(case, settings, f"estimator/{per_node}", n_repeats)
        label = {"per_node": per_node, "particles": per_node * len(case.known_map)}
        yield from (label | row for row in _errors(walks))


def _repeated(case: Case, settings: dict[str, Any], axis: str, n_repeats: int) -> list[Walk]:
    return [localize(case, settings, stream(case.seed, axis, i)) for i in range(n_repeats)]


def _errors(walks: list[Walk]) -> Rows:
    """Mean errors of each repeat, and of its part after the search."""
    return [
        {
            "repeat": repeat,
            "error_m": float(walk.errors_m.mean()),
            "late_error_m": float(walk.errors_m[WITHIN:].mean()),
        }
        for repeat, walk in enumerate(walks)
    ]


def starts(
    case: Case, n_starts: int, settings: dict[str, Any], tolerance_m: float
) -> Iterator[tuple[int, float, Walk]]:
    """Figure 5: starts all along the route, the step at which each is localized, and its run."""
    length = WITHIN + HELD
    for start in map(int, np.linspace(0, len(case.recording.frame_stamps) - length - 1, n_starts)):
        part = resequence(case.recording, np.arange(start, start + length))
        walk = localize(case, settings, stream(case.seed, "estimator/starts", start), part)
        yield start, settling_step(walk.errors_m, tolerance_m), walk


def kidnapping_rows(
    case: Case,
    settings: dict[str, Any],
    injection: float,
    n_trials: int,
    n_after: int,
    queries_per_node: float = 1.0,
) -> Iterator[Row]:
    """Kidnap the robot and see whether the filter finds it again, without and with injection.

    Parameters
    ----------
    n_after
        Queries after the kidnapping.
    """
    n, tolerance_m = len(case.recording.frame_stamps), TOLERANCE * case.known_map.spacing_m
    draws = stream(case.seed, "kidnapping")
    for trial in range(n_trials):
        before = np.arange(KIDNAPPED_AFTER) + draws.integers(0, n // 2 - 40)
        there = np.arange(n_after) + draws.integers(n // 2, n - n_after)
        part = resequence(case.recording, np.concatenate([before, there]))
        for share in (0.0, injection):
            rng = stream(case.seed, "estimator/kidnapping", trial)
            errors = localize(case, settings | {"injection": share}, rng, part).errors_m
            yield {
                "trial": trial,
                "injection": share,
                "known_before": bool(errors[KIDNAPPED_AFTER - 1] <= tolerance_m),
                "settled_at": settling_step(errors[KIDNAPPED_AFTER:], tolerance_m)
                / queries_per_node,
            }


def reference_run(values: Mapping[str, Any], seed: int) -> Row:
    """Level of M2, which the paper prints, on both routes at free settings."""
    found: Row = {}
    for place, case in _cases_at(values, seed, Profile.FULL):
        settings = options(case, "M2", _parameters(values))
        walk = localize(case, settings, stream(seed, "estimator/region"))
        found[f"{place}_m2_m"] = float(walk.errors_m.mean())
    return found


def _cases_at(values: Mapping[str, Any], seed: int, profile: Profile) -> Iterator[tuple[str, Case]]:
    """World of each route at free settings."""
    given = [f"{key}={value}" for key, value in values.items() if key.startswith("recording.")]
    for place, name in (
        ("oxford", "oxford_real" if POSITIONS.is_file() else "oxford"),
        ("umh",) * 2,
    ):
        case = make_case(name, seed, *given)
        is_quick = profile is Profile.QUICK
        part = case.recording.cut(QUICK_STEPS) if is_quick else case.recording
        yield place, replace(case, recording=part)


def _parameters(values: Mapping[str, Any]) -> tuple[float, float, int]:
    return float(values[SIGMA_L]), float(values[SIGMA_M]), int(values[B])


def region_run(_name: str, values: Mapping[str, Any], seed: int, profile: Profile) -> Row:
    """Levels of all methods on both routes at free settings: errors, dispersions, starts."""
    row: Row = {}
    for place, case in _cases_at(values, seed, profile):
        for method in METHODS:
            settings = options(case, method, _parameters(values))
            walk = localize(case, settings, stream(seed, "estimator/region"))
            row[f"{place}_{method.lower()}_m"] = float(walk.errors_m.mean())
            row[f"{place}_{method.lower()}_dispersion_m"] = float(walk.dispersions_m[10]) + LEAST_M
        row[f"{place}_nearest_m"] = _nearest_node_m(case)
        by_m2 = options(case, "M2", _parameters(values))
        for per_node in (min(PER_NODE), max(PER_NODE)):
            settings = by_m2 | {"particles_per_node": per_node}
            walk = localize(case, settings, stream(seed, f"estimator/region/{per_node}"))
            row[f"{place}_m2_{per_node}_m"] = float(walk.errors_m.mean())
        row |= {f"{place}_{key}": value for key, value in start_errors(case, by_m2).items()}
    return row


def start_errors(case: Case, settings: dict[str, Any]) -> Row:
    """Least and greatest of the mean errors from the three starts of figure 5, m."""
    n, errors = len(case.recording.frame_stamps), []
    for start in (0, n // 4, n // 2):
        part = resequence(case.recording, np.arange(start, n)) if start else case.recording
        walk = localize(case, settings, stream(case.seed, "estimator/from", start), part)
        errors.append(float(walk.errors_m.mean()))
    return {"least_start_m": min(errors), "most_start_m": max(errors)}


def _retrieval(known_map: TopologicalMap, recording: Recording) -> dict[str, float]:
    """Retrieval quality; right is a node within 25 m in Oxford, else within 1.5 spacings."""
    places, kind = recording.log("place"), describers.KINDS.get(known_map.descriptor)
    compare = kind.distances if kind else describers.euclidean
    distances = np.array([compare(row, known_map.descriptors) for row in places["descriptor"]])
    here = recording.truth_at(places.stamps)[:, :2]
    within_m = 25.0 if known_map.spacing_m > 15.0 else 1.5 * known_map.spacing_m
    return describers.retrieval(distances, gaps_m(here, known_map.positions_m), within_m)


def cluster_labels(known_map: TopologicalMap, seed: int) -> NDArray[np.int64]:
    """Label (N,) of each node by k-means with 40 clusters, of the best of five starts."""
    features = known_map.descriptors.astype(np.float64)
    n_clusters = min(N_STRETCHES, len(features))
    streams = [stream(seed, "clusters", start) for start in range(5)]
    found = [kmeans2(features, n_clusters, minit="++", seed=rng) for rng in streams]
    costs = [np.sum((features - centres[labels]) ** 2) for centres, labels in found]
    return np.asarray(found[int(np.argmin(costs))][1], np.int64)


def cluster_row(known_map: TopologicalMap, recording: Recording, descriptor: str, seed: int) -> Row:
    """Figure 2: share of nodes with a route neighbour in their cluster; retrieval beside."""
    return _contiguous(known_map, descriptor, seed) | _retrieval(known_map, recording)


def _contiguous(known_map: TopologicalMap, descriptor: str, seed: int) -> Row:
    same = np.diff(cluster_labels(known_map, seed)) == 0
    return {
        "descriptor": descriptor,
        "nodes": len(known_map),
        "contiguous": float((np.append(same, False) | np.append(False, same)).mean()),
    }


# A campus


def campus_runs(seed: int) -> tuple[Experiment, Experiment]:
    """Mapping run and query run through one campus, the queries one lane to the left."""
    mapping = Experiment.compose(
        ["study=maximo2024/campus", f"seed={seed}", "simulation.physics=kinematic"]
    )
    way = mapping.world().waypoints
    along = np.gradient(way, axis=0)
    along[[0, -1]] = way[1] - way[-2]  # the tour is closed
    left = along[:, ::-1] * [-1.0, 1.0] / np.hypot(*along.T)[:, None]
    route = {**mapping.options_of("route"), "waypoints": (way + CAMPUS_SHIFT_M * left).tolist()}
    return mapping, mapping.with_values(seed=seed + 500, route=route)  # the same world_seed


def _campus_case(seed: int) -> tuple[Case, float]:
    """A campus with its queries, and how many of these there are to a node."""
    mapping, taking = campus_runs(seed)
    mapped, taken = mapping.recording(), taking.recording()
    settings = mapping.options_of("prior.map")
    known = from_recording(mapped, settings["descriptor"], settings["spacing_m"])
    queries = describe_clouds(taken, describers.kind(settings["descriptor"]).describe)
    per_node = float(known.spacing_m / np.median(np.abs(np.diff(taken.wheels.position_m[:, 0]))))
    return Case("campus", seed, taking, known, queries), per_node


def _without_clouds(case: Case) -> Case:
    places = {"place": case.recording.log("place")}
    return replace(case, recording=replace(case.recording, logs=places))


def campus_rows(seed: int, profile: Profile, *, with_retrieval: bool) -> dict[str, Rows]:
    """Weightings and starts in one campus.

    Parameters
    ----------
    with_retrieval
        Also describe the clouds in every way.
    """
    case, _ = _campus_case(seed)
    bare = _one_query_a_node(_without_clouds(case))
    return {
        "retrieval": list(_retrieval_by_clouds(seed)) if with_retrieval else [],
        **weighting_rows(bare, N_REPEATS[profile]),
        "campus_starts": list(_campus_starts(case, N_CAMPUS_STARTS[profile])),
    }


def _retrieval_by_clouds(seed: int) -> Iterator[Row]:
    mapping, taking = campus_runs(seed)
    mapped, taken = mapping.recording(), taking.recording()
    for descriptor in describers.KINDS:
        known = from_recording(mapped, descriptor, mapping.options_of("prior.map")["spacing_m"])
        queries = describe_clouds(taken, describers.kind(descriptor).describe)
        yield {"descriptor": descriptor, **_retrieval(known, queries)}


def cloud_clusters(seed: int) -> Iterator[Row]:
    """Describe the clouds of a campus in each way that k-means allows for, and cluster them."""
    (mapping, _) = campus_runs(seed)
    mapped = mapping.recording()
    for descriptor in CLUSTERED:
        yield _contiguous(from_recording(mapped, descriptor, UMH.spacing_m), descriptor, seed)


def kidnappings(name: str, seed: int, profile: Profile) -> Iterator[Row]:
    """Kidnappings in one world of a route, or in one campus."""
    if name == "campus":
        case, per_node = _campus_case(seed)
        n, n_after = N_CAMPUS_KIDNAPPINGS[profile], 4 * RECOVERED_WITHIN
        return kidnapping_rows(_without_clouds(case), {}, 0.02, n, n_after, per_node)
    case = make_case(name, seed)
    by_mode = options(case) | {"estimate": "mode"}
    return kidnapping_rows(case, by_mode, 0.05, N_KIDNAPPINGS, RECOVERED_WITHIN + HELD)


def _one_query_a_node(case: Case) -> Case:
    """As in the paper: one query per node, the filter as printed, nothing tuned for it."""
    gone = travelled_m(case.recording.truth_at(case.recording.frame_stamps))
    rows = np.unique(np.searchsorted(gone, np.arange(0.0, gone[-1], case.known_map.spacing_m)))
    printed = Experiment.compose(["estimator=topological_mcl_paper"])
    experiment = case.experiment.with_values(estimator=printed.options_of("estimator"))
    return replace(case, experiment=experiment, recording=resequence(case.recording, rows))


def _campus_starts(case: Case, n_starts: int) -> Iterator[Row]:
    """Default filter from starts along the way: when it is localized, and how well once refined."""
    spacing_m = case.known_map.spacing_m
    for start, settled, walk in starts(case, n_starts, {}, spacing_m):
        after = walk.errors_m[int(settled) :] if math.isfinite(settled) else np.array([math.nan])
        refinement = walk.estimate.extras["refinement"]
        yield {
            "start": start,
            "spacing_m": spacing_m,
            "settled_at": settled,
            "rms_m": rms(after),
            "median_m": float(np.median(after)),
            "refined": float(np.mean([state == "ok" for state in refinement])),
        }
