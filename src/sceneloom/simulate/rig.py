"""The sensors of a drive: what each is called, when it measures, and how it stands in the scene."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import NO_FIELDS
from sceneloom.simulate.camera import CameraSpec, RenderedCamera
from sceneloom.simulate.lidar import ScanningLidar
from sceneloom.simulate.path import EgoPath
from sceneloom.simulate.radar import RadarSpec, SimulatedRadar
from sceneloom.simulate.shots import ScanSpec
from sceneloom.simulate.street import Street

_MARGIN_NS = 200_000_000
"""How far trajectory, IMU and GNSS reach beyond the first and the last measurement."""
_LONGEST_PERIOD_NS = 1_000_000_000
"""Longest frame of a further lidar, which ends so much later than the drive at most: so far traffic goes on, too."""


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """The devices on the ego, and the clock of the drive: the periods of its first lidar.

    Attributes:
        lidars, cameras, radars: the devices by id, in order.
        frames: periods of the first lidar.
        start_ns: start of the drive [ns].
    """

    lidars: Mapping[str, ScanSpec]
    cameras: Mapping[str, CameraSpec]
    radars: Mapping[str, RadarSpec]
    frames: int
    start_ns: int

    @classmethod
    def of(
        cls,
        lidars: Sequence[ScanSpec],
        cameras: Sequence[CameraSpec],
        radars: Sequence[RadarSpec],
        *,
        frames: int,
        start_ns: int,
    ) -> "Rig":
        """Name the devices: "lidar", or "lidar0", "lidar1", … where there are several; "camera0", …; "radar0", ….

        Raises:
            OptionError: there is no lidar, or a device's times do not fit the others'.
        """
        if not lidars:
            raise OptionError("lidars: none; expected one at least, whose sweeps are the clock of the drive")
        names = ["lidar"] if len(lidars) == 1 else [f"lidar{index}" for index in range(len(lidars))]
        rig = cls(
            dict(zip(names, lidars, strict=True)),
            {f"camera{index}": spec for index, spec in enumerate(cameras)},
            {f"radar{index}": spec for index, spec in enumerate(radars)},
            frames,
            start_ns,
        )
        rig._check()
        return rig

    @property
    def period_ns(self) -> int:
        """Time from one sweep of the first lidar to the next [ns]."""
        return next(iter(self.lidars.values())).period_ns

    @property
    def sweep_starts_ns(self) -> Int64Array:
        """(F,) int64 [ns], the periods of the drive, by which images are taken."""
        starts: Int64Array = self.start_ns + self.period_ns * np.arange(self.frames, dtype=np.int64)
        return starts

    @property
    def trajectory_span_ns(self) -> tuple[int, int]:
        """First and last time that the first lidar and the cameras need [ns], with a margin.

        The street is laid out for this, so that further lidars and radars do not change it.
        """
        offsets = [0, self.period_ns, *(spec.offset_ns for spec in self.cameras.values())]
        starts = self.sweep_starts_ns
        return int(starts[0]) + min(offsets) - _MARGIN_NS, int(starts[-1]) + max(offsets) + _MARGIN_NS

    @property
    def traffic_span_ns(self) -> tuple[int, int]:
        """First and last time at which what moves has to be somewhere [ns], whatever further sensors there are."""
        first, last = self.trajectory_span_ns
        return first, max(last + _LONGEST_PERIOD_NS, self.span_ns[1])

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last time that any sensor needs [ns], with a margin."""
        first, last = self.trajectory_span_ns
        ends = [self.frame_starts_ns(spec)[-1:] + spec.period_ns for spec in self.lidars.values()]
        ends += [self.frame_starts_ns(spec)[-1:] for spec in self.radars.values()]
        latest = np.concatenate(ends).max(initial=last - _MARGIN_NS)
        return first, int(latest) + _MARGIN_NS

    def frame_starts_ns(self, spec: ScanSpec | RadarSpec) -> Int64Array:
        """Starts of all frames of a device that begin within the drive, (F,) int64 [ns].

        The first lidar has one in each of its periods.
        """
        length_ns = self.frames * self.period_ns
        count = max(0, -(-(length_ns - spec.offset_ns) // spec.period_ns))
        starts: Int64Array = (
            self.start_ns + spec.offset_ns + spec.period_ns * np.arange(count, dtype=np.int64)
        )
        return starts

    def position_lidars(self, street: Street, path: EgoPath, *, seed: int) -> dict[str, ScanningLidar]:
        """Put the lidars on their trajectory."""
        return {
            name: ScanningLidar.of(
                spec, street, path, seed=seed, timestamps_ns=self.frame_starts_ns(spec), number=number
            )
            for number, (name, spec) in enumerate(self.lidars.items())
        }

    def position_cameras(self, street: Street, path: EgoPath, *, seed: int) -> dict[str, RenderedCamera]:
        """Put the cameras on their trajectory."""
        return {
            name: RenderedCamera.of(
                spec,
                street,
                path,
                timestamps_ns=self.sweep_starts_ns + spec.offset_ns,
                seed=seed,
                number=number,
            )
            for number, (name, spec) in enumerate(self.cameras.items())
        }

    def position_radars(self, street: Street, path: EgoPath, *, seed: int) -> dict[str, SimulatedRadar]:
        """Put the radars on their trajectory."""
        return {
            name: SimulatedRadar(spec, street, path, seed, number, self.frame_starts_ns(spec))
            for number, (name, spec) in enumerate(self.radars.items())
        }

    def _check(self) -> None:
        offsets = [spec.offset_ns for spec in self.cameras.values()]
        if offsets and (min(offsets) < -self.period_ns or max(offsets) > 2 * self.period_ns):
            raise OptionError(
                f"camera offsets {offsets} ns; expected {-self.period_ns} to {2 * self.period_ns}, a sweep's period "
                "before the sweep and after it"
            )
        for name, spec in list(self.lidars.items())[1:]:
            if spec.period_ns > _LONGEST_PERIOD_NS:
                raise OptionError(
                    f"{name}.period_ns: {spec.period_ns}; expected at most {_LONGEST_PERIOD_NS}"
                )


def scene_sensors(
    lidars: Mapping[str, ScanningLidar],
    cameras: Mapping[str, RenderedCamera],
    radars: Mapping[str, SimulatedRadar],
    ego: Poses,
) -> tuple[LidarSensor | CameraSensor | RadarSensor, ...]:
    """Give the sensors as a reader would: frames that are made when asked for, poses along the ego's, mountings."""
    return (
        *(_lidar_sensor(name, lidar, ego) for name, lidar in lidars.items()),
        *(_camera_sensor(name, camera, ego) for name, camera in cameras.items()),
        *(_radar_sensor(name, radar, ego) for name, radar in radars.items()),
    )


def _lidar_sensor(name: str, lidar: ScanningLidar, ego: Poses) -> LidarSensor:
    return LidarSensor(
        name,
        LazyFrames(lidar.timestamps_ns, lidar.frame),
        poses=_mounted(ego, lidar.spec.mount),
        mount=lidar.spec.mount,
        model="simulated",
    )


def _camera_sensor(name: str, camera: RenderedCamera, ego: Poses) -> CameraSensor:
    times = camera.timestamps_ns
    return CameraSensor(
        name,
        camera.spec.camera,
        LazyFrames(times, camera.image),
        poses=_mounted(ego, camera.spec.mount),
        mount=camera.spec.mount,
        fps=1e9 / float(times[1] - times[0]) if len(times) > 1 else None,
        extras=_shutter_fields(camera.spec),
    )


def _shutter_fields(spec: CameraSpec) -> Mapping[str, Any]:
    """What `calibration.json` of a recording says of a rolling shutter, where its reader would keep it.

    Source: "calibration extras" of the recording format, docs/CONVENTIONS.md.
    """
    if spec.readout_ns == 0:
        return NO_FIELDS
    entry: dict[str, Any] = {"shutterRollTimeSeconds": spec.readout_ns / 1e9}
    if spec.left_to_right:
        entry["rollingShutterLeftToRight"] = True
    return {"calibration": entry}


def _radar_sensor(name: str, radar: SimulatedRadar, ego: Poses) -> RadarSensor:
    return RadarSensor(
        name,
        LazyFrames(radar.timestamps_ns, radar.frame),
        poses=_mounted(ego, radar.spec.mount),
        mount=radar.spec.mount,
    )


def _mounted(ego: Poses, mount: RigidTransform) -> Poses:
    """`world_from_sensor` at the trajectory's own times."""
    poses = PoseSource(ego, mount).at(ego.timestamps_ns)
    return Poses(ego.timestamps_ns, poses.positions, poses.quaternions_xyzw)
