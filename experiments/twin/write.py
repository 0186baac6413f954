"""Files of a twin: a study for `estima run`, its world and way, and the log that it was made of."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from experiments.twin.make import Twin
from sim.errors import require
from sim.files import write_text
from sim.formats.tum import write_tum
from sim.recording import save
from sim.sensors.base import sensor_settings
from sim.worlds.grid_file import write_grid

_HEAD = """# @package _global_
# A twin, made by `estima twin`: estima run study={file} estimator=NAME
# The same estimator on the log: estima run study={file} estimator=NAME recording={log}
"""
_DIGITS = 9


def write_twin(twin: Twin, out: Path) -> list[Path]:
    """Write the study and, beside it, NAME_world.yaml, NAME_way.tum and NAME_log.npz.

    Raises
    ------
    InputError
        If the name does not end in .yaml, or a file cannot be written.
    """
    check_name(out)
    place = out.resolve()
    world, way, log = (
        place.with_name(f"{out.stem}_{part}") for part in ("world.yaml", "way.tum", "log.npz")
    )
    if twin.grid is None:
        x, y, heading = twin.way[0]
        document = {
            "name": out.stem,
            "landmarks": _plain(twin.landmarks),
            "start_pose": _plain([x, y, np.degrees(heading)]),
        }
        write_text(world, yaml.safe_dump(document, sort_keys=False, default_flow_style=None))
    else:
        write_grid(twin.grid, world)
    write_tum(way, twin.stamps, twin.way)
    save(twin.rest, log)
    kind = "from_file" if twin.grid is None else "from_grid"
    options = {"world": kind, "robot": "puzzlebot", "sensors": "encoder", "route": "timetable"}
    study = {
        "defaults": [{f"override /{group}": option} for group, option in options.items()],
        "world": {"path": str(world)},
        "robot": _plain(dataclasses.asdict(twin.robot)),
        "sensors": {name: _plain(sensor_settings(s)) for name, s in twin.sensors.items()},
        "route": {"path": str(way)},
        "simulation": {"physics": "kinematic"},
        "name": out.stem,
    }
    text = yaml.safe_dump(study, sort_keys=False, default_flow_style=None, width=100)
    write_text(out, _HEAD.format(file=out, log=out.with_name(log.name)) + "\n" + text)
    return [out, world, way, log]


def check_name(out: Path) -> None:
    """Refuse a name that is not one of a study."""
    require(
        out.suffix == ".yaml" and out.stem.isidentifier(),
        f"{out}: a twin is a .yaml file whose name is one word, such as twin.yaml",
    )


def _plain(value: Any) -> Any:
    """Plain values with so many significant digits as matter."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(part) for part in value]
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value
