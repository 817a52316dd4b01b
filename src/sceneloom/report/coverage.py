"""What the sensors see, over sampled frames: points by range, ring and direction, fields of view; and the section."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, FloatArray, spread_rows
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import unproject
from sceneloom.errors import CalibrationError, DataError, SceneloomError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.fusing import CameraReport
from sceneloom.report.content import (
    FARTHEST,
    NOTHING,
    Block,
    Column,
    Drawing,
    Section,
    Table,
    bars,
    colour_at,
    columns,
    count,
    draw_svg,
    fixed,
    percent,
    short,
    text_column,
)
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarPoints, LidarSensor, RadarSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.samples import choose_ego, frame_of_points, locations_of, poses_at
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier

RANGE_EDGES = (0.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 75.0, 100.0, 150.0, 200.0)
"""Borders of the ranges that points are counted by [m]; farther ones are counted by themselves."""
_MOST_RINGS = 256
_SECTORS = 72  # parts of the horizon that are looked at, 5 degrees each
_FINE = 360
_STEP, _STEPS = 0.5, 600
_FAR_SHARE = 0.95


class CloudCoverage(msgspec.Struct, frozen=True, kw_only=True):
    """What one lidar or radar measures, on the average of the sweeps that were looked at.

    Attributes:
        sensor, type: the sensor.
        sweeps: how many were looked at, and `of` how many.
        points_mean, points_least, points_most: points of a sweep.
        range_edges: borders of ranges [m].
        range_counts: mean points of a sweep between each two borders, and beyond the last one.
        range_median, range_95, range_max: of all points [m].
        rings: mean points of a sweep by number of the laser; empty where points do not name it.
        lowest_deg, highest_deg: elevation that 98 % of the points lie between [deg], seen level from the sensor.
        sectors: mean points of a sweep in each sector, counter-clockwise from straight ahead.
        reaches: how far 95 % of the points of each sector lie [m]; 0 where there are none.
        horizon_share: of the sectors, those with points.
        non_finite_share: of the points, those that are not finite or at the sensor itself.
        with_times, with_intensities, with_colours: whether points have them.
    """

    sensor: Identifier
    type: str
    sweeps: int
    of: int
    points_mean: float
    points_least: int
    points_most: int
    range_edges: tuple[float, ...] = RANGE_EDGES
    range_counts: tuple[float, ...] = ()
    range_median: float = 0.0
    range_95: float = 0.0
    range_max: float = 0.0
    rings: tuple[float, ...] = ()
    lowest_deg: float = 0.0
    highest_deg: float = 0.0
    sectors: tuple[float, ...] = ()
    reaches: tuple[float, ...] = ()
    horizon_share: float = 0.0
    non_finite_share: float = 0.0
    with_times: bool = False
    with_intensities: bool = False
    with_colours: bool = False


@dataclass(slots=True)
class CloudStatistics:
    """Counts points of one sensor while its sweeps pass, in bounded memory."""

    counts: list[int] = field(default_factory=list)
    non_finite: int = 0
    farthest: float = 0.0
    with_times: bool = False
    with_intensities: bool = False
    with_colours: bool = False
    _ranges: Float64Array = field(default_factory=lambda: np.zeros(len(RANGE_EDGES)))
    _rings: Float64Array = field(default_factory=lambda: np.zeros(_MOST_RINGS))
    _by_direction: Float64Array = field(default_factory=lambda: np.zeros((_FINE, _STEPS)))
    _elevations: Float64Array = field(default_factory=lambda: np.zeros(1800))

    def add(self, points_level: FloatArray, points: LidarPoints | None = None) -> None:
        """Count one sweep.

        Args:
            points_level: (N, 3) [m] from the sensor, z up, x ahead.
            points: what else is known of them.
        """
        points_level = points_level.astype(np.float64)  # squares of float32 end at 2e19 m
        ranges = np.linalg.norm(points_level, axis=1)
        known = np.isfinite(ranges) & (ranges > 1e-6)
        self.counts.append(len(ranges))
        self.non_finite += int(len(ranges) - known.sum())
        if known.any():
            self._add_known(points_level[known], ranges[known])
        if points is None:
            return
        self.with_times |= points.timestamps_ns is not None
        self.with_intensities |= points.intensities is not None
        self.with_colours |= points.colors is not None
        if points.rings is not None:
            self._rings += np.bincount(np.minimum(points.rings, _MOST_RINGS - 1), minlength=_MOST_RINGS)

    def _add_known(self, points_level: Float64Array, ranges: Float64Array) -> None:
        self.farthest = max(self.farthest, float(ranges.max()))
        rows = np.searchsorted(RANGE_EDGES, ranges, side="right") - 1
        self._ranges += np.bincount(rows, minlength=len(RANGE_EDGES))
        degrees = np.degrees(np.arctan2(points_level[:, 1], points_level[:, 0]))
        directions = np.floor(degrees).astype(np.int64) % _FINE
        steps = np.minimum(ranges / _STEP, _STEPS - 1).astype(np.int64)
        flat = np.bincount(directions * _STEPS + steps, minlength=_FINE * _STEPS)
        self._by_direction += flat.reshape(_FINE, _STEPS)
        heights = np.degrees(np.arcsin(np.clip(points_level[:, 2] / ranges, -1.0, 1.0)))
        self._elevations += np.bincount(np.clip(((heights + 90.0) * 10.0).astype(np.int64), 0, 1799), minlength=1800)

    def coverage(self, sensor: Identifier, kind: str, *, of: int) -> CloudCoverage:
        """Give the averages; `of` so many sweeps in all."""
        sweeps = len(self.counts)
        reported = CloudCoverage(
            sensor=sensor,
            type=kind,
            sweeps=sweeps,
            of=of,
            points_mean=float(np.mean(self.counts)) if sweeps else 0.0,
            points_least=min(self.counts, default=0),
            points_most=max(self.counts, default=0),
            non_finite_share=self.non_finite / max(sum(self.counts), 1),
            with_times=self.with_times,
            with_intensities=self.with_intensities,
            with_colours=self.with_colours,
        )
        if sweeps == 0 or not self._ranges.any():
            return reported
        by_range = self._by_direction.sum(axis=0)
        sectors = self._by_direction.reshape(_SECTORS, _FINE // _SECTORS, _STEPS).sum(axis=1)
        low, high = (_quantile(self._elevations, share) / 10.0 - 90.0 for share in (0.01, 0.99))
        last_ring = np.flatnonzero(self._rings)
        return msgspec.structs.replace(
            reported,
            range_counts=tuple((self._ranges / sweeps).round(2).tolist()),
            range_median=_STEP * _quantile(by_range, 0.5),
            range_95=_STEP * _quantile(by_range, _FAR_SHARE),
            range_max=self.farthest,
            rings=tuple((self._rings[: last_ring[-1] + 1] / sweeps).round(2).tolist()) if len(last_ring) else (),
            lowest_deg=low,
            highest_deg=high,
            sectors=tuple((sectors.sum(axis=1) / sweeps).round(2).tolist()),
            reaches=tuple(_STEP * _quantile(sector, _FAR_SHARE) for sector in sectors),
            horizon_share=float((sectors.sum(axis=1) > 0).mean()),
        )


def _quantile(counts: Float64Array, share: float) -> float:
    """Where a share of what was counted lies below, in bins, straight within a bin; 0 where nothing was."""
    total = counts.sum()
    if total == 0:
        return 0.0
    sums = np.cumsum(counts)
    k = int(np.searchsorted(sums, share * total))
    before = sums[k - 1] if k else 0.0
    return float(k + (share * total - before) / max(counts[k], 1e-12))


_SWEEPS = 12  # sweeps of each lidar and radar that are looked at, at most
_RAYS = 65
_MOVES = 0.5  # between two looks the ego has to move so far for its motion to state where ahead is [m]
_AROUND_NS = 1_000_000_000
"""Where ahead is, is reported by the motion so long before and after the middle of the drive, at most [ns]."""
_Surveying = LidarSensor | RadarSensor


class CameraCoverage(msgspec.Struct, frozen=True, kw_only=True):
    """Where a camera looks.

    Attributes:
        width, height: of its images [px].
        model: of its camera model.
        across_deg, upright_deg: angles of view along the middle row and column [deg].
        left_deg, right_deg: ends of the middle row, counter-clockwise from straight ahead [deg], `left_deg` the larger
            one; None where the mounting is not known.
        heading_deg, pitch_deg: where the middle of the image looks: counter-clockwise from ahead, up [deg].
    """

    sensor: Identifier
    width: int
    height: int
    model: str
    across_deg: float | None = None
    upright_deg: float | None = None
    left_deg: float | None = None
    right_deg: float | None = None
    heading_deg: float | None = None
    pitch_deg: float | None = None


class Coverage(msgspec.Struct, frozen=True, kw_only=True):
    """What the sensors see together.

    Attributes:
        ahead_by: how it is known where ahead is: "motion", "camera" or "axes".
        lidar_share, camera_share, both_share: of the horizon, what lidars, cameras, and both see.
        skipped: frames that could not be read or placed, and why.
    """

    clouds: tuple[CloudCoverage, ...] = ()
    cameras: tuple[CameraCoverage, ...] = ()
    ahead_by: str = "axes"
    lidar_share: float = 0.0
    camera_share: float = 0.0
    both_share: float = 0.0
    skipped: tuple[str, ...] = ()

    @classmethod
    def of(cls, scene: Scene, *, sweeps: int = _SWEEPS, ego: EgoMotion | None = None) -> "Coverage":
        """Look at some sweeps of each lidar and radar, and at all camera models."""
        survey = _Survey.of(scene, ego)
        clouds = tuple(survey.cloud(s, sweeps) for s in scene.sensors if isinstance(s, LidarSensor | RadarSensor))
        cameras = tuple(survey.view(camera) for camera in scene.cameras)
        lidar, camera = np.zeros(360, np.bool_), np.zeros(360, np.bool_)
        for cloud in clouds:
            if cloud.type == "lidar" and cloud.sectors:
                lidar |= np.repeat(np.array(cloud.sectors) > 0, 360 // len(cloud.sectors))
        for view in cameras:
            if view.left_deg is not None and view.right_deg is not None:
                camera |= (np.arange(360) + 0.5 - view.right_deg) % 360 <= view.left_deg - view.right_deg
        return cls(
            clouds=clouds,
            cameras=cameras,
            ahead_by=survey.ahead_by,
            lidar_share=float(lidar.mean()),
            camera_share=float(camera.mean()),
            both_share=float((lidar & camera).mean()),
            skipped=tuple(survey.skipped),
        )

    def section(self, missing: str | None, fused: Sequence[CameraReport]) -> Section:
        """Which part of the surroundings each sensor sees, and how densely; `fused` are the cameras of a fusion."""
        paired = {camera.camera: camera for camera in fused if camera.paired}
        clouds = [cloud for cloud in self.clouds if cloud.sweeps][:_MOST_CLOUDS]
        plots = [*self._around(), *(plot for cloud in clouds for plot in _plots(cloud)), *_shares(paired)]
        cameras = [(camera, paired.get(camera.sensor)) for camera in self.cameras]
        found = bool(self.clouds or self.cameras)
        facts = [
            ("Horizon seen by lidars", percent(self.lidar_share, 0)),
            ("By cameras", percent(self.camera_share, 0)),
            ("By both", percent(self.both_share, 0)),
        ]
        return Section(
            key="coverage",
            name="Coverage",
            missing=missing,
            absent=None if found else "There is no lidar, radar or camera.",
            facts=facts if found else [],
            blocks=[
                Block(plots=plots),
                Block(
                    tables=[
                        Table("Lidars and radars", _CLOUD_COLUMNS, self.clouds),
                        Table("Cameras", _CAMERA_COLUMNS, cameras),
                    ]
                ),
                Block(list_title=f"Not looked at: {len(self.skipped)}", listed=self.skipped),
            ],
        )

    def _around(self) -> list[Drawing]:
        """Where cameras look and how far lidars and radars reach; nothing where neither is known."""
        reaching = [cloud for cloud in self.clouds if any(cloud.reaches)]
        looking = [camera for camera in self.cameras if camera.left_deg is not None]
        if not reaching and not looking:
            return []
        looks = [f"{camera.sensor} from {camera.left_deg:.0f}° to {camera.right_deg:.0f}°" for camera in looking]
        seen = [f"{c.sensor} sees {percent(c.horizon_share, 0)} of the horizon" for c in self.clouds if c.sweeps]
        caption = (
            f"Ahead, as known {_AHEAD[self.ahead_by]}, is up. Outlines: within them lie 95 % of the points of each "
            "direction, from the sensor. Wedges: the middle rows of the images; their length means nothing."
        )
        svg = _draw_around(reaching, looking)
        return [Drawing("Around the ego", "; ".join([*seen, *looks]), svg, caption, kind="tall")]


_AHEAD = {"motion": "by the motion", "camera": "by the first camera", "axes": "by the axes of the sensors"}
_MOST_CLOUDS = 6

_CLOUD_COLUMNS = (
    text_column("Sensor", lambda cloud: f"{cloud.sensor} ({cloud.type})"),
    Column("Sweeps looked at", lambda cloud: f"{cloud.sweeps:,} of {cloud.of:,}"),
    Column("Points of a sweep", lambda cloud: count(cloud.points_mean)),
    Column("Least / most", lambda cloud: f"{cloud.points_least:,} / {cloud.points_most:,}"),
    Column(
        "Range: median / 95 % / farthest [m]",
        lambda cloud: f"{cloud.range_median:.1f} / {cloud.range_95:.1f} / {cloud.range_max:.1f}",
    ),
    Column("Elevation [deg]", lambda cloud: f"{cloud.lowest_deg:.1f} to {cloud.highest_deg:.1f}"),
    Column("Horizon", lambda cloud: percent(cloud.horizon_share, 0)),
    Column("Rings", lambda cloud: count(sum(number > 0 for number in cloud.rings)) if cloud.rings else NOTHING),
    Column("Non-finite", lambda cloud: percent(cloud.non_finite_share)),
    text_column(
        "Points have",
        lambda cloud: (
            ", ".join(n for n in ("times", "intensities", "colours") if getattr(cloud, f"with_{n}")) or NOTHING
        ),
    ),
)

_WORDS = ("ahead", "ahead left", "left", "back left", "back", "back right", "right", "ahead right")
"""Directions in steps of 45 degrees, left positive."""

_CAMERA_COLUMNS = (
    text_column("Camera", lambda row: row[0].sensor),
    text_column("Camera model", lambda row: row[0].model.replace("_", " ")),
    Column("Image [px]", lambda row: f"{row[0].width}×{row[0].height}"),
    Column(
        "Across / upright [deg]",
        lambda row: (
            NOTHING if row[0].across_deg is None else f"{row[0].across_deg:.0f} / {row[0].upright_deg or 0.0:.0f}"
        ),
    ),
    Column(
        "Looks to [deg]",
        lambda row: (
            NOTHING
            if row[0].heading_deg is None
            else f"{row[0].heading_deg:+.0f} ({_WORDS[round(row[0].heading_deg / 45.0) % 8]})"
        ),
    ),
    Column("Up [deg]", lambda row: fixed(row[0].pitch_deg, 1)),
    Column("Points in the image", lambda row: NOTHING if row[1] is None else f"{row[1].in_image_percent:.1f} %"),
    Column("Hidden of these", lambda row: NOTHING if row[1] is None else f"{row[1].hidden_percent:.1f} %"),
)  # of a camera, and of its part in the fusion if it has one


def _draw_around(clouds: Sequence[CloudCoverage], cameras: Sequence[CameraCoverage]) -> bytes:
    """Wedges of the cameras and outlines of the points, ahead up."""
    far = min(max([max(cloud.reaches) for cloud in clouds], default=50.0), FARTHEST)

    def draw(axes: Any) -> None:
        axes.set_theta_zero_location("N")
        for k, camera in enumerate(cameras, start=len(clouds)):
            left, right = np.radians([camera.left_deg or 0.0, camera.right_deg or 0.0])
            name = short(f"{camera.sensor}, {camera.across_deg or 0.0:.0f}° across")
            axes.bar((left + right) / 2, far, width=left - right, color=colour_at(k), alpha=0.25, label=name)
        for k, cloud in enumerate(clouds):
            edges = np.linspace(0.0, 2 * np.pi, len(cloud.reaches) + 1)
            angles, reaches = np.repeat(edges, 2)[1:-1], np.repeat(np.minimum(cloud.reaches, far), 2)
            axes.plot(angles, reaches, color=colour_at(k), label=short(f"{cloud.sensor} ({cloud.type}) [m]"))
        axes.set_xticks(np.radians([0, 90, 180, 270]), ["ahead", "left", "back", "right"])
        axes.set_ylim(0, far)
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, -0.3))

    return draw_svg((5.0, 5.5), draw, projection="polar")


def _plots(cloud: CloudCoverage) -> list[Drawing]:
    found = []
    if cloud.range_counts:
        edges = [f"{edge:g}" for edge in cloud.range_edges]
        names = [*(f"{a}–{b}" for a, b in pairwise(edges)), f"{edges[-1]}+"]
        svg = columns(names, cloud.range_counts, x_name="range [m]", y_name="points of a sweep")
        text = f"Half of the points lie within {cloud.range_median:.0f} m, 95 % within {cloud.range_95:.0f} m"
        found.append(Drawing(f"Points of {cloud.sensor} by range", text, svg))
    if len(cloud.rings) > 1:
        first = next(k for k, number in enumerate(cloud.rings) if number)
        names, rings = [str(k) for k in range(first, len(cloud.rings))], cloud.rings[first:]
        svg = columns(names, rings, x_name="number of the ring", y_name="points of a sweep")
        text = f"{len(rings)} rings with {min(rings):,.0f} to {max(rings):,.0f} points of a sweep"
        found.append(Drawing(f"Points of {cloud.sensor} by ring", text, svg))
    return found


def _shares(paired: Mapping[Identifier, CameraReport]) -> list[Drawing]:
    if not paired:
        return []
    shares = {str(key): camera.in_image_percent for key, camera in paired.items()}
    labels = [f"{share:.1f} %" for share in shares.values()]
    text = "; ".join(f"{name} {share}" for name, share in zip(shares, labels, strict=True))
    values = list(shares.values())
    svg = bars([*shares], values, labels=labels, most=max(100.0 if max(values) > 50 else 50.0, *values))
    return [Drawing("Share of all points in each camera's images", text, svg)]


@dataclass(slots=True)
class _Survey:
    """Knows how each sensor lies in a level frame whose x axis leads ahead."""

    scene: Scene
    ego: EgoMotion | None
    level_from_sensor: Mapping[Identifier, Float64Array]
    ahead_by: str
    skipped: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, scene: Scene, ego: EgoMotion | None) -> "_Survey":
        chosen = ego
        if chosen is None:
            try:
                chosen = choose_ego(scene, None)
            except SceneloomError:
                chosen = None
        rotations, ahead_by = _rotations_to_level(scene, chosen)
        return cls(scene, chosen, rotations, ahead_by)

    def cloud(self, sensor: _Surveying, most: int) -> CloudCoverage:
        statistics = CloudStatistics()
        rotation = self.level_from_sensor.get(sensor.id, np.eye(3))
        rows = spread_rows(len(sensor.frames), most)
        for row in rows.tolist():
            try:
                frame = sensor.frames[row]
            except DataError as error:
                self.skipped.append(str(error))
                continue
            sensor_from_points = self._sensor_from_points(sensor, frame.timestamp_ns)
            if sensor_from_points is None:
                self.skipped.append(f"{sensor.id}: it is not known where its points are seen from")
                break
            positions = sensor_from_points.apply(frame.points.positions)
            statistics.add(positions @ rotation.T, frame.points if isinstance(sensor, LidarSensor) else None)
        return statistics.coverage(sensor.id, str(sensor.type), of=len(sensor.frames))

    def _sensor_from_points(self, sensor: _Surveying, time_ns: int) -> RigidTransform | None:
        if sensor.points_frame == "sensor":
            return RigidTransform.identity()
        if sensor.points_frame == "ego" and sensor.mount is not None:
            return sensor.mount.inverse()
        points = frame_of_points(self.scene, sensor, self.ego)
        own = locations_of(self.scene, [sensor], self.ego)[sensor.id]
        of_points, of_sensor = (pose.world_from_sensor for pose in poses_at([(points, time_ns), (own, time_ns)]))
        if of_points is None or of_sensor is None:
            return None
        return of_sensor.inverse() @ of_points

    def view(self, sensor: CameraSensor) -> CameraCoverage:
        camera = sensor.camera
        known = CameraCoverage(sensor=sensor.id, width=camera.width, height=camera.height, model=camera.model)
        try:
            across, upright = _rays(camera, 0), _rays(camera, 1)
        except CalibrationError:
            return known
        known = msgspec.structs.replace(known, across_deg=_bend(across), upright_deg=_bend(upright))
        rotation = self.level_from_sensor.get(sensor.id)
        if rotation is None or len(across) < 2:
            return known
        level = across @ rotation.T
        angles = np.degrees(np.unwrap(np.arctan2(level[:, 1], level[:, 0])))
        middle = unproject(camera, np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]]))[0]
        ahead = rotation @ (middle if np.isfinite(middle).all() else np.array([0.0, 0.0, 1.0]))
        return msgspec.structs.replace(
            known,
            left_deg=float(angles.max()),
            right_deg=float(angles.min()),
            heading_deg=float(np.degrees(np.arctan2(ahead[1], ahead[0]))),
            pitch_deg=float(np.degrees(np.arcsin(np.clip(ahead[2], -1.0, 1.0)))),
        )


def _rays(camera: Camera, axis: int) -> Float64Array:
    """Unit rays of the pixels along the middle row (axis 0) or column (1), from edge to edge; (M, 3)."""
    size = (camera.width, camera.height)
    pixels = np.empty((_RAYS, 2))
    pixels[:, axis] = np.linspace(-0.5, size[axis] - 0.5, _RAYS)
    pixels[:, 1 - axis] = (size[1 - axis] - 1) / 2
    rays = unproject(camera, pixels)
    return rays[np.isfinite(rays).all(axis=1)]


def _bend(rays: Float64Array) -> float | None:
    """The angle from the first ray to the last along all between them [deg]."""
    if len(rays) < 2:
        return None
    cosines = np.clip((rays[1:] * rays[:-1]).sum(axis=1), -1.0, 1.0)
    return float(np.degrees(np.arccos(cosines)).sum())


def _rotations_to_level(scene: Scene, ego: EgoMotion | None) -> tuple[dict[Identifier, Float64Array], str]:
    """(3, 3) rotations from each sensor's frame into a level one that looks ahead, and how ahead is known."""
    sensors = [s for s in scene.sensors if isinstance(s, LidarSensor | RadarSensor | CameraSensor)]
    locations = locations_of(scene, sensors, ego)
    times = _times(scene, ego)
    poses = {
        sensor.id: [pose.world_from_sensor for pose in poses_at([(locations[sensor.id], t) for t in times])]
        for sensor in sensors
    }
    world = {key: [p for p in found if p is not None] for key, found in poses.items()}
    if any(world.values()):
        middle = {key: found[len(found) // 2].rotation for key, found in world.items() if found}
        ahead, known_by = _ahead_in_world(scene, world, middle)
        # each sensor is levelled where it stood: all looked at the same moment lie alike to one another
        level_from_world = _looking(ahead, np.array([0.0, 0.0, 1.0]))
        rotated = {key: level_from_world @ rotation for key, rotation in middle.items()}
        return _joined(rotated, {s.id: locations[s.id].mount for s in sensors}), known_by
    mounts = {s.id: locations[s.id].mount for s in sensors}
    known = {key: mount.rotation for key, mount in mounts.items() if mount is not None}
    ahead, known_by = np.array([1.0, 0.0, 0.0]), "axes"
    first = next((camera for camera in scene.cameras if camera.id in known), None)
    if first is not None and abs((known[first.id] @ [0.0, 0.0, 1.0])[2]) < 0.9:
        ahead, known_by = known[first.id] @ np.array([0.0, 0.0, 1.0]), "camera"
    level_from_ego = _looking(ahead, np.array([0.0, 0.0, 1.0]))
    return {key: level_from_ego @ rotation for key, rotation in known.items()}, known_by


def _joined(
    rotated: dict[Identifier, Float64Array], mounts: Mapping[Identifier, RigidTransform | None]
) -> dict[Identifier, Float64Array]:
    """Add sensors that have a mounting, but no pose at the moments looked at, through one that has both."""
    both = next((key for key in rotated if mounts.get(key) is not None), None)
    if both is None:
        return rotated
    mount = mounts[both]
    if mount is None:
        return rotated
    level_from_ego = rotated[both] @ mount.rotation.T
    for key, other in mounts.items():
        if key not in rotated and other is not None:
            rotated[key] = level_from_ego @ other.rotation
    return rotated


def _times(scene: Scene, ego: EgoMotion | None) -> list[int]:
    """The middle of the time in which poses are known, and a moment before and after it [ns]."""
    timestamps: Sequence[int] = ()
    if ego is not None and not ego.path.static:
        timestamps = ego.path.timestamps_ns.tolist()
    else:
        for sensor in scene.sensors:
            path = getattr(sensor, "poses", None)
            if path is not None and not path.static and len(path.timestamps_ns) > len(timestamps):
                timestamps = path.timestamps_ns.tolist()
    if not len(timestamps):
        return [0]
    half_ns = min(_AROUND_NS, round(0.45 * (timestamps[-1] - timestamps[0])))
    middle_ns = (timestamps[0] + timestamps[-1]) // 2
    return [middle_ns - half_ns, middle_ns, middle_ns + half_ns]


def _ahead_in_world(
    scene: Scene, world: Mapping[Identifier, list[RigidTransform]], middle: Mapping[Identifier, Float64Array]
) -> tuple[Float64Array, str]:
    for found in world.values():
        if len(found) >= 2:
            step = found[-1].translation - found[0].translation
            if np.hypot(step[0], step[1]) >= _MOVES:
                return step, "motion"
    for camera in scene.cameras:
        if camera.id in middle:
            ray = middle[camera.id] @ np.array([0.0, 0.0, 1.0])
            if abs(ray[2]) < 0.9:
                return ray, "camera"
    return next(iter(middle.values()))[:, 0], "axes"


def _looking(ahead: Float64Array, up: Float64Array) -> Float64Array:
    """The (3, 3) rotation into a frame whose z axis is `up`, and whose x axis is `ahead` made level."""
    level = ahead - (ahead @ up) * up
    length = float(np.linalg.norm(level))
    x = level / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    return np.stack([x, np.cross(up, x), up])
