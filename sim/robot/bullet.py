"""The PyBullet robot and its rays: the only module that imports pybullet.

The robot is two sphere-shaped wheels, two frictionless casters and a box, centred over the axle.
At zero slip a straight 2 m run ends within 0.1 mm and 0.01 degrees, and the effective track is
the nominal one within 0.01 %.
"""

import contextlib
import math
import os
import sys
from collections.abc import Iterator

import numpy as np

from sim.arrays import Array
from sim.errors import require
from sim.robot.base import TICK_S, Robot
from sim.worlds.world import World


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Hide the build banner that the extension prints from C on import."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = [os.dup(1), os.dup(2)]
    with open(os.devnull, "w") as sink:
        os.dup2(sink.fileno(), 1)
        os.dup2(sink.fileno(), 2)
    try:
        yield
    finally:
        for target, copy in zip((1, 2), saved, strict=True):
            os.dup2(copy, target)
            os.close(copy)


with _quiet():
    import pybullet

MAX_RAYS = 16_000  # a batch of 16384 rays loses its last one
_SOLVER_ITERATIONS = 80  # 50 leave 0.08 mm of side slip in a straight 2 m, 80 leave 0.03 mm
_SETTLE_TICKS = 60
_MOTOR_TORQUE_NM = 100.0  # ample: the command is met in one tick, the traction is the limit
_RAYS, _WALLS, _GROUND, _ROBOT = 1, 2, 4, 8  # collision groups; rays are in the engine's first
_TIPPED_RAD = 0.1


class BulletBody(contextlib.AbstractContextManager["BulletBody"]):
    """A world with one robot in the engine; a context manager that frees the engine.

    Parameters
    ----------
    world, robot
        What to build.
    pose
        (3,) m, m, rad: base_link at the start. A robot is never moved by hand afterwards, since
        that would change the bits of all that follows.
    """

    def __init__(self, world: World, robot: Robot, pose: Array) -> None:
        self._radius_m = robot.wheel_radius_m
        self._client = pybullet.connect(pybullet.DIRECT)
        require(
            self._client >= 0, "the physics engine would not start; too many recordings at once?"
        )
        c = self._client
        pybullet.setGravity(0, 0, -9.81, physicsClientId=c)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=TICK_S,
            numSolverIterations=_SOLVER_ITERATIONS,
            solverResidualThreshold=0,
            deterministicOverlappingPairs=1,
            physicsClientId=c,
        )
        plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=c)
        ground = pybullet.createMultiBody(0, plane, physicsClientId=c)
        self._surface(ground, -1, 1.0, _GROUND, _ROBOT | _RAYS)
        self._walls = self._build_walls(world)
        self._robot = self._build_robot(robot, pose)
        self._heading = float(pose[2])
        self._angles = 0.0, 0.0
        for _ in range(_SETTLE_TICKS):
            self.step(0.0, 0.0)

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the engine."""
        if self._client >= 0:
            pybullet.disconnect(self._client)
            self._client = -1

    def step(self, right_mps: float, left_mps: float) -> tuple[float, float]:
        """Advance one tick with commanded ground speeds; return the wheels' rolling, m."""
        pybullet.setJointMotorControlArray(
            self._robot,
            (0, 1),
            pybullet.VELOCITY_CONTROL,
            targetVelocities=(right_mps / self._radius_m, left_mps / self._radius_m),
            forces=(_MOTOR_TORQUE_NM, _MOTOR_TORQUE_NM),
            physicsClientId=self._client,
        )
        pybullet.stepSimulation(physicsClientId=self._client)
        states = pybullet.getJointStates(self._robot, (0, 1), physicsClientId=self._client)
        (right, *_), (left, *_) = states
        (right_before, left_before), self._angles = self._angles, (right, left)
        return (right - right_before) * self._radius_m, (left - left_before) * self._radius_m

    @property
    def pose(self) -> Array:
        """(3,) m, m, rad: base_link in map, the heading unwrapped over successive calls."""
        position, quaternion = pybullet.getBasePositionAndOrientation(
            self._robot, physicsClientId=self._client
        )
        x, y, z, w = quaternion
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        self._heading += (yaw - self._heading + math.pi) % (2.0 * math.pi) - math.pi
        return np.array([position[0], position[1], self._heading])

    @property
    def trouble(self) -> str | None:
        """`collision` or `tipped` if the robot touches a wall or leans, else None."""
        if self._walls is not None:
            contacts = pybullet.getContactPoints(
                self._robot, self._walls, physicsClientId=self._client
            )
            if any(contact[8] < 1e-3 for contact in contacts):
                return "collision"
        _, (x, y, _, _) = pybullet.getBasePositionAndOrientation(
            self._robot, physicsClientId=self._client
        )
        return "tipped" if np.hypot(x, y) > np.sin(_TIPPED_RAD / 2.0) else None

    def cast(self, starts: Array, ends: Array, *, ground: bool = False) -> Array:
        """Share (N,) of the way from starts (N, 3) to ends (N, 3), m, at which a ray is stopped.

        1 where nothing stops it. Rays pass through the robot, and through the ground unless
        `ground`.
        """
        return self.strike(starts, ends, ground=ground)[0]

    def strike(self, starts: Array, ends: Array, *, ground: bool = False) -> tuple[Array, Array]:
        """Shares (N,) as of `cast`, and the normals (N, 3) of what stops the rays."""
        mask = _WALLS | _GROUND if ground else _WALLS
        shares, normals = np.empty(len(starts)), np.empty((len(starts), 3))
        for first in range(0, len(starts), MAX_RAYS):
            rows = slice(first, first + MAX_RAYS)
            hits = pybullet.rayTestBatch(
                starts[rows].tolist(),
                ends[rows].tolist(),
                numThreads=1,
                collisionFilterMask=mask,
                physicsClientId=self._client,
            )
            shares[rows] = [hit[2] for hit in hits]
            normals[rows] = [hit[4] for hit in hits]
        return shares, normals

    def _surface(self, body: int, link: int, friction: float, group: int, mask: int) -> None:
        """Friction of a link, and what it collides with."""
        pybullet.changeDynamics(
            body,
            link,
            lateralFriction=friction,
            rollingFriction=0.0,
            spinningFriction=0.0,
            restitution=0.0,
            linearDamping=0.0,
            angularDamping=0.0,
            jointDamping=0.0,
            physicsClientId=self._client,
        )
        pybullet.setCollisionFilterGroupMask(body, link, group, mask, physicsClientId=self._client)

    def _build_walls(self, world: World) -> int | None:
        """All walls in one concave mesh: exact to a micrometre, and stepping stays fast."""
        if len(world.walls) == 0:
            return None
        (x1, y1, x2, y2), (low, high) = world.walls.T, world.wall_z_m.T
        corners = [(x1, y1, low), (x2, y2, low), (x2, y2, high), (x1, y1, high)]
        vertices = np.stack([np.stack(corner, axis=-1) for corner in corners], axis=1)
        first = 4 * np.arange(len(world.walls))[:, None]
        indices = first + np.array([[0, 1, 2, 0, 2, 3]])
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_MESH,
            vertices=vertices.reshape(-1, 3).tolist(),
            indices=indices.ravel().tolist(),
            flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
            physicsClientId=self._client,
        )
        require(shape >= 0, f"world {world.name}: the physics engine refused its walls")
        walls: int = pybullet.createMultiBody(0, shape, physicsClientId=self._client)
        self._surface(walls, -1, 0.5, _WALLS, _ROBOT | _RAYS)
        return walls

    def _build_robot(self, robot: Robot, pose: Array) -> int:
        c, r = self._client, robot.wheel_radius_m
        caster_r = 0.4 * r
        bottom, top = 0.4 * r - r, max(robot.body_height_m, r) - r  # of the body, from the axle
        box = pybullet.createCollisionShape(
            pybullet.GEOM_BOX,
            halfExtents=[robot.body_length_m / 2, robot.body_width_m / 2, (top - bottom) / 2],
            collisionFramePosition=[0, 0, (top + bottom) / 2],
            physicsClientId=c,
        )
        wheel = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=r, physicsClientId=c)
        caster = pybullet.createCollisionShape(
            pybullet.GEOM_SPHERE, radius=caster_r, physicsClientId=c
        )
        reach = robot.body_length_m / 2 - caster_r
        half = robot.track_m / 2
        upright, centre = [0, 0, 0, 1], [0, 0, 0]
        body: int = pybullet.createMultiBody(
            0.88 * robot.mass_kg,
            box,
            -1,
            [pose[0], pose[1], r],
            pybullet.getQuaternionFromEuler([0, 0, pose[2]]),
            baseInertialFramePosition=centre,
            linkMasses=[share * robot.mass_kg for share in (0.05, 0.05, 0.01, 0.01)],
            linkCollisionShapeIndices=[wheel, wheel, caster, caster],
            linkVisualShapeIndices=[-1] * 4,
            linkPositions=[
                [0, -half, 0],
                [0, half, 0],
                [reach, 0, caster_r - r],
                [-reach, 0, caster_r - r],
            ],
            linkOrientations=[upright] * 4,
            linkInertialFramePositions=[centre] * 4,
            linkInertialFrameOrientations=[upright] * 4,
            linkParentIndices=[0] * 4,
            linkJointTypes=[pybullet.JOINT_REVOLUTE] * 2 + [pybullet.JOINT_FIXED] * 2,
            linkJointAxis=[[0, 1, 0]] * 4,
            physicsClientId=c,
        )
        for link, friction in ((-1, 0.0), (0, 1.0), (1, 1.0), (2, 0.0), (3, 0.0)):
            self._surface(body, link, friction, _ROBOT, _WALLS | _GROUND)
        return body
