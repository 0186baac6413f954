"""A run in PyBullet's window: the true robot among its walls, and the estimate beside it.

The engine ends its process when it cannot open a window. So a display is looked for first, and the
window gets a process of its own; if that fails, one line says so.
"""

import math
import multiprocessing
import os
import sys
import time
from typing import Any

import numpy as np

from experiments.viewing.animation import all_sensor_points, bounds
from experiments.viewing.playback import Playback
from sim.arrays import Array
from sim.errors import require
from sim.worlds.world import World

FPS = 20
_REMEDY = "save the run in a file instead, such as run.html, run.gif or run.mp4"
_HEIGHT_M = 0.1  # of the robots
_CUT_M = 0.4  # walls are shown up to this height
_TRAIL_EVERY = 5  # pictures
_SCAN_EVERY = 3  # pictures
_UNKNOWN = np.full(3, np.nan)
_BLACK, _BLUE, _RED = (0.1, 0.1, 0.1), (0.0, 0.45, 0.7), (0.84, 0.37, 0.0)


def check_display() -> None:
    """Raise InputError if there is no display for a window."""
    require(
        not sys.platform.startswith("linux") or os.environ.get("DISPLAY"),
        f"no display for a window (DISPLAY is not set); {_REMEDY}",
    )


def watch(run: Playback, seconds: float | None = None) -> None:
    """Show the run in a window until it has ended and the window is closed.

    Parameters
    ----------
    seconds
        How long the whole run is to take; None: real time.

    Raises
    ------
    InputError
        Without a display, or if no window can be opened on it.
    """
    check_display()
    process = multiprocessing.get_context("spawn").Process(target=_window, args=(run, seconds))
    process.start()
    process.join()
    require(not process.exitcode, f"the window could not be opened or was lost; {_REMEDY}")


def _window(run: Playback, seconds: float | None) -> None:
    """Body of the window's process: play once, then wait for the window to be closed."""
    with open(os.devnull, "w") as sink:
        os.dup2(sink.fileno(), 1)  # the engine prints about its threads and OpenGL
    from sim.robot import bullet

    engine: Any = vars(bullet)["pybullet"]
    client = engine.connect(engine.GUI)
    if client < 0:
        sys.exit(1)
    try:
        _play(engine, run, seconds)
        while engine.isConnected(client):
            engine.stepSimulation()
            time.sleep(0.05)
    except KeyboardInterrupt:
        sys.exit(0)  # the process that waits reports it
    except engine.error:
        if engine.isConnected(client):
            raise  # else the window was closed, as it should be


def _play(engine: Any, run: Playback, seconds: float | None) -> None:
    """Move the robots by the clock, from the first shown Frame to the last."""
    engine.configureDebugVisualizer(engine.COV_ENABLE_GUI, 0)
    (own,), stamps = run.robots, run.stamps
    recording = own.recording
    if recording.world is not None and len(recording.world.walls):
        _build_walls(engine, recording.world)
    truth = own.truth_at(stamps)
    x1, y1, x2, y2 = bounds(run)  # the world and the whole path, from above
    distance_m = 1.2 * math.hypot(x2 - x1, y2 - y1) + 2.0
    engine.resetDebugVisualizerCamera(distance_m, 0, -65, [(x1 + x2) / 2.0, (y1 + y2) / 2.0, 0.0])
    radius = max(recording.robot.track_m / 2.0, 0.1)
    bodies, colours = {}, {"truth": _BLACK, "estimate": _BLUE}
    if recording.truth is not None:
        bodies["truth"] = _body(engine, radius, _BLACK, 1.0)
    if own.estimate is not None:
        bodies["estimate"] = _body(engine, 1.1 * radius, _BLUE, 0.5)
    trails: dict[str, Array] = {}
    replaced: dict[str, int] = {}  # the scan drawn last, once there is one
    speed = 1.0 if seconds is None else max(stamps[-1] - stamps[0], 1e-9) / seconds
    begun = time.monotonic()
    for i, stamp in enumerate(stamps):
        time.sleep(max(0.0, (stamp - stamps[0]) / speed - (time.monotonic() - begun)))
        known = own.belief_row(float(stamp)) >= 0
        poses = {"truth": truth[i], "estimate": own.pose_at(stamp) if known else _UNKNOWN}
        for name, body in bodies.items():
            pose = poses[name]
            if not np.isfinite(pose).all():
                continue
            turned = engine.getQuaternionFromEuler([0, 0, float(pose[2])])
            engine.resetBasePositionAndOrientation(body, [*pose[:2], _HEIGHT_M / 2], turned)
            before = trails.setdefault(name, pose)
            if i % _TRAIL_EVERY == 0:
                engine.addUserDebugLine([*before[:2], 0.02], [*pose[:2], 0.02], colours[name], 2)
                trails[name] = pose
        points = (
            all_sensor_points(own, float(stamp))[::3] if i % _SCAN_EVERY == 0 else np.zeros((0, 2))
        )
        if len(points):
            raised = np.column_stack([points, np.full(len(points), 0.2)]).tolist()
            scan = engine.addUserDebugPoints(raised, [_RED] * len(points), 3, **replaced)
            replaced = {"replaceItemUniqueId": scan}
        engine.stepSimulation()  # lets the window respond


def _build_walls(engine: Any, world: World) -> None:
    """All walls as one mesh for show, visible from both sides; cut low, to see over them."""
    (x1, y1, x2, y2), (low, high) = world.walls.T, np.minimum(world.wall_z_m.T, _CUT_M)
    corners = [(x1, y1, low), (x2, y2, low), (x2, y2, high), (x1, y1, high)]
    vertices = np.stack([np.stack(corner, axis=-1) for corner in corners], axis=1)
    faces = np.array([0, 1, 2, 0, 2, 3, 0, 2, 1, 0, 3, 2])
    indices = 4 * np.arange(len(world.walls))[:, None] + faces
    shape = engine.createVisualShape(
        engine.GEOM_MESH,
        vertices=vertices.reshape(-1, 3).tolist(),
        indices=indices.ravel().tolist(),
        rgbaColor=[0.55, 0.55, 0.6, 1.0],
    )
    engine.createMultiBody(0, -1, shape)


def _body(engine: Any, radius_m: float, colour: tuple[float, float, float], alpha: float) -> int:
    """A disc with a nose that shows its heading."""
    disc = engine.createVisualShape(
        engine.GEOM_CYLINDER, radius=radius_m, length=_HEIGHT_M, rgbaColor=[*colour, alpha]
    )
    nose = engine.createVisualShape(
        engine.GEOM_SPHERE, radius=0.4 * radius_m, rgbaColor=[*_RED, alpha]
    )
    body: int = engine.createMultiBody(
        0,
        -1,
        disc,
        linkMasses=[0],
        linkCollisionShapeIndices=[-1],
        linkVisualShapeIndices=[nose],
        linkPositions=[[radius_m, 0, 0]],
        linkOrientations=[[0, 0, 0, 1]],
        linkInertialFramePositions=[[0, 0, 0]],
        linkInertialFrameOrientations=[[0, 0, 0, 1]],
        linkParentIndices=[0],
        linkJointTypes=[engine.JOINT_FIXED],
        linkJointAxis=[[0, 0, 1]],
    )
    return body
