"""Draw the worlds of docs/worlds.md: `python tools/worlds_figure.py docs/figures/worlds.png`."""

import sys
from pathlib import Path

from experiments.runs.experiment import Experiment
from experiments.viewing.style import BLUE, save_figure, subplots
from experiments.viewing.world import draw_people, draw_world

WORLDS = ("clutter", "curved", "corridors_alike", "hall", "orchard", "warehouse", "polygon")
CHANGED = "world.changed_share=0.5"
PEOPLE = ("people.n=6", "route.distance_m=40", "simulation.physics=kinematic")


def main(out: Path) -> None:
    """Nine panels: a world each, a map of another day, and people's tracks."""
    page, axes = subplots(11.0, 10.5, 3, 3)
    panels = list(axes.flat)
    for ax, name in zip(panels, WORLDS, strict=False):
        draw_world(ax, Experiment.compose([f"world={name}"]).world(), landmarks=False, tour=True)
        ax.set_title(f"world={name}", loc="left")
    changed, walked = panels[len(WORLDS) :]
    draw_world(changed, Experiment.compose(["world=rooms", CHANGED]).world(), landmarks=False)
    changed.set_title(f"{CHANGED}: the known map in orange", loc="left", fontsize="medium")
    recording = Experiment.compose(["world=rooms", *PEOPLE]).recording()
    draw_world(walked, recording.known_world, landmarks=False)
    draw_people(walked, recording.known_truth)
    walked.plot(*recording.known_truth.poses[:, :2].T, color=BLUE, lw=1.4)
    walked.set_title(f"{PEOPLE[0]}: their tracks, and the robot's", loc="left", fontsize="medium")
    save_figure(page, out)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
