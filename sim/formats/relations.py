"""Relations: which motion lies between the poses at two stamps, as people verified it.

Lines of `stamp1 stamp2 x y z roll pitch yaw`, with blanks or commas: the pose at stamp2 in the
frame of the pose at stamp1.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim.arrays import Array
from sim.errors import require
from sim.files import write_whole
from sim.formats.text import Words, read_words


@dataclass(frozen=True)
class Relations:
    """Relations in the plane: stamps (N, 2) s and motion (N, 3), m, m, rad."""

    stamps: Array
    motion: Array


def read_relations(source: Path | Words) -> Relations:
    """Read relations, plain or packed; height, roll and pitch are dropped.

    Raises
    ------
    InputError
        Naming the file and the line that is not eight finite numbers; or if the lines are those of
        a trajectory, which has eight columns too.
    """
    words = read_words(source)
    table = words.table(8, "relations")
    turns = np.linalg.norm(table[:, 4:], axis=1)
    require(
        not len(table) or np.any(np.abs(turns - 1.0) > 1e-3),
        f"{words.where}: a trajectory (.tum), not relations",
    )
    return Relations(table[:, :2].copy(), table[:, [2, 3, 7]])


def write_relations(path: Path, relations: Relations) -> None:
    """Write relations, all digits kept."""
    rows = np.zeros((len(relations.stamps), 8))
    rows[:, :2], rows[:, [2, 3, 7]] = relations.stamps, relations.motion
    with write_whole(path) as part:
        np.savetxt(part, rows, "%.17g")
