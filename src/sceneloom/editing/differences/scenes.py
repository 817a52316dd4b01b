"""Two scenes, sensor by sensor and annotation by annotation."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.editing.differences.frames import compare_depth_images, compare_frames, compare_images
from sceneloom.editing.differences.report import Change, Findings, SceneDifferences
from sceneloom.editing.differences.tolerances import Tolerances
from sceneloom.editing.differences.values import Comparison, shown
from sceneloom.errors import OptionError
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.span import frame_times
from sceneloom.scene.types import Key, Progress, key_of

_FRAMED = (LidarSensor, RadarSensor, CameraSensor, DepthCameraSensor)


@np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
def diff_scenes(
    first: Scene,
    second: Scene,
    *,
    tolerance_m: float = 0.0,
    tolerance_deg: float = 0.0,
    tolerance_ns: float = 0.0,
    tolerance_px: float = 0.0,
    other_timestamps: bool = False,
    pixels: bool = False,
    progress: Progress | None = None,
) -> SceneDifferences:
    """Report what differs between two scenes: what was added, removed and changed from the first to the second.

    Sensors and annotations are the same if their ids are, frames if their timestamps are. Where a scene comes from and
    what was remarked on reading it does not count. Frames are read in pairs and not kept.

    Args:
        first, second: the scenes.
        tolerance_m: largest distance of locations, sizes and translations that counts as none [m].
        tolerance_deg: largest rotate [deg]; quaternions of one rotation are equal whatever their sign, and so are
            cuboids whose angles are reported in another unit or order.
        tolerance_ns: largest difference of timestamps [ns].
        tolerance_px: largest difference of what is drawn into images [px].
        other_timestamps: let a path be reported at other timestamps, if at those of both it is the same within the
            tolerances.
        pixels: decode images whose bytes differ or are not there, and compare their pixels.
        progress: reported after each frame how many are done, and of how many.

    Raises:
        OptionError: one is no scene, or a tolerance is negative or not a number.
        DataError: a frame cannot be read.
    """
    for scene in (first, second):
        if not isinstance(scene, Scene):
            raise OptionError(f"{scene!r}; expected a scene: `sceneloom.open` gives that of a file")
    findings = Findings()
    comparison = Comparison(
        findings,
        Tolerances(tolerance_m, tolerance_deg, tolerance_ns, tolerance_px, other_timestamps),
        (CuboidAngles.of(first), CuboidAngles.of(second)),
    )
    steps = _Steps(max(_frames(first), _frames(second)), progress)
    for name in ("time_offset_ns", "metadata", "attributes"):
        comparison.values(name, getattr(first, name), getattr(second, name), owner="Scene", name=name)
    comparison.values("extras", _extras(first), _extras(second), owner="Scene", name="extras")
    comparison.values("trajectories", first.trajectories, second.trajectories)

    def compare_sensors(path: str, a: Sensor, b: Sensor) -> None:
        _compare_sensor(comparison, path, a, b, steps.one, pixels=pixels)

    _compare_members(comparison, "sensors", first.sensors, second.sensors, compare_sensors)
    _compare_members(comparison, "annotations", first.annotations, second.annotations, comparison.records)
    return findings.reported()


def _extras(scene: Scene) -> Mapping[str, Any]:
    """The further fields of a scene, with the unit of times that holds where it is not stated."""
    return {"time_unit": "microseconds", **scene.extras}


@dataclass(slots=True)
class _Steps:
    total: int
    progress: Progress | None
    done: int = 0

    def one(self) -> None:
        """Count a frame."""
        self.done += 1
        if self.progress is not None:
            self.progress(self.done, max(self.total, self.done))


def _frames(scene: Scene) -> int:
    return sum(len(frame_times(sensor)) for sensor in scene.sensors if isinstance(sensor, _FRAMED))


def _compare_members(
    comparison: Comparison,
    path: str,
    first: Iterable[Any],
    second: Iterable[Any],
    compare: Callable[[str, Any, Any], None],
) -> None:
    """Compare what has ids: what only one has, what both have, and in which order."""
    a: Mapping[Key, Any] = {key_of(member.id): member for member in first}
    b: Mapping[Key, Any] = {key_of(member.id): member for member in second}
    for key, member in a.items():
        if key not in b:
            comparison.add(f"{path}[{member.id!r}]", Change.REMOVED, _named(member))
    for key, member in b.items():
        if key not in a:
            comparison.add(f"{path}[{member.id!r}]", Change.ADDED, _named(member))
        else:
            compare(f"{path}[{member.id!r}]", a[key], member)
    if [key for key in a if key in b] != [key for key in b if key in a]:
        comparison.add(path, Change.CHANGED, "in another order")


def _named(member: Any) -> str:
    label = getattr(member, "label", None)
    return str(member.type) if label is None else f"{member.type} {shown(label)}"


def _compare_sensor(
    comparison: Comparison, path: str, a: Sensor, b: Sensor, on_frame: Callable[[], None], *, pixels: bool
) -> None:
    comparison.records(path, a, b, skipped=("frames", "images", "video"))
    if isinstance(a, CameraSensor) and isinstance(b, CameraSensor):
        compare_images(comparison, f"{path}.images", a, b, on_frame, pixels=pixels)
    elif isinstance(a, DepthCameraSensor) and isinstance(b, DepthCameraSensor):
        compare_depth_images(comparison, f"{path}.frames", a, b, on_frame, pixels=pixels)
    elif isinstance(a, LidarSensor | RadarSensor) and type(a) is type(b):
        compare_frames(comparison, f"{path}.frames", a.frames, b.frames, _compare_cloud, on_frame)


def _compare_cloud(
    comparison: Comparison, path: str, a: LidarFrame | RadarFrame, b: LidarFrame | RadarFrame
) -> None:
    """Compare two frames; of different numbers of points only the numbers are reported."""
    if len(a.points) == len(b.points):
        comparison.records(path, a, b)
        return
    comparison.records(path, a, b, skipped=("points",))
    count, other = len(a.points), len(b.points)
    comparison.add(
        f"{path}.points", Change.CHANGED, f"{count} points; then {other}", abs(count - other), "points"
    )
