"""A recording in words."""

from __future__ import annotations

import numpy as np

from sim.recording import Recording


def describe(recording: Recording) -> str:
    """Describe what a recording holds, in lines of text."""
    logs = {
        "wheels": recording.wheels,
        "laser": recording.laser,
        "landmarks": recording.landmarks,
        "3D lidar": recording.clouds,
        "places": recording.places,
        "commands": recording.commands,
    }
    lines = [
        f"status      {recording.status}",
        f"frames      {len(recording.frame_stamps)} over {recording.duration_s:.2f} s",
        f"robot       wheel radius {recording.robot.wheel_radius_m} m, "
        f"track {recording.robot.track_m} m",
    ]
    for name, log in logs.items():
        if log is None:
            continue
        lines.append(f"{name:<11} {len(log.stamps)} readings{_rate(log.stamps)}")
        if log is recording.laser:
            ranges_m = recording.laser.ranges_m
            seen = 100 * np.isfinite(ranges_m).mean() if ranges_m.size else 0.0
            lines.append(f"            {ranges_m.shape[1]} beams, {seen:.1f} % of them in range")
        if log is recording.landmarks:
            mean = len(recording.landmarks.points_in_camera) / max(len(log.stamps), 1)
            lines.append(f"            {mean:.1f} landmarks an image")
    truth = recording.truth
    if truth is None:
        lines.append("truth       none")
    else:
        distance = float(np.sum(np.hypot(*np.diff(truth.poses[:, :2], axis=0).T)))
        where = f" in world {truth.world.name}" if truth.world else ""
        lines.append(f"truth       {distance:.2f} m travelled{where}")
    if "source" in recording.config:
        lines.append(f"source      {recording.config['source']}")
        for name, value in recording.config.get("notes", {}).items():
            lines.append(f"            {name.replace('_', ' ')}: {value}")
    if "seed" in recording.config:
        lines.append(f"seed        {recording.config['seed']}")
    lines.append(f"checksum    {recording.checksum}")
    return "\n".join(lines)


def _rate(stamps: np.ndarray) -> str:
    if len(stamps) < 2:
        return ""
    return f", every {1000 * float(np.median(np.diff(stamps))):.1f} ms"
