"""Plays a recorded scene through the fusion system in time order, as if it were live."""

import heapq
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

from sceneloom.colouring.results import FusedFrame
from sceneloom.errors import DataError, PoseError, SceneloomError
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.fusion.system import FusionSystem
from sceneloom.scene.cameras import CameraImage, CameraSensor, Shutter
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.ego import EgoMotion, lidar_position, points_source, sensor_source
from sceneloom.scene.scene import Scene, scene_period_ns, sweep_period_ns
from sceneloom.scene.types import Identifier
from sceneloom.warnings import DataWarning, WarningKind


def check_has_lidar(scene: Scene, needing: str) -> None:
    """Refuse a scene without a lidar.

    Args:
        scene: of the job.
        needing: what needs one, such as "fusing needs".

    Raises:
        DataError: it has none.
    """
    if not scene.lidars:
        raise DataError(scene.source, "", f"no lidar in it; {needing} one (`sceneloom info` lists what is there)")


@dataclass(slots=True)
class Skips:
    """Frames that could not be read, with the reason.

    Attributes:
        reasons: one line per frame, however often it was asked for.
    """

    reasons: dict[str, None] = field(default_factory=dict)

    def add(self, error: DataError) -> None:
        """Note a frame that could not be read."""
        self.reasons[str(error)] = None


@contextmanager
def telling(skips: Skips | None) -> Iterator[None]:
    """Attach to an error the warnings about what was skipped before it."""
    try:
        yield
    except SceneloomError as error:
        if skips is not None:
            error.remember(tuple(_skipped(reason) for reason in skips.reasons))
        raise


def _skipped(reason: str) -> DataWarning:
    return DataWarning(kind=WarningKind.SKIPPED, code="frame-unreadable", location="", message=reason)


def reported_once(before: tuple[DataWarning, ...], own: tuple[DataWarning, ...]) -> tuple[DataWarning, ...]:
    """Add warnings about the sweeps to earlier ones, except those that odometry has reported already."""
    known = {warning.code for warning in before}
    return (*before, *(warning for warning in own if warning.code not in known))


def check_any_placed(scene: Scene, unfused: Mapping[str, int], sweeps: int, done: str = "placed") -> None:
    """Refuse a drive none of whose sweeps could be placed in the world.

    Args:
        scene: of the job.
        unfused: why sweeps could not be placed, with counts.
        sweeps: how many there are.
        done: what could not be done with them.

    Raises:
        PoseError: naming the reasons.
    """
    if sweeps and sum(unfused.values()) == sweeps:
        reasons = ", ".join(f"{reason} ({count} times)" for reason, count in unfused.items())
        raise PoseError(
            f"{scene.source}: none of {sweeps} sweeps could be {done}: {reasons}; expected a trajectory on the clock "
            "of the sweeps; `sceneloom info` reports both spans, and `--trajectory lidar` needs none"
        )


def build_system(
    scene: Scene, ego: EgoMotion | None, configuration: FusionConfiguration, skips: Skips | None = None
) -> FusionSystem:
    """Make a fusion system that knows the scene's lidars, and its cameras with images, and where they were.

    Args:
        scene: whose sensors these are.
        ego: the ego trajectory; None where every sensor has poses of its own.
        configuration: of the system.
        skips: collects images that cannot be read; without it they raise.

    Raises:
        PoseError: for a sensor neither poses nor extrinsics are known.
    """
    system = FusionSystem(configuration)
    if skips is not None:
        system.on_unreadable = skips.add
    reach_ns = scene_period_ns(scene)
    for lidar in scene.lidars:
        source = points_source(scene, lidar, ego, reach_ns=reach_ns)
        location = lidar_position(scene, lidar, ego, reach_ns=reach_ns)
        system.add_lidar(lidar.id, source, period_ns=sweep_period_ns(lidar), location=location)
    for index, camera in enumerate(scene.cameras):
        if len(camera.images) == 0:
            continue
        source = sensor_source(scene, camera, ego, reach_ns=reach_ns)
        system.add_camera(camera.id, source, index=index, shutter=Shutter.of(camera))
    return system


def play(scene: Scene, system: FusionSystem, *, skips: Skips | None = None) -> Iterator[FusedFrame]:
    """Send every sweep and image in the order of time, and yield the results in the order of the sweeps.

    Args:
        skips: collects sweeps that cannot be read and goes on; without it they raise.

    Raises:
        DataError: a sweep or an image cannot be read.
    """
    for _, sensor_id, read in in_time_order(scene):
        try:
            measurement = read()
        except DataError as error:
            if skips is None:
                raise
            skips.add(error)
            system.pass_over(sensor_id)
            continue
        system.send(sensor_id, measurement)
        yield from iter(system.get, None)
    system.flush()
    yield from iter(system.get, None)


Reader = Callable[[], LidarFrame | CameraImage]
"""Reads a frame when it is needed."""


def in_time_order(scene: Scene) -> Iterator[tuple[int, Identifier, Reader]]:
    """All sweeps and images by timestamp; images before sweeps of the same time, sensors in the scene's order.

    Yields:
        Time [ns], sensor, and what reads the frame.
    """
    sensors: list[LidarSensor | CameraSensor] = [*scene.cameras, *scene.lidars]
    streams = [_timestamped(order, sensor) for order, sensor in enumerate(sensors)]
    for timestamp_ns, _, sensor_id, read in heapq.merge(*streams, key=lambda entry: entry[:2]):
        yield timestamp_ns, sensor_id, read


def _timestamped(order: int, sensor: LidarSensor | CameraSensor) -> Iterator[tuple[int, int, Identifier, Reader]]:
    frames = sensor.frames if isinstance(sensor, LidarSensor) else sensor.images
    for index, timestamp_ns in enumerate(frames.timestamps_ns.tolist()):
        yield timestamp_ns, order, sensor.id, lambda index=index: frames[index]  # type: ignore[misc]
