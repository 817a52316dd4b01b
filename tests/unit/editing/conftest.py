"""A drive on a circle whose every location is known by formula, and things seen on it."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.geometry.rigid import RigidTransform

RADIUS, RATE = 20.0, 0.5
"""The circle [m], and how fast the ego rotates on it [rad/s]."""

MOUNT = RigidTransform.from_quaternion(np.array([1.0, 0.2, 1.5]), np.array([0.0, 0.0, np.sin(0.3), np.cos(0.3)]))
"""`ego_from_lidar`."""

CAMERA_MODEL = Camera("pinhole", 8, 6, 5.0, 5.0, 3.5, 2.5)


@dataclass(frozen=True)
class CircleDrive:
    """The formulas of the drive; the ego looks along the circle."""

    frames: int = 5
    period_ns: int = 100_000_000

    @property
    def timestamps_ns(self):
        return np.arange(self.frames, dtype=np.int64) * self.period_ns

    def world_from_ego(self, time_ns):
        angle = RATE * time_ns * 1e-9
        half = (angle + np.pi / 2) / 2
        return RigidTransform.from_quaternion(
            np.array([RADIUS * np.cos(angle), RADIUS * np.sin(angle), 0.1 * time_ns * 1e-9]),
            np.array([0.0, 0.0, np.sin(half), np.cos(half)]),
        )

    def path(self, hz=100, beyond_ns=0):
        """The ego trajectory with so many poses a second; at the frames' times it is exact."""
        step = 1_000_000_000 // hz
        times = np.arange(-beyond_ns, int(self.timestamps_ns[-1]) + beyond_ns + 1, step, dtype=np.int64)
        poses = [self.world_from_ego(int(time_ns)) for time_ns in times]
        return sc.Poses(times, np.array([p.translation for p in poses]), np.array([p.quaternion_xyzw for p in poses]))

    def points_world(self, k):
        """What stands in the world, seen in frame `k`."""
        return np.random.default_rng(k).uniform(-30, 30, (40, 3))

    def scene(self, points_frame=sc.PointsFrame.SENSOR, annotations=()):
        """A lidar, a radar and a camera on the ego, an odometry sensor, and a trajectory of the same poses."""
        lidar = sc.LidarSensor("lidar", self._frames(sc.LidarFrame, sc.LidarPoints, points_frame), mount=MOUNT)
        radar = sc.RadarSensor("radar", self._frames(sc.RadarFrame, sc.RadarPoints, points_frame), mount=MOUNT)
        times = (self.timestamps_ns + 20_000_000).tolist()
        images = [sc.CameraImage.of(t, CAMERA_MODEL, np.zeros((6, 8, 3), np.uint8)) for t in times]
        camera = sc.CameraSensor("camera", CAMERA_MODEL, sc.LazyFrames.of(images, times), mount=MOUNT)
        path = self.path(beyond_ns=100_000_000)
        trajectory = sc.Trajectory("ego", path.timestamps_ns, path.positions, path.quaternions_xyzw)
        clouds = (replace(sensor, points_frame=points_frame) for sensor in (lidar, radar))
        sensors = (*clouds, camera, sc.OdometrySensor("ego", path))
        return sc.Scene(sensors, tuple(annotations), trajectories={"ego": trajectory})

    def frame_from_world(self, k, points_frame):
        """By formula, at the time of frame `k`."""
        ego_from_world = self.world_from_ego(int(self.timestamps_ns[k])).inverse()
        return {
            sc.PointsFrame.WORLD: RigidTransform.identity(),
            sc.PointsFrame.EGO: ego_from_world,
            sc.PointsFrame.SENSOR: MOUNT.inverse() @ ego_from_world,
        }[points_frame]

    def _frames(self, frame_type, points_type, points_frame):
        frames = []
        for k, time_ns in enumerate(self.timestamps_ns.tolist()):
            transform = self.frame_from_world(k, points_frame)
            positions = transform.apply(self.points_world(k)).astype(np.float32)
            further = {}
            if points_type is sc.RadarPoints:
                directions = transform.rotate(self.points_world(k))
                unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
                further = {"directions": unit.astype(np.float32)}
            frames.append(frame_type(time_ns, points_type(positions, **further)))
        return sc.LazyFrames.of(frames, self.timestamps_ns.tolist())


@pytest.fixture
def drive():
    """Five frames in 0.4 s."""
    return CircleDrive()


def box(identifier, times_ns, centers, yaw_deg=0.0, **fields):
    """A cuboid of 4 x 2 x 1.5 m that goes through these locations."""
    rows = np.zeros((len(times_ns), 9))
    rows[:, :3] = 4.0, 2.0, 1.5
    rows[:, 3:6] = centers
    rows[:, 8] = yaw_deg
    return sc.CuboidAnnotation(identifier, sc.CuboidPath(np.asarray(times_ns, np.int64), rows), **fields)
