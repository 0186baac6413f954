"""Sensors: one file each. A new one is a class like these, anywhere, and a YAML that names it."""

from sim.sensors.base import (
    Field,
    Mount,
    Reading,
    Schema,
    Sensor,
    Sensors,
    View,
    sensor_of,
    sensors_from_config,
)
from sim.sensors.encoder import Encoder
from sim.sensors.gyroscope import Gyroscope
from sim.sensors.laser import Laser
from sim.sensors.lidar3d import Lidar3D
from sim.sensors.place import PlaceDescriptor
from sim.sensors.real_camera import RealCamera
from sim.sensors.real_laser import RealLaser
from sim.sensors.robots import RobotCamera
from sim.sensors.stereo import StereoCamera

__all__ = [
    "Encoder",
    "Field",
    "Gyroscope",
    "Laser",
    "Lidar3D",
    "Mount",
    "PlaceDescriptor",
    "Reading",
    "RealCamera",
    "RealLaser",
    "RobotCamera",
    "Schema",
    "Sensor",
    "Sensors",
    "StereoCamera",
    "View",
    "sensor_of",
    "sensors_from_config",
]
