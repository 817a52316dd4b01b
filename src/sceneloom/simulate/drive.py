"""A synthetic drive: one scene as a reader would give it, and the truth behind it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier
from sceneloom.simulate.boxes import annotations_of
from sceneloom.simulate.camera import CameraSpec, camera_mount
from sceneloom.simulate.faults import Faults
from sceneloom.simulate.inertial import ImuSpec, imu_sensor, imu_truth
from sceneloom.simulate.lidar import LidarSpec
from sceneloom.simulate.path import PathSpec, plan_path
from sceneloom.simulate.planting import plant_in_scene
from sceneloom.simulate.radar import RadarSpec
from sceneloom.simulate.randomness import Stream, generator_for
from sceneloom.simulate.rig import Rig, scene_sensors
from sceneloom.simulate.satellite import GnssSpec, gnss_sensor
from sceneloom.simulate.shots import ScanSpec
from sceneloom.simulate.street import build_street
from sceneloom.simulate.traffic import TrafficSpec, plan_traffic
from sceneloom.simulate.truth import Truth

TRAJECTORY = "groundTruth"
"""Name of the trajectory that is exactly the ego trajectory."""

ANNOTATED = frozenset({"car", "bin", "tree", "pole"})
"""Classes of objects that get a box in the scene's annotations; `Truth.objects` knows all."""

_IMU_SHIFT_NS = 1_300_000
"""Keeps the IMU's timestamps from falling on those of other sensors, as two clocks would."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedDrive:
    """A drive that never happened.

    Attributes:
        scene: what sensors recorded of it; sweeps and images are made when asked for.
        truth: what was really there; injected faults change nothing in it.
        faults: what was injected in the scene.
        true_frames: for each sensor with faults, (F,) int64: which frame of the truth each of its frames shows.
    """

    scene: Scene
    truth: Truth
    faults: Faults = field(default_factory=Faults)
    true_frames: Mapping[Identifier, Int64Array] = field(default_factory=dict)


def simulate_street(
    seed: int = 0,
    *,
    frames: int = 30,
    lidar: ScanSpec | None = None,
    lidars: Sequence[ScanSpec] | None = None,
    cameras: Sequence[CameraSpec] | None = None,
    radars: Sequence[RadarSpec] = (),
    imu: ImuSpec | None = None,
    gnss: GnssSpec | None = None,
    path: PathSpec | None = None,
    traffic: TrafficSpec | None = None,
    faults: Faults | None = None,
    trajectory_hz: float = 100.0,
    start_ns: int = 1_000_000_000,
) -> SimulatedDrive:
    """Drive through a synthetic street.

    Args:
        seed: another number is another street, another way and other noise.
        frames: sweeps of the (first) lidar; each camera takes one image in each.
        lidar: the lidar, a `LidarSpec` or a `SolidStateSpec`; by default 64 beams and 1800 steps at 10 Hz on the roof.
        lidars: several in its location; the further ones have as many sweeps as begin before the first has ended its
            last. A single lidar's id is "lidar", of several they are "lidar0", "lidar1", …
        cameras: by default one of 1242x375 pixels, looking ahead; ids are "camera0", "camera1", …
        radars: none by default; ids are "radar0", "radar1", …
        imu, gnss: the inertial unit and the satellite receiver.
        path: how the ego drives: speeds, rotates, stops.
        traffic: what moves besides the ego; None for nothing.
        faults: what is wrong with the scene; None for nothing.
        trajectory_hz: samples of the trajectory a second; 100 keeps interpolation within 0.1 mm and 0.001 degrees
            on the default trajectory, and within 1 mm and 0.01 degrees on the fastest one.
        start_ns: time of the first sweep [ns].

    Returns:
        The drive; the same for the same arguments, whatever is asked of it and in which order.

    Raises:
        OptionError: a number is out of bounds.
        CalibrationError: a camera model cannot be used.
    """
    if seed < 0:
        raise OptionError(f"seed {seed}; expected a number that is not negative")
    if frames < 1 or not 10.0 <= trajectory_hz <= 10_000.0:
        raise OptionError(f"{frames} frames at {trajectory_hz} poses a second; expected >= 1, 10 to 10000")
    if lidar is not None and lidars is not None:
        raise OptionError("lidar and lidars: both are given; expected one of them")
    imu, gnss = imu or ImuSpec(), gnss or GnssSpec()
    rig = Rig.of(
        (lidar or LidarSpec(),) if lidars is None else tuple(lidars),
        (CameraSpec(),) if cameras is None else tuple(cameras),
        tuple(radars),
        frames=frames,
        start_ns=start_ns,
    )
    span_ns = rig.span_ns
    trajectory = plan_path(
        generator_for(seed, Stream.PATH),
        start_ns=start_ns,
        duration=(rig.trajectory_span_ns[1] - start_ns) * 1e-9,
        spec=path,
    )
    street = build_street(generator_for(seed, Stream.STREET), trajectory)
    if traffic is not None:
        generator = generator_for(seed, Stream.TRAFFIC)
        movers = plan_traffic(generator, traffic, trajectory, street, span_ns=rig.traffic_span_ns)
        street = replace(street, movers=movers)
    inertial = imu_truth(imu, trajectory, _timestamps(span_ns, imu.rate_hz) + _IMU_SHIFT_NS, seed=seed)
    truth = Truth(
        street,
        trajectory,
        rig.position_lidars(street, trajectory, seed=seed),
        rig.position_cameras(street, trajectory, seed=seed),
        rig.position_radars(street, trajectory, seed=seed),
        inertial,
    )
    sensors = (
        imu_sensor(imu, inertial, seed=seed),
        gnss_sensor(gnss, trajectory, _timestamps(span_ns, gnss.rate_hz), seed=seed),
    )
    drive = SimulatedDrive(_scene(seed, truth, sensors, _timestamps(span_ns, trajectory_hz)), truth)
    return drive if faults is None else plant(drive, faults)


def plant(drive: SimulatedDrive, faults: Faults) -> SimulatedDrive:
    """Make the scene of a drive wrong; its truth stays as it is.

    Raises:
        OptionError: the drive has faults already, there is no such sensor or frame, or a fault means nothing for
            that kind of sensor.
    """
    if drive.faults.sensors:
        raise OptionError(f"{drive.scene.source}: has faults already; plant all of them at once")
    scene, true_frames = plant_in_scene(drive.scene, faults)
    return replace(drive, scene=scene, faults=faults, true_frames=true_frames)


def demo_drive(seed: int = 0, *, frames: int = 30) -> SimulatedDrive:
    """A small drive for a first look: two cameras with different camera models and smooth outlines.

    A lidar that looks up.
    """
    ahead = Camera(
        "brown_conrady", 800, 400, 430.0, 430.0, 399.5, 190.0, (-0.12, 0.04, 0.0004, -0.0003, -0.006)
    )
    aside = Camera("fisheye", 640, 400, 250.0, 250.0, 319.5, 190.0, (0.03, -0.008, 0.002, -0.0004))
    cameras = (
        CameraSpec(ahead, camera_mount(pitch_deg=0.6), supersampling=2),
        CameraSpec(
            aside,
            camera_mount(position=(0.35, 0.25, 1.6), yaw_deg=62.0, pitch_deg=2.0),
            45_000_000,
            supersampling=2,
        ),
    )
    return simulate_street(
        seed, frames=frames, lidar=LidarSpec(elevations_deg=(-25.0, 15.0), steps=1200), cameras=cameras
    )


def _timestamps(span_ns: tuple[int, int], rate_hz: float) -> Int64Array:
    """Times at a constant rate over a span, (N,) int64 [ns]."""
    count = int((span_ns[1] - span_ns[0]) * 1e-9 * rate_hz) + 2
    timestamps: Int64Array = span_ns[0] + np.rint(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)
    return timestamps


def _scene(seed: int, truth: Truth, others: tuple[Any, ...], timestamps_ns: Int64Array) -> Scene:
    ego = truth.path.poses(timestamps_ns)
    sensors = (*scene_sensors(truth.lidars, truth.cameras, truth.radars, ego), *others)
    trajectory = Trajectory(TRAJECTORY, ego.timestamps_ns, ego.positions, ego.quaternions_xyzw)
    return Scene(
        sensors,
        annotations=annotations_of(truth.street, ANNOTATED, start_ns=int(truth.lidar.timestamps_ns[0])),
        trajectories={TRAJECTORY: trajectory},
        metadata=_metadata(seed),
        source=f"simulated street {seed}",
        format="simulated",
    )


def _metadata(seed: int) -> Mapping[str, Any]:
    return {"sceneloom": {"euler_unit": "degrees", "euler_order": "xyz", "seed": seed}}
