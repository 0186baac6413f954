"""Routes of places for topological localization: geometry, synthetic descriptors, recordings.

maximo2024 works on two routes whose clouds and network are not available. Their geometry is as
printed, or from positions that the user has; a synthetic field of descriptors replaces the network.
"""

import dataclasses
import functools
import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.topological.topological_map import (
    TopologicalMap,
    from_arrays,
    from_recording,
    read_array,
)
from experiments.evaluation.metrics import travelled_m
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from experiments.runs.targets import make
from sim import se2
from sim.arrays import Array, Floats
from sim.errors import InputError
from sim.options import find
from sim.recording import Log, Recording, Truth, WheelLog
from sim.robot.drive import RobotGeometry
from sim.robot.slip import wheel_errors
from sim.sensors import Lidar3D, PlaceDescriptor

# Noisy unit descriptors (K, 512) at points (K, 2) m
Describe = Callable[[Array, np.random.Generator], NDArray[np.float32]]

Offsets = Literal["along", "plane"]

N_STRETCHES = 40  # the paper's k-means clusters
SIZE = 512  # of the paper's descriptors
OXFORD_RUN = "2015-08-12-15-04-18"
_CAR = RobotGeometry(wheel_radius_m=0.3, track_m=1.5)
_PLACE = PlaceDescriptor()


@dataclass(frozen=True)
class Geometry:
    """A route as in maximo2024, sec. 3, and the field of descriptors over it.

    Attributes
    ----------
    n_nodes, spacing_m, spacing_sd_m
        The map's, and the distance of successive nodes.
    offset_m, offset_sd_m
        Distance of a query to the nearest node.
    share, share_sd
        Where a query lies between two nodes, as a share of the way to the next; by these the
        mean offset is the printed one.
    drift
        Share of a plane offset that is new from one query to the next.
    stretch_weight, place_weight, noise_weight
        How much of a descriptor is common to its stretch of the route, how much belongs to the
        place, and how much is noise of the single observation.
    place_scale_m
        Distance over which the place's own part changes.
    interval_s
        Between queries.
    """

    name: str
    n_nodes: int
    spacing_m: float
    spacing_sd_m: float
    offset_m: float
    offset_sd_m: float
    share: float
    share_sd: float
    drift: float
    stretch_weight: float
    place_weight: float
    noise_weight: float
    place_scale_m: float
    interval_s: float


OXFORD = Geometry(
    "oxford", 397, 21.43, 3.19, 10.09, 5.25, 0.5, 0.036, 0.02, 1.0, 0.4, 0.8, 25.0, 2.56
)
UMH = Geometry("umh", 136, 2.32, 0.05, 0.39, 0.02, 0.168, 0.0086, 0.02, 0.3, 1.0, 0.8, 3.0, 1.0)
GEOMETRIES = {"oxford": OXFORD, "umh": UMH}


@dataclass(frozen=True)
class PlaceWorld:
    """A map, and the queries along its route."""

    known_map: TopologicalMap
    recording: Recording


def gaps_m(points_m: Array, nodes_m: Array) -> Array:
    """Distances (K, N) m of points (K, 2) to nodes (N, 2)."""
    return np.asarray(np.hypot(*(points_m[:, None] - nodes_m[None]).transpose(2, 0, 1)))


def oxford_positions(path: Path, run: str = OXFORD_RUN) -> Array:
    """Positions (N, 2) m, east and north, of an Oxford run's map, less their mean.

    Parameters
    ----------
    path
        The positions' `.csv.gz` with columns run_name, set, northing_m and easting_m.
    run
        One of `oxford_runs`; the paper's has 397 nodes.

    Raises
    ------
    InputError
        If the file is missing or holds something else, or not this run.
    """
    table = _oxford_table(path)
    chosen = table[table["run_name"] == run]
    if len(chosen) < 2:
        known = ", ".join(sorted(set(table["run_name"])))
        raise InputError(f"{path}: no database positions of run {run!r}; it holds {known}")
    positions = np.array(chosen[["easting_m", "northing_m"]], np.float64, order="C")
    return np.asarray(positions - positions.mean(axis=0))


def oxford_runs(path: Path) -> list[str]:
    """Names of the runs in a file of `oxford_positions`, by date."""
    return sorted(set(_oxford_table(path)["run_name"]))


def _oxford_table(path: Path) -> pd.DataFrame:
    """Positions of the maps of all runs: run_name, easting_m and northing_m, finite."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; set positions to null for a made route")
    try:
        table = pd.read_csv(path, compression="gzip", float_precision="round_trip")
        table = table.loc[table["set"] == "database", ["run_name", "easting_m", "northing_m"]]
        table = table.astype({"run_name": str, "easting_m": float, "northing_m": float})
    except (OSError, KeyError, ValueError, EOFError) as error:
        raise InputError(f"{path}: not the Oxford positions ({error}); leave it out") from error
    if not np.isfinite(table[["easting_m", "northing_m"]]).all(axis=None):
        raise InputError(f"{path}: a position is not finite; get the file again")
    return table


def route(geometry: Geometry, rng: np.random.Generator) -> Array:
    """Positions (N, 2) m of nodes along a generated route with the geometry's spacing."""
    n = geometry.n_nodes
    steps = geometry.spacing_m + geometry.spacing_sd_m * rng.standard_normal(n - 1)
    if geometry.name == "oxford":  # streets: straights with turns at crossings
        turn = np.zeros(n - 1)
        at = 0
        while (at := at + int(rng.integers(6, 20))) < n - 1:
            turn[at] = rng.choice([-0.5, 0.5]) * math.pi * rng.uniform(0.7, 1.1)
        turn += 0.06 * rng.standard_normal(n - 1)
    else:  # paths among trees
        turn = np.convolve(0.05 * rng.standard_normal(n + 8), np.ones(10), "valid")
    heading = rng.uniform(-math.pi, math.pi) + np.cumsum(turn)
    moves = steps[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(moves, axis=0)])


def queries(
    nodes_m: Array, geometry: Geometry, rng: np.random.Generator, offsets: Offsets = "along"
) -> Array:
    """Positions (N, 2) m of the queries, one per node.

    Map and queries are split from one recording of one drive (sec. 3), so a query lies on the
    way to the next node. Its distance to the nearest node is the printed one in the mean. The
    printed deviation in Oxford, 5.25 m, is more than nodes 21 m apart allow on the way, 1.6 m.

    Parameters
    ----------
    offsets
        `along` the route; `plane`: off it, with the printed mean and deviation.
    """
    if offsets not in get_args(Offsets):
        raise InputError(f"offsets must be {' or '.join(get_args(Offsets))}, got {offsets!r}")
    if offsets == "plane":
        return _off_the_route(nodes_m, geometry, rng)
    way = np.diff(nodes_m, axis=0, append=2.0 * nodes_m[-1:] - nodes_m[-2:-1])
    shares = geometry.share + geometry.share_sd * rng.standard_normal((len(nodes_m), 1))
    return np.asarray(nodes_m + shares * way)


def _off_the_route(nodes_m: Array, geometry: Geometry, rng: np.random.Generator) -> Array:
    """Queries (N, 2) m off the route, as a control.

    In Oxford the offset is a plane Gaussian that changes slowly (the printed mean and deviation
    of the distance, 10.09 and 5.25 m, are those of a Rayleigh law); in UMH it has a constant
    length and slowly turns.
    """
    n = len(nodes_m)
    way = np.gradient(nodes_m, axis=0)
    forward = way / np.maximum(np.hypot(*way.T), 1e-9)[:, None]
    left = forward[:, ::-1] * [-1.0, 1.0]
    if geometry.name == "oxford":
        sigma = 1.15 * geometry.offset_m / math.sqrt(math.pi / 2.0)
        kept = 1.0 - geometry.drift
        fresh = np.full((n, 1), sigma * math.sqrt(1.0 - kept**2))
        fresh[0] = sigma
        offset = lfilter([1.0], [1.0, -kept], fresh * rng.standard_normal((n, 2)), axis=0)
        offset *= sigma / math.sqrt(np.mean(offset**2))  # the printed size in every world
    else:
        turning = np.cumsum(geometry.drift * rng.standard_normal(n))
        angle = rng.uniform(-math.pi, math.pi) + turning
        length = geometry.offset_m + geometry.offset_sd_m * rng.standard_normal(n)
        offset = length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(nodes_m + offset[:, :1] * forward + offset[:, 1:] * left)


def field(geometry: Geometry, nodes_m: Array, rng: np.random.Generator) -> Describe:
    """Synthetic descriptors: a part common to a stretch, a part of the place, and noise.

    The stretches, 40 along the route, crossfade into each other. The place's own part is a
    random Fourier feature map of the position, so that it changes smoothly and never repeats.
    """
    along = travelled_m(nodes_m)
    along /= max(along[-1], 1e-9)
    lengths = rng.uniform(0.5, 1.5, N_STRETCHES)
    middles = (np.cumsum(lengths) - lengths / 2.0) / lengths.sum()
    edges, width = (middles[1:] + middles[:-1]) / 2.0, 0.15 / N_STRETCHES
    stretches = rng.standard_normal((N_STRETCHES, SIZE))
    stretches /= np.linalg.norm(stretches, axis=1, keepdims=True)
    waves = rng.standard_normal((2, SIZE)) / geometry.place_scale_m
    phases = rng.uniform(0.0, 2.0 * math.pi, SIZE)

    def describe(points_m: Array, rng: np.random.Generator) -> NDArray[np.float32]:
        here = along[np.argmin(gaps_m(points_m, nodes_m), axis=1)]
        above = 1.0 / (1.0 + np.exp(-np.clip((here[:, None] - edges) / width, -50.0, 50.0)))
        shares = -np.diff(above, axis=1, prepend=1.0, append=0.0)
        place = math.sqrt(2.0 / SIZE) * np.cos(points_m @ waves + phases)
        noise = rng.standard_normal((len(points_m), SIZE)) / math.sqrt(SIZE)
        whole = geometry.stretch_weight * (shares @ stretches) + geometry.place_weight * place
        whole += geometry.noise_weight * noise
        return np.asarray(whole / np.linalg.norm(whole, axis=1, keepdims=True), np.float32)

    return describe


def place_world(
    geometry: Geometry, seed: int, nodes_m: Array | None = None, offsets: Offsets = "along"
) -> PlaceWorld:
    """Map and queries of one world: the route is generated unless positions are given.

    The map does not depend on queries along the route. Those in the plane are drawn before it, as
    in former versions, so that `estima check` keeps its recordings.
    """
    if nodes_m is None:
        nodes_m = route(geometry, stream(seed, "world"))
    rng = stream(seed, "places")
    before = queries(nodes_m, geometry, rng, offsets) if offsets == "plane" else None
    describe = field(geometry, nodes_m, rng)
    known_map = from_arrays(nodes_m, describe(nodes_m, rng))
    queries_m = queries(nodes_m, geometry, rng, offsets) if before is None else before
    seen, slip = describe(queries_m, rng), stream(seed, "slip")
    return PlaceWorld(known_map, query_recording(queries_m, seen, geometry.interval_s, slip))


def query_recording(
    positions_m: Array,
    descriptors: NDArray[np.float32],
    interval_s: float,
    rng: np.random.Generator,
    k: float = 1e-4,
) -> Recording:
    """Recording of descriptors taken at positions (K, 2), with wheels that slip by k, m."""
    n = len(positions_m)
    if descriptors.ndim != 2 or len(descriptors) != n or n < 2:
        raise InputError(
            f"a route of queries needs at least two positions and as many descriptors, got {n} "
            f"and shape {descriptors.shape}"
        )
    moves = np.diff(positions_m, axis=0)
    heading = np.unwrap(np.arctan2(moves[:, 1], moves[:, 0]))
    heading = np.append(heading, heading[-1])
    travel = np.hypot(*moves.T)[:, None] * np.ones(2)
    travel += np.diff(heading)[:, None] * _CAR.track_m / 2.0 * np.array([1.0, -1.0])
    stamps = interval_s * np.arange(n, dtype=np.float64)
    rolled = np.cumsum(travel + wheel_errors(travel, k, rng), axis=0)
    return Recording(
        stamps,
        WheelLog(stamps, np.concatenate([np.zeros((1, 2)), rolled])),
        _CAR,
        sensors={"place": _PLACE},
        logs={"place": Log.of(_PLACE, stamps, descriptor=descriptors)},
        truth=Truth(stamps, np.column_stack([positions_m, se2.wrap(heading)])),
        config={"places": "queries along a route"},
    )


def resequence(recording: Recording, rows: NDArray[np.int64]) -> Recording:
    """The recording's observations in another order, each with the travel before it.

    Rows 100, 101, ... start elsewhere on the route; a jump in the rows is a kidnapping that the
    wheels do not show. Rows count the place descriptors or, without them, the clouds.
    """
    kept = [name for name in ("place", "lidar3d") if name in recording.logs]
    stamps = recording.log(kept[0] if kept else "lidar3d").stamps
    rolled = recording.wheels.at(stamps)
    steps = np.diff(rolled, axis=0, prepend=2.0 * rolled[:1] - rolled[1:2])
    new_stamps = np.cumsum(np.diff(stamps, prepend=2.0 * stamps[0] - stamps[1])[rows])
    return dataclasses.replace(
        recording,
        frame_stamps=new_stamps,
        wheels=WheelLog(new_stamps, np.cumsum(steps[rows], axis=0)),
        truth=Truth(new_stamps, recording.truth_at(stamps)[rows]),
        logs={name: recording.log(name).select(rows, new_stamps) for name in kept},
        commands=None,
    )


def describe_clouds(
    recording: Recording, describe: Callable[[Lidar3D, Floats], Floats]
) -> Recording:
    """The recording with a place descriptor for each of its clouds."""
    lidar, clouds = recording.sensor("lidar3d", Lidar3D), recording.log("lidar3d")
    rows = np.array([describe(lidar, turn) for turn in clouds["ranges_m"]])
    places = Log.of(_PLACE, clouds.stamps.copy(), descriptor=rows)
    return recording.with_log("place", places, _PLACE)


# What a configuration names under `recording` and `prior.map`.


def route_recording(
    config: dict[str, Any],
    geometry: str,
    positions: str | None = None,
    positions_run: str = OXFORD_RUN,
    noise_weight: float | None = None,
    offsets: Offsets = "along",
    first_query: int = 0,
    n_queries: int | None = None,
) -> Recording:
    """Queries of a route, by the configuration's world_seed.

    Parameters
    ----------
    geometry
        `oxford` or `umh`.
    positions, positions_run
        File and run of `oxford_positions`; None: the route is generated.
    noise_weight
        Of the descriptors; None: the geometry's own.
    offsets
        Of the queries, as in `queries`.
    first_query, n_queries
        Where the robot starts, and how many queries there are from there; None: all.
    """
    whole = _route(config, geometry, positions, positions_run, noise_weight, offsets).recording
    n = len(whole.frame_stamps)
    if not 0 <= first_query <= n - 2:
        raise InputError(f"recording.first_query must be from 0 to {n - 2}, got {first_query}")
    most = n - first_query
    if n_queries is not None and not 1 <= n_queries <= most:
        raise InputError(f"recording.n_queries must be from 1 to {most}, got {n_queries}")
    part = resequence(whole, np.arange(first_query, n)) if first_query else whole
    return part if n_queries is None else part.cut(n_queries)


def route_map(
    config: dict[str, Any],
    geometry: str,
    positions: str | None = None,
    positions_run: str = OXFORD_RUN,
    noise_weight: float | None = None,
    offsets: Offsets = "along",
) -> TopologicalMap:
    """Map of the same route."""
    return _route(config, geometry, positions, positions_run, noise_weight, offsets).known_map


def _route(
    config: dict[str, Any],
    name: str,
    positions: str | None,
    run: str,
    noise_weight: float | None,
    offsets: Offsets,
) -> PlaceWorld:
    if name not in GEOMETRIES:
        raise InputError(f"geometry must be {' or '.join(GEOMETRIES)}, got {name!r}")
    geometry = GEOMETRIES[name]
    if noise_weight is not None:
        geometry = dataclasses.replace(geometry, noise_weight=noise_weight)
    real = name == "oxford" and positions is not None
    nodes = oxford_positions(Path(str(positions)), run) if real else None
    return place_world(geometry, config["world_seed"], nodes, offsets)


def recording_from_files(
    config: dict[str, Any], positions: str, descriptors: str, interval_s: float = 1.0
) -> Recording:
    """The user's own queries: positions (K, 2) and descriptors (K, D) as `.npy` or `.csv`.

    The wheels go straight from each position to the next, without slip.
    """
    places = read_array(Path(positions))
    if places.ndim != 2 or places.shape[1] != 2:
        raise InputError(f"{positions}: queries need shape (K, 2), got {places.shape}")
    features = read_array(Path(descriptors)).astype(np.float32)
    rng = stream(Experiment(config).seed, "slip")
    return query_recording(places, features, interval_s, rng, k=0.0)


def mapping_run(
    config: dict[str, Any],
    seed: int,
    spacing_m: float = 5.0,
    descriptor: str = "scan_context",
    network: dict[str, Any] | None = None,
) -> TopologicalMap:
    """Map from another run through the same world, whose slip and noise are those of `seed`.

    Parameters
    ----------
    descriptor, network
        What describes its clouds: a name of `estimators.topological.descriptors.KINDS`, or a
        network as in `described_run`.
    """
    made = Experiment(config).with_values(seed=seed, recording=None).recording()
    if network is not None:
        made = describe_clouds(made, _by_network(network))
    return from_recording(made, descriptor, spacing_m)


def described_run(config: dict[str, Any], network: dict[str, Any]) -> Recording:
    """The simulated run, its clouds described by a network of one's own.

    Parameters
    ----------
    network
        `_target_` names a function of a cloud's points (P, 3) m in the lidar's frame that returns
        a descriptor (D,); other keys go to it too. Or a class: they make an object, which is
        called with the points.
    """
    return describe_clouds(
        Experiment(config).with_values(recording=None).recording(), _by_network(network)
    )


def _by_network(settings: dict[str, Any]) -> Callable[[Lidar3D, Floats], Floats]:
    target = find(settings.get("_target_"), "network")
    own = {key: value for key, value in settings.items() if key != "_target_"}
    is_class = inspect.isclass(target)
    network = make(settings, "network") if is_class else functools.partial(target, **own)

    def describe(lidar: Lidar3D, ranges_m: Floats) -> Floats:
        row = np.asarray(network(lidar.points_in_sensor(ranges_m)), np.float32)
        if row.ndim != 1 or not np.isfinite(row).all():
            raise InputError(
                f"network: {settings['_target_']} must return finite numbers of shape (D,), got "
                f"shape {row.shape}"
            )
        return row

    return describe
