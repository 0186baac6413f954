"""Recordings of version 0.1, which had four sensors, each with a log of another name."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.sensors.base import sensors_from_meta

_KINDS = {
    "encoder": "sim.sensors.encoder.Encoder",
    "laser": "sim.sensors.laser.Laser",
    "stereo": "sim.sensors.stereo.StereoCamera",
    "lidar3d": "sim.sensors.lidar3d.Lidar3D",
    "place": "sim.sensors.place.PlaceDescriptor",
}
_SENSOR_OF_LOG = {"laser": "laser", "landmarks": "stereo", "clouds": "lidar3d", "places": "place"}


def upgraded_sensors(old: dict[str, Any]) -> dict[str, Any]:
    """Settings of the sensors with `_target_`, without those that the robot lacked."""
    return {
        name: {"_target_": _KINDS[name], **settings}
        for name, settings in old.items()
        if settings is not None
    }


def upgraded(
    stored: dict[str, NDArray[Any]], meta: dict[str, Any]
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays and description of a recording of format 1, as format 2 has them."""
    arrays: dict[str, NDArray[Any]] = {}
    for name, values in stored.items():
        part, _, key = name.partition(".")
        sensor = _SENSOR_OF_LOG.get(part)
        key = "descriptor" if (part, key) == ("places", "descriptors") else key
        arrays[f"logs.{sensor}.{key}" if sensor else name] = values
    sensors = upgraded_sensors(meta["sensors"])
    if "logs.place.stamps" in arrays:
        sensors["place"] = {"_target_": _KINDS["place"]}
    true_ids = arrays.pop("truth.landmark_ids", np.zeros(0, np.int64))
    if "logs.stereo.stamps" in arrays:
        n_points = len(arrays["logs.stereo.points_in_camera"])
        if len(arrays["logs.stereo.ids"]) != n_points:  # empty where none were observed
            sensors["stereo"]["identifies"] = False
        if not sensors["stereo"]["identifies"]:
            del arrays["logs.stereo.ids"]
        if len(arrays["logs.stereo.descriptors"]) != n_points:
            arrays["logs.stereo.descriptors"] = np.zeros((n_points, 0), np.float32)
        if len(true_ids) == n_points:
            arrays["truth.readings.stereo.true_ids"] = true_ids
    schemas = {
        name: {
            key: dataclasses.asdict(field)
            for key, field in sensor.schema.items()
            if not field.truth or f"truth.readings.{name}.{key}" in arrays
        }
        for name, sensor in sensors_from_meta(sensors, {}).items()
        if f"logs.{name}.stamps" in arrays
    }
    return arrays, {**meta, "sensors": sensors, "schemas": schemas}
