"""Relations: which motion lies between the poses at two stamps, as people verified it.

Lines of `stamp1 stamp2 x y z roll pitch yaw`, with blanks or commas: the pose at stamp2 in the
frame of the pose at stamp1.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim.arrays import Array
from sim.files import write_text
from sim.formats.text import Words, read_words


@dataclass(frozen=True)
class Relations:
    """Relations in the plane: stamps (N, 2) s and motion (N, 3), m, m, rad."""

    stamps: Array
    motion: Array


def read_relations(path: Path) -> Relations:
    """Read relations, plain or packed; height, roll and pitch are dropped.

    Raises
    ------
    InputError
        Naming the file and the line that is not eight finite numbers.
    """
    return parse_relations(read_words(path))


def parse_relations(words: Words) -> Relations:
    """The relations in a file's words."""
    table = words.table(8, "relations")
    return Relations(table[:, :2].copy(), table[:, [2, 3, 7]])


def write_relations(path: Path, relations: Relations) -> None:
    """Write relations, all digits kept."""
    rows = np.zeros((len(relations.stamps), 8))
    rows[:, :2], rows[:, [2, 3, 7]] = relations.stamps, relations.motion
    lines = [" ".join(f"{value:.17g}" for value in row) + "\n" for row in rows]
    write_text(path, "".join(lines))
