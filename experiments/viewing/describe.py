"""A recording in words."""

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
    if recording.truth is None:
        lines.append("truth       none")
    else:
        steps = np.diff(recording.truth.poses[:, :2], axis=0)
        where = f" in world {recording.world.name}" if recording.world else ""
        lines.append(f"truth       {np.hypot(*steps.T).sum():.2f} m travelled{where}")
    if "source" in recording.config:
        lines.append(f"source      {recording.config['source']}")
        notes = recording.config.get("notes", {})
        lines += [f"            {key.replace('_', ' ')}: {note}" for key, note in notes.items()]
    if "seed" in recording.config:
        lines.append(f"seed        {recording.config['seed']}")
    lines.append(f"checksum    {recording.checksum}")
    return "\n".join(lines)


def _rate(stamps: np.ndarray) -> str:
    if len(stamps) < 2:
        return ""
    return f", every {1000 * float(np.median(np.diff(stamps))):.1f} ms"
