"""Edits as jobs: read drives, change them, write the result, report what was done."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.editing.thin import OnPoints
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.registry import check_scene_output, format_for_output, open_scenes, scene_for, write_scene
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor, DepthFrame
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.contents import AnyFrame, watched
from sceneloom.scene.scene import Scene, frame_times
from sceneloom.scene.types import Identifier, Progress
from sceneloom.warnings import DataWarning

Joining = Callable[[Sequence[Scene], OnPoints], Scene]
"""Makes a scene out of one or several; may report the points of each frame that is read, before and after."""


class SceneCounts(msgspec.Struct, frozen=True, kw_only=True):
    """How much is in a scene.

    Attributes:
        sensors, annotations: how many of them.
        frames: sweeps, radar cycles and images.
        points: of sweeps, radar cycles and maps.
    """

    sensors: int
    frames: int
    points: int
    annotations: int


class EditReport(msgspec.Struct, frozen=True, kw_only=True):
    """One edit.

    Attributes:
        edit: which one ("crop").
        before: what was in the sources; points of frames that were left out are not counted.
        after: what is in the output.
        warnings: what was assumed, repaired or left out, on reading and by the edit.
    """

    edit: str
    sources: tuple[str, ...]
    output: str
    before: SceneCounts
    after: SceneCounts
    seconds: float
    warnings: tuple[DataWarning, ...]
    losses: LossReport


def edit_files(
    edit: str,
    sources: Sequence[str | Path],
    output: str | Path,
    change: Joining,
    *,
    reading: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
    **writing: Any,
) -> EditReport:
    """Read drives, make one scene of them, and write it.

    Args:
        output: a file or a folder, by its suffix in any format that can be written.
        change: makes the scene.
        reading: reading options, each for the sources whose format takes it.
        progress: reported after each sweep and radar cycle that is written.
        writing: further options of the output's format.

    Raises:
        OutputError: the output exists, or cannot be written.
        SceneloomError: a source is wrong, or cannot be edited so.
    """
    begun = time.perf_counter()
    check_scene_output(Path(output), overwrite=overwrite)
    statistics = _Statistics(progress)
    with open_scenes(sources, reading or {}) as scenes:
        changed = scene_for(format_for_output(Path(output)), change(scenes, statistics.add_before))
        statistics.total = sum(len(s.frames) for s in changed.sensors if isinstance(s, LidarSensor | RadarSensor))
        losses = write_scene(watched(changed, statistics.add_after), output, overwrite=overwrite, **writing)
    return EditReport(
        edit=edit,
        sources=tuple(map(str, sources)),
        output=str(output),
        before=_counts(scenes, statistics.points_before(scenes)),
        after=_counts([changed], statistics.points_after([changed])),
        seconds=time.perf_counter() - begun,
        warnings=changed.warnings,
        losses=losses,
    )


_FrameKey = tuple[type, Identifier, int]


@dataclass(slots=True)
class _Statistics:
    """Counts the points of frames; each frame once, however often it is read."""

    progress: Progress | None
    total: int = 0
    before: dict[_FrameKey, int] = field(default_factory=dict)
    after: dict[_FrameKey, int] = field(default_factory=dict)

    def add_before(self, sensor_id: Identifier, k: int, points: int, left: int) -> None:
        del left
        self.before[type(sensor_id), sensor_id, k] = points

    def add_after(self, sensor_id: Identifier, k: int, frame: AnyFrame) -> None:
        if isinstance(frame, CameraImage | DepthFrame):
            return
        self.after[type(sensor_id), sensor_id, k] = len(frame.points)
        if self.progress is not None:
            self.progress(len(self.after), self.total)

    def points_before(self, scenes: Sequence[Scene]) -> int:
        """What the edit reported; sensors of which it states nothing keep all their points."""
        reported = {key[:2] for key in self.before}
        kept = sum(count for key, count in self.after.items() if key[:2] not in reported)
        return _map_points(scenes) + sum(self.before.values()) + kept

    def points_after(self, scenes: Sequence[Scene]) -> int:
        return _map_points(scenes) + sum(self.after.values())


def _map_points(scenes: Sequence[Scene]) -> int:
    maps = [s for scene in scenes for s in scene.sensors if isinstance(s, PointsSensor)]
    return sum(len(sensor.positions) for sensor in maps)


def _counts(scenes: Sequence[Scene], points: int) -> SceneCounts:
    framed = (LidarSensor, RadarSensor, CameraSensor, DepthCameraSensor)
    sensors = [sensor for scene in scenes for sensor in scene.sensors]
    return SceneCounts(
        sensors=len(sensors),
        frames=sum(len(frame_times(sensor)) for sensor in sensors if isinstance(sensor, framed)),
        points=points,
        annotations=sum(len(scene.annotations) for scene in scenes),
    )
