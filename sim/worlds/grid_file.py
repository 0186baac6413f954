"""Grids as the map server of ROS reads and writes them: a YAML file that names an image.

```yaml
image: office.pgm             # beside this file, or an absolute path
mode: trinary                 # trinary | scale | raw; trinary where it is left out
resolution: 0.05              # m a pixel
origin: [-1.0, -2.0, 0.0]     # of the lower left corner: x m, y m, yaw rad
negate: 0                     # 1: white is occupied
occupied_thresh: 0.65
free_thresh: 0.196
```

A pixel's shade runs from 0 (black) to 1 (white), and its occupancy is 1 - shade, or the shade if
`negate` is set. The modes turn it into a probability (nav2_map_server, map_io.cpp):

- trinary: occupied above `occupied_thresh`, free below `free_thresh`, else unknown. An image with
  transparency has its opacity averaged with its colours.
- scale: the same, but from 0 to 1 between the thresholds; transparent pixels are unknown.
- raw: the shade in 255ths is the probability in percent, unknown above 100.

Keys that the map server does not know are passed over, as it does.
"""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from PIL import Image

from sim.arrays import Floats
from sim.errors import InputError, require
from sim.files import require_file, write_whole
from sim.worlds.grid import FREE_BELOW, OCCUPIED_ABOVE, OccupancyGrid, check_size
from sim.yaml_file import number, read_yaml, shown

SUFFIXES = (".yaml", ".yml")
_KEYS = {  # of a complete file, with what the map server writes
    "image": "the name of a .pgm file",
    "resolution": "0.05",
    "origin": "[0.0, 0.0, 0.0]",
    "negate": "0",
    "occupied_thresh": f"{OCCUPIED_ABOVE}",
    "free_thresh": f"{FREE_BELOW}",
}
_MODES = ("trinary", "scale", "raw")
_FORMATS = ("PPM", "PNG", "BMP", "JPEG")
_MOST_BYTES = 1_000_000  # of the YAML
_OCCUPIED, _FREE, _UNKNOWN = 0, 254, 205  # the map server's own grey levels
_RAW_UNKNOWN = 255
# What Pillow raises for files that are not what they should be
_UNREADABLE = (
    OSError,
    ValueError,
    SyntaxError,
    MemoryError,
    Image.DecompressionBombError,
    Image.DecompressionBombWarning,
)


def read_grid(path: str | Path) -> OccupancyGrid:
    """Read a grid.

    Parameters
    ----------
    path
        The YAML file. A string can come from a configuration:
        `prior.map={_target_: sim.worlds.grid_file.read_grid, path: office.yaml}`.

    Raises
    ------
    InputError
        Naming the file, the key and what it must be.
    """
    path = Path(path)
    document = _document(path)
    for key, usual in _KEYS.items():
        require(
            document.get(key) is not None,
            f"{path}: {key} is missing; the map server writes {key}: {usual}",
        )
    image, origin, negate = document["image"], document["origin"], document["negate"]
    mode = document.get("mode", "trinary")
    checks = {
        f"image must be {_KEYS['image']}, got {shown(image)}": isinstance(image, str) and image,
        f"origin must be [x, y, yaw], got {shown(origin)}": (
            isinstance(origin, list) and len(origin) == 3
        ),
        f"negate must be 0 or 1, got {shown(negate)}": negate in (0, 1),
        f"mode must be {', '.join(_MODES)}, got {shown(mode)}": mode in _MODES,
    }
    for complaint, holds in checks.items():
        require(holds, f"{path}: {complaint}")
    resolution_m, occupied, free = (
        number(document[key], f"{path}: {key}")
        for key in ("resolution", "occupied_thresh", "free_thresh")
    )
    require(resolution_m > 0.0, f"{path}: resolution must be positive, got {resolution_m:g}")
    require(
        0.0 <= free < occupied <= 1.0,
        f"{path}: free_thresh must be below occupied_thresh, both between 0 and 1, got {free:g} "
        f"and {occupied:g}",
    )
    pose = [number(value, f"{path}: origin[{i}]") for i, value in enumerate(origin)]
    probability = _probability(path.parent / image, mode, bool(negate), (free, occupied))
    return OccupancyGrid(probability, resolution_m, np.array(pose))


def write_grid(
    grid: OccupancyGrid, path: Path, mode: Literal["trinary", "raw"] = "trinary"
) -> None:
    """Write a grid's YAML file, and its image beside it as PGM.

    Parameters
    ----------
    mode
        `trinary` keeps free, occupied and unknown apart, and every reader knows it; `raw` keeps
        probabilities too, in percent.

    Raises
    ------
    InputError
        If the name does not end in .yaml, or the files cannot be written.
    """
    check_name(path)
    require(mode in ("trinary", "raw"), f"a grid is written as trinary or raw, got {mode!r}")
    if mode == "raw":
        known = np.isfinite(grid.probability)
        percent = np.rint(100.0 * np.where(known, grid.probability, 0.0))
        shades = np.where(known, percent, _RAW_UNKNOWN).astype(np.uint8)
    else:
        shades = np.full(grid.probability.shape, _UNKNOWN, np.uint8)
        shades[grid.free], shades[grid.occupied] = _FREE, _OCCUPIED
    image = path.with_suffix(".pgm")
    rows, columns = shades.shape
    with write_whole(image) as part, part.open("wb") as file:
        file.write(f"P5\n{columns} {rows}\n255\n".encode())
        file.write(np.ascontiguousarray(shades[::-1]).data)  # the first row is the top
    meta = {
        "image": image.name,
        "mode": mode,
        "resolution": float(grid.resolution_m),
        "origin": [float(value) for value in grid.origin],
        "negate": 0,
        "occupied_thresh": OCCUPIED_ABOVE,
        "free_thresh": FREE_BELOW,
    }
    with write_whole(path) as part:
        part.write_text(yaml.safe_dump(meta, sort_keys=False, default_flow_style=None))


def check_name(path: Path) -> None:
    """Refuse a name that is not one of a grid."""
    require(path.suffix in SUFFIXES, f"{path}: a grid is a .yaml file, with its image beside it")


def _document(path: Path) -> Mapping[str, Any]:
    document: Mapping[str, Any] = read_yaml(path, _MOST_BYTES)
    require(isinstance(document, Mapping), f"{path}: must hold the keys {', '.join(_KEYS)}")
    return document


def _probability(image: Path, mode: str, negate: bool, thresholds: tuple[float, float]) -> Floats:
    """Probability (rows, columns), its first row at the bottom; NaN where unknown."""
    shade, opacity = _shades(image)
    if mode == "trinary" and opacity is not None:
        shade = (3.0 * shade + opacity) / 4.0
    if mode == "raw":
        percent = np.rint(255.0 * shade)
        return np.where(percent <= 100.0, percent / 100.0, np.nan).astype(np.float32)[::-1]
    occupancy = shade if negate else np.float32(1.0) - shade
    free, occupied = thresholds
    between, unknown = np.full(shade.shape, np.nan), np.zeros(shade.shape, bool)
    if mode == "scale":
        between = np.clip((occupancy - free) / (occupied - free), 0.0, 1.0)
        unknown |= opacity is not None and opacity < 1.0
    sure = [unknown, occupancy > occupied, occupancy < free]
    out = np.select(sure, [np.nan, 1.0, 0.0], between)
    return np.ascontiguousarray(out[::-1], dtype=np.float32)


def _shades(path: Path) -> tuple[Floats, Floats | None]:
    """Shades (rows, columns) from 0 (black) to 1, the mean of a pixel's colours; and opacities."""
    remedy = f"a grid's image is {', '.join(_FORMATS).replace('PPM', 'PGM')}"
    require_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with path.open("rb") as file, Image.open(file, formats=_FORMATS) as image:
                check_size(image.height, image.width, str(path), "crop it, or scale it down")
                image.load()
                return _levels(image)
    except FileNotFoundError:
        raise InputError(f"{path}: no such image; check image in the grid's YAML file") from None
    except _UNREADABLE as error:
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: truncated or no image ({reason}); {remedy}") from error


def _levels(image: Image.Image) -> tuple[Floats, Floats | None]:
    if image.mode == "F":
        raise ValueError("floating-point pixels")
    if image.mode.startswith("I"):  # 16 bits, which Pillow spreads over 0 to 65535
        return np.asarray(image, np.float32) / np.float32(65535.0), None
    if image.mode in ("1", "L"):
        return np.asarray(image.convert("L"), np.float32) / np.float32(255.0), None
    see_through = image.mode in ("LA", "PA", "RGBA") or "transparency" in image.info
    channels = np.asarray(image.convert("RGBA" if see_through else "RGB"))
    colours = channels[..., :3].mean(axis=2, dtype=np.float32) / np.float32(255.0)
    if not see_through:
        return colours, None
    return colours, channels[..., 3].astype(np.float32) / np.float32(255.0)
