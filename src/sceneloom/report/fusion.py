"""A quick check of the camera-lidar calibration, the fusion of some sweeps, and the sections about both."""

from dataclasses import dataclass, field, replace

import msgspec
import numpy as np

from sceneloom.arrays import spread_rows
from sceneloom.calibrate.health import Item, Verdict, check_calibration
from sceneloom.colouring.results import FusedFrame, FusedView
from sceneloom.errors import SceneloomError
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.pipeline.alignment import align
from sceneloom.pipeline.fusing import CameraReport, FusionStatistics
from sceneloom.pipeline.play import Skips, build_system, play, report_of
from sceneloom.report.content import NOTHING, Block, Column, Figures, Section, Table, count, text_column
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene, Sensor, scene_period_ns, sweep_period_ns
from sceneloom.scene.types import Identifier
from sceneloom.visualization.canvas import several
from sceneloom.visualization.fused_frames import DriveCloud, iter_images

_FRAMES = 6  # images of each camera that are looked at; `sceneloom calibrate --check` takes more
_MOST_CAMERAS = 6  # cameras that are checked: each takes seconds


class CalibrationCheck(msgspec.Struct, frozen=True, kw_only=True):
    """What a quick check of one camera against the first lidar gave.

    Attributes:
        verdict: "good", "drifting", "wrong" or "cannot determine".
        reason: why, where that is known in one line.
        items: by part: rotation, translation, …
        frames: images that were looked at.
        distinctness, stated_distinctness: how far the best calibration, and the stated one, stand above chance, in
            chance's own deviations.
    """

    camera: Identifier
    lidar: Identifier
    verdict: str
    reason: str = ""
    items: tuple[Item, ...] = ()
    frames: int = 0
    distinctness: float = 0.0
    stated_distinctness: float = 0.0

    def block(self) -> Block:
        """What is to be said of it."""
        caption = f"Parts of the calibration of {self.camera}"
        return Block(
            heading=f"{self.camera} against {self.lidar}",
            badge=(_BADGES.get(self.verdict, "hint"), self.verdict),
            lines=[self.reason] if self.reason else [],
            tables=[Table(caption, _ITEM_COLUMNS, self.items, folded=True)],
        )

    @classmethod
    def of(cls, scene: Scene, *, frames: int = _FRAMES) -> "tuple[CalibrationCheck, ...]":
        """Check the first cameras of a scene against its first lidar; nothing where it has no lidar."""
        lidars = [lidar for lidar in scene.lidars if len(lidar.frames)]
        cameras = [camera for camera in scene.cameras if len(camera.images)]
        if not lidars or not cameras:
            return ()
        return tuple(_check(scene, camera.id, lidars[0].id, frames) for camera in cameras[:_MOST_CAMERAS])


_BADGES = {"good": "good", "wrong": "error", "drifting": "warning", "cannot determine": "hint"}


def _change_text(item: Item) -> str:
    changes = [f"{v:+.2f} ± {s:.2f}" for v, s in zip(item.values, item.sigmas, strict=True)]
    return f"{', '.join(changes)} {item.unit}" if changes else NOTHING


_ITEM_COLUMNS = (
    text_column("Part", lambda item: item.name.replace("_", " ")),
    text_column("Verdict", lambda item: item.verdict.value),
    Column("Would have to change by", _change_text),
    text_column("Why", lambda item: item.reason or NOTHING, wide=True),
)


def _check(scene: Scene, camera_id: Identifier, lidar_id: Identifier, frames: int) -> CalibrationCheck:
    known = CalibrationCheck(camera=camera_id, lidar=lidar_id, verdict=Verdict.UNDETERMINED.value)
    try:
        health = check_calibration(scene, camera_id, lidar_id, most=frames)
    except SceneloomError as error:
        return msgspec.structs.replace(known, reason=str(error))
    return msgspec.structs.replace(
        known,
        verdict=health.verdict.value,
        reason=f"good {health.extent}"
        if health.extent
        else next((item.reason for item in health.items if item.verdict is health.verdict and item.reason), ""),
        items=health.items,
        frames=health.frames,
        distinctness=health.distinctness,
        stated_distinctness=health.stated_distinctness,
    )


_SWEEPS = 8  # sweeps of each lidar that are fused, at most
_MOST_VIEWS = 12  # cameras of a sweep that are drawn, at most


class Fusion(msgspec.Struct, frozen=True, kw_only=True):
    """What fusing gave.

    Attributes:
        trajectory: name of the ego trajectory; None where every sensor has poses of its own.
        sweeps: how many were fused, `of` how many the drive has.
        points: of these sweeps.
        coloured_percent: of them that got a colour.
        extrapolated: sweeps that needed poses beyond the trajectory's ends.
        unfused: why others were not fused, with counts.
        skipped: sweeps and images that could not be read, one line each.
        time_differences_ms: by camera, how much later than its sweep's middle its image is: the median [ms].
    """

    trajectory: str | None
    sweeps: int
    of: int
    points: int
    coloured_percent: float
    cameras: tuple[CameraReport, ...]
    extrapolated: int = 0
    unfused: dict[str, int] = msgspec.field(default_factory=dict)
    skipped: tuple[str, ...] = ()
    time_differences_ms: dict[str, float] = msgspec.field(default_factory=dict)

    @classmethod
    def sampled(cls, scene: Scene, figures: Figures, *, sweeps: int = _SWEEPS, lenient: bool = True) -> "Fusion":
        """Fuse some sweeps spread over the drive, and draw what came out.

        Args:
            scene: with an ego trajectory, or sensors that are placed in the world.
            sweeps: of each lidar, at most.

        Raises:
            PoseError: the sensors' motion is not known.
            CalibrationError: a camera model cannot be computed with.
            DataError: a sweep or image cannot be read, and that is not passed over.
        """
        aligned = align(scene)
        few = _with_some_sweeps(aligned.scene, sweeps)
        skips = Skips(lenient)
        gathered = _Gathered(FusionStatistics.of(aligned), DriveCloud(frozenset(range(sweeps))))
        most = max((len(lidar.frames) for lidar in few.lidars), default=0)
        # by the pace of the whole drive
        configuration = FusionConfiguration(pairing_tolerance_ns=scene_period_ns(aligned.scene))
        for frame in play(few, build_system(aligned.scene, aligned.ego, configuration, skips), skips):
            gathered.add(frame, middle=min(sweeps, most) // 2)
        _draw(gathered, figures, None if aligned.ego is None else aligned.ego.path)
        statistics, differences_ns = gathered.statistics, gathered.differences_ns
        return report_of(
            cls,
            statistics,
            trajectory=aligned.trajectory,
            sweeps=statistics.fused,
            of=aligned.sweeps,
            skipped=skips.reasons,
            time_differences_ms={key: float(np.median(all_)) / 1e6 for key, all_ in differences_ns.items()},
        )

    def section(self, figures: Figures, missing: str | None) -> Section:
        """Show coloured clouds and depth images, with the counts behind them."""
        rows = [(camera, self.time_differences_ms.get(str(camera.camera))) for camera in self.cameras]
        unfused = [f"{several(number, 'sweep')}: {reason}" for reason, number in self.unfused.items()]
        left = f"{several(figures.left_out, 'image')} more had no room on the page."
        return Section(
            key="fusion",
            name="Fusion",
            missing=missing,
            facts=[
                ("Sweeps fused", f"{self.sweeps:,} of {self.of:,}"),
                ("Points coloured", f"{self.coloured_percent:.1f} %"),
                ("Ego trajectory", self.trajectory or "sensors' own poses"),
            ],
            blocks=[
                Block(photos=figures.of("fusion")),
                Block(tables=[Table("Images and points of the fused sweeps", _CAMERA_COLUMNS, rows)]),
                Block(lines=[left] if figures.left_out else [], faint=True),
                Block(list_title="Sweeps that could not be fused", listed=unfused),
                Block(list_title=f"Could not be read: {len(self.skipped)}", listed=self.skipped[:50]),
            ],
        )


_CAMERA_COLUMNS = (
    text_column("Camera", lambda row: row[0].camera),
    Column("Sweeps with an image", lambda row: count(row[0].paired)),
    Column("Without one in time", lambda row: count(row[0].unpaired)),
    Column("Beyond the trajectory", lambda row: count(row[0].unposed)),
    Column("Later than its sweep [ms]", lambda row: NOTHING if row[1] is None else f"{row[1]:+.1f}"),
    Column("Points in the image", lambda row: f"{row[0].in_image_percent:.1f} %"),
    Column("Hidden of these", lambda row: f"{row[0].hidden_percent:.1f} %"),
    Column("Points coloured", lambda row: count(row[0].coloured)),
)


@dataclass(slots=True)
class _Gathered:
    """What is kept of the fused sweeps."""

    statistics: FusionStatistics
    cloud: DriveCloud
    shown: dict[Identifier, FusedFrame] = field(default_factory=dict)
    differences_ns: dict[str, list[int]] = field(default_factory=dict)

    def add(self, frame: FusedFrame, *, middle: int) -> None:
        self.statistics.add(frame)
        self.cloud.add(frame)
        for view in frame.views:
            away = view.timestamp_ns - frame.reference_ns
            self.differences_ns.setdefault(str(view.camera_id), []).append(away)
        known = self.shown.get(frame.lidar_id)
        if frame.unfused is None and (known is None or frame.index <= middle):
            self.shown[frame.lidar_id] = frame


def _with_some_sweeps(scene: Scene, most: int) -> Scene:
    """The scene with at most so many sweeps of each lidar, and of cameras the images within two sweeps of these."""
    kept = {lidar.id: spread_rows(len(lidar.frames), most) for lidar in scene.lidars}
    spans = [(lidar.frames.timestamps_ns[kept[lidar.id]], 2 * sweep_period_ns(lidar)) for lidar in scene.lidars]

    def thinned(sensor: Sensor) -> Sensor:
        if isinstance(sensor, LidarSensor):
            return replace(sensor, frames=sensor.frames.chosen(kept[sensor.id]))
        if isinstance(sensor, CameraSensor):
            times_ns = sensor.images.timestamps_ns
            near = np.zeros(len(times_ns), np.bool_)
            for sweeps_ns, reach_ns in spans:
                for sweep_ns in sweeps_ns.tolist():
                    near |= np.abs(times_ns - sweep_ns) <= reach_ns
            rows = np.flatnonzero(near)
            return replace(sensor, images=sensor.images.chosen(rows), video=None)
        return sensor

    return replace(scene, sensors=tuple(map(thinned, scene.sensors)))


def _draw(gathered: _Gathered, figures: Figures, path: Poses | None) -> None:
    """Draw one sweep of each lidar with all its images, and all that were fused as one cloud."""
    moving = None if path is None or path.static else path
    together = gathered.cloud.draw(moving)
    for frame in gathered.shown.values():
        shown = replace(frame, views=frame.views[:_MOST_VIEWS])
        plots = iter_images(shown, frame.index, ego_poses=moving, show_hidden=True)
        for number, (_, draw) in enumerate(plots):
            # two of each view come first, then two of the cloud
            beyond = number - 2 * len(shown.views)
            view = shown.views[number // 2] if beyond < 0 else None
            kind = ("overlay", "depth")[number % 2] if beyond < 0 else ("above", "perspective")[beyond]
            if view is not None or not together or len(gathered.shown) > 1:
                section = "calibration" if kind == "overlay" else "fusion"
                figures.add(section, *_reported(kind, frame, view), draw())
    for name, image in together.items():
        where = "from above" if name == "above" else "from behind the ego"
        text = f"The cloud of {gathered.statistics.fused} sweeps in the colours of the images, seen {where}"
        figures.add("fusion", f"The drive {where}", text, image)


def _reported(kind: str, frame: FusedFrame, view: FusedView | None) -> tuple[str, str]:
    """Title and text of an image."""
    name = "" if view is None else str(view.camera_id)
    camera = f"camera {name}"
    points = f"{0 if view is None else int(view.visible.sum()):,} points of lidar {frame.lidar_id}"
    cloud = f"One sweep of lidar {frame.lidar_id} in the colours of the images"
    titles = {
        "overlay": f"{name}: points over the image",
        "depth": f"{name}: depth image",
        "above": f"Lidar {frame.lidar_id} from above",
        "perspective": f"Lidar {frame.lidar_id} in perspective",
    }
    texts = {
        "overlay": f"The image of {camera}, its colours subdued, with {points} over it as discs, coloured by depth",
        "depth": f"The depths that {points} give in the image of {camera}, near to far by colour, dark without any",
        "above": f"{cloud}, as a map with a grid in metres",
        "perspective": f"{cloud}, seen from behind and above the ego",
    }
    return titles[kind], texts[kind]
