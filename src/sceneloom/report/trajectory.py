"""Ego trajectories, GNSS fixes, altitudes and speeds; metrics against ground truth; and the sections about both."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, spread_rows
from sceneloom.errors import ArrayError, DataError, OptionError, PoseError, SceneloomError
from sceneloom.evaluate.tracking import TrackingReport, compare_tracks
from sceneloom.evaluate.trajectory import TrajectoryReport, evaluate_trajectory
from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.geometry.rigid import matrix_from_quaternion
from sceneloom.motion.ego_trajectory import find_ego_motion, usable_fixes, usable_positions
from sceneloom.report.content import (
    NOTHING,
    WIDE_INCHES,
    Block,
    Column,
    Drawing,
    Section,
    Table,
    colour_at,
    count,
    counted,
    draw_svg,
    drawable,
    fixed,
    line_plot,
    percent,
    short,
    text_column,
)
from sceneloom.scene.ego import stated_origin
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Poses, Trajectory, same_direction
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates, Identifier

MOST_CORNERS = 400
"""So many positions of a trajectory are reported, evenly in time, for plots."""
_STANDS = 0.2  # slower than this the ego is stationary [m/s]
_HALF_WINDOW = 0.25
"""Speeds are taken over twice this [s], or over two poses where these are farther apart: noise is no speed."""
_LEAST_LENGTH = 5.0  # from fixes that lie less far from the first one [m] north is not estimated


class Corner(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """A position on a trajectory: seconds after the scene's first timestamp, x, y, z [m], speed [m/s]."""

    seconds: float
    x: float
    y: float
    z: float
    speed: float


class TrajectoryMetrics(msgspec.Struct, frozen=True, kw_only=True):
    """One ego trajectory.

    Attributes:
        found_now: whether it was found from the drive's measurements for this report.
        poses, seconds, metres: how many, over how long, how far.
        oriented: whether orientations are known.
        start, stop: seconds after the scene's first timestamp.
        farthest: from its first location [m].
        lowest, highest: heights [m].
        climb, descent: along it [m], steps below 5 cm left out.
        mean_speed, top_speed: [m/s]; the top one is what 99 % of the time is not exceeded.
        stationary_share: of the time, slower than 0.2 m/s.
        rotated_deg: how much the heading changed, added up [deg]; None without orientations.
        corners: positions on it, evenly in time.
    """

    name: str
    found_now: bool = False
    poses: int
    seconds: float
    metres: float
    oriented: bool
    start: float
    stop: float
    farthest: float
    lowest: float
    highest: float
    climb: float
    descent: float
    mean_speed: float
    top_speed: float
    stationary_share: float
    rotated_deg: float | None = None
    corners: tuple[Corner, ...] = ()


class Fixes(msgspec.Struct, frozen=True, kw_only=True):
    """What a satellite receiver reported.

    Attributes:
        count, usable: fixes, and those that are locations.
        first_lla, last_lla: latitude, longitude [deg], height above the ellipsoid [m] of the first and the last usable
            one.
        south, west, north, east: what the fixes lie within [deg].
        accuracy_m, worst_accuracy_m: median and largest of the stated ones; None where none is stated.
        locations: (seconds, east, north, up) [s, m] of some of them, evenly in time, seen from the map's origin.
    """

    sensor: Identifier
    count: int
    usable: int
    first_lla: tuple[float, float, float]
    last_lla: tuple[float, float, float]
    south: float
    west: float
    north: float
    east: float
    accuracy_m: float | None
    worst_accuracy_m: float | None
    locations: tuple[tuple[float, float, float, float], ...]


class North(msgspec.Struct, frozen=True, kw_only=True):
    """Where north is in the world's axes.

    Attributes:
        direction_deg: counter-clockwise from the world's x axis [deg].
        shift: (3,) what is added to fixes' locations, rotated, to bring them onto the trajectory [m].
        rms: how far fixes and trajectory are apart, level [m]; None where the axes are stated to be east, north and up.
        trajectory: name of the trajectory that was held against the fixes.
    """

    direction_deg: float
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rms: float | None = None
    trajectory: str | None = None


class Trajectories(msgspec.Struct, frozen=True, kw_only=True):
    """All trajectories and fixes of a drive.

    Attributes:
        trajectories: the default one first; where there is none, that of the first sensor with poses in the world.
        fixes: of each receiver with usable ones.
        origin_lla: the location that fixes are seen from, the first usable one; None without fixes.
        north: where north is in the world of the trajectories; None where not known.
    """

    trajectories: tuple[TrajectoryMetrics, ...]
    fixes: tuple[Fixes, ...] = ()
    origin_lla: tuple[float, float, float] | None = None
    north: North | None = None

    @classmethod
    def of(cls, scene: Scene, *, start_ns: int, found_now: frozenset[str] = frozenset()) -> "Trajectories":
        """Look at the trajectories and fixes of a scene.

        Args:
            start_ns: the scene's first timestamp [ns].
            found_now: names of the trajectories that were not in the drive as it is stored.
        """
        sampled = _trajectories(scene)
        trajectories = tuple(
            _trajectory(trajectory, start_ns, found_now=trajectory.name in found_now)
            for trajectory in sampled
            if len(trajectory.timestamps_ns)
        )
        receivers = [s for s in scene.sensors if isinstance(s, GnssSensor) and usable_fixes(s).any()]
        if not receivers:
            return cls(trajectories=trajectories)
        origin = usable_positions(receivers[0])[1][0]
        # the scene may state that its axes are east, north and up at a location, and was not moved since
        stated, north = stated_origin(scene), None
        if stated is not None:
            north = North(direction_deg=90.0, shift=_three(enu_from_geodetic(origin[None], stated)[0]))
        elif trajectories:
            north = _north(sampled[0], receivers[0], origin)
        return cls(
            trajectories=trajectories,
            fixes=tuple(_fixes(receiver, origin, start_ns) for receiver in receivers),
            origin_lla=_three(origin),
            north=north,
        )

    def section(self, missing: str | None) -> Section:
        """Draw the trajectories, and report how long, fast and high they are."""
        tables = [
            Table("Ego trajectories", _TRAJECTORY_COLUMNS, self.trajectories),
            Table("Satellite fixes", _FIX_COLUMNS, self.fixes),
        ]
        none = "There are neither poses of the ego nor satellite fixes."
        return Section(
            key="trajectory",
            name="Trajectory and map",
            missing=missing,
            absent=None if self.trajectories or self.fixes else none,
            blocks=[
                Block(plots=self._map()),
                Block(plots=self._over_time()),
                Block(tables=tables),
                Block(lines=self._north_notes(), faint=True),
            ],
        )

    def _map(self) -> list[Drawing]:
        svg = self.draw_map()
        if svg is None:
            return []
        lengths = [
            f"{t.name}: {t.metres:.1f} m in {t.seconds:.1f} s, at most {t.farthest:.1f} m from its start"
            for t in self.trajectories
        ]
        fixes = [f"{each.usable} fixes of {each.sensor}" for each in self.fixes]
        north = (
            "North is up."
            if self.north or not self.trajectories
            else "x of the world to the right, y up; north is not known."
        )
        middle = self.middle_text()
        caption = f"{north} Circle: start; square: end; dots: satellite fixes.{f' Middle: {middle}.' if middle else ''}"
        return [Drawing("The drive from above", "; ".join([*lengths, *fixes]), svg, caption, "map")]

    def draw_map(self) -> bytes | None:
        """Draw trajectories and fixes as a map, with north up where it is known; None where there are none."""
        rotation, shift = self._north_up()
        lines = [
            (t.name, drawable([(c.x, c.y) for c in t.corners]) @ rotation.T) for t in self.trajectories if t.corners
        ]
        fixes = [(f"fixes of {each.sensor}", self._fixes(each, shift)) for each in self.fixes]
        if self.north is None and lines:
            fixes = []
        if not lines and not fixes:
            return None
        names = ("east [m]", "north [m]") if self._is_north_up else ("x [m]", "y [m]")

        def draw(axes: Any) -> None:
            for k, (name, dots) in enumerate(fixes, start=len(lines)):
                axes.plot(*dots.T, ".", markersize=3, color=colour_at(k), label=short(name))
            for k, (name, line) in enumerate(lines):
                axes.plot(*line.T, color=colour_at(k), label=short(name))
                axes.plot(*line[0], "o", color=colour_at(k), markerfacecolor="white")
                axes.plot(*line[-1], "s", color=colour_at(k))
            axes.set_aspect("equal", adjustable="datalim")
            axes.set(xlabel=names[0], ylabel=names[1])
            axes.legend(loc="best")

        return draw_svg((WIDE_INCHES, 5.5), draw)

    def middle_text(self) -> str:
        """Latitude and longitude of the middle of the map; "" where they are not known."""
        if self.origin_lla is None or not self._is_north_up:
            return ""
        rotation, shift = self._north_up()
        lines = [np.array([(c.x, c.y) for c in t.corners]).reshape(-1, 2) @ rotation.T for t in self.trajectories]
        positions = np.concatenate([*lines, *(self._fixes(each, shift) for each in self.fixes)])
        east, north = (positions.min(axis=0) + positions.max(axis=0)) / 2 - shift
        latitude, longitude, _ = geodetic_from_enu(np.array([[east, north, 0.0]]), np.array(self.origin_lla))[0]
        return f"{_degrees(latitude, 'NS')}, {_degrees(longitude, 'EW')}"

    @property
    def _is_north_up(self) -> bool:
        """Whether the map shows east and north, and not x and y of the world."""
        return self.north is not None or (bool(self.fixes) and not self.trajectories)

    def _north_up(self) -> tuple[Float64Array, Float64Array]:
        """The rotation (2, 2) of the world that brings north up, and where the fixes' origin lies then (2,) [m]."""
        if self.north is None:
            return np.eye(2), np.zeros(2)
        angle = np.pi / 2 - np.radians(self.north.direction_deg)
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return rotation, rotation @ np.array(self.north.shift[:2])

    def _fixes(self, fixes: Fixes, shift: Float64Array) -> Float64Array:
        positions = drawable([(location[1], location[2]) for location in fixes.locations])
        return positions if self.north is None else positions + shift

    def _over_time(self) -> list[Drawing]:
        lines = [trajectory.corners for trajectory in self.trajectories if len(trajectory.corners) > 1]
        if not lines:
            return []
        speeds = [[(corner.seconds, corner.speed) for corner in line] for line in lines]
        heights = [[(corner.seconds, corner.z) for corner in line] for line in lines]
        first = self.trajectories[0]
        caption = "" if len(lines) < 2 else "Colours as on the map."
        speed = f"{first.name}: {first.mean_speed:.1f} m/s on the average, {first.top_speed:.1f} m/s at the top"
        height = f"{first.name}: from {first.lowest:.1f} to {first.highest:.1f} m"
        speed_plot = line_plot(speeds, x_name="time [s]", y_name="speed [m/s]", with_zero=True)
        height_plot = line_plot(heights, x_name="time [s]", y_name="height z [m]")
        return [Drawing("Speed", speed, speed_plot, caption), Drawing("Height", height, height_plot, caption)]

    def _north_notes(self) -> list[str]:
        if self.north is None or self.north.rms is None:
            return []
        note = (
            f"North is {self.north.direction_deg:.1f}° counter-clockwise from x of the world: the fixes were aligned "
            f"with “{self.north.trajectory}” by a translation and a rotation, and lie {self.north.rms:.2f} m from it "
            "(RMS)."
        )
        return [note]


def _degrees(value: float, letters: str) -> str:
    """Latitude or longitude to a metre: "49.01126° N"."""
    return f"{abs(value):.5f}° {letters[0] if value >= 0 else letters[1]}"


def _position_text(lla: tuple[float, float, float]) -> str:
    """Latitude and longitude."""
    text = f"{_degrees(lla[0], 'NS')}, {_degrees(lla[1], 'EW')}"
    return text.replace(" ", "\N{NO-BREAK SPACE}")


_TRAJECTORY_COLUMNS = (
    text_column("Trajectory", lambda t: f"{t.name} (found now)" if t.found_now else t.name),
    Column("Poses", lambda t: count(t.poses)),
    Column("Seconds", lambda t: fixed(t.seconds, 2)),
    Column("Length [m]", lambda t: fixed(t.metres, 1)),
    Column("Mean speed [m/s]", lambda t: fixed(t.mean_speed, 2)),
    Column("Top speed [m/s]", lambda t: fixed(t.top_speed, 2)),
    Column("Stationary", lambda t: percent(t.stationary_share, 0)),
    Column("Rotated [deg]", lambda t: fixed(t.rotated_deg, 0)),
    Column("Heights [m]", lambda t: f"{fixed(t.lowest, 1)} to {fixed(t.highest, 1)}"),
    Column("Up / down [m]", lambda t: f"{t.climb:.1f} / {t.descent:.1f}"),
)

_FIX_COLUMNS = (
    text_column("Receiver", lambda f: f.sensor),
    Column("Fixes", lambda f: f"{f.count:,}" if f.usable == f.count else f"{f.usable:,} usable of {f.count:,}"),
    text_column("First", lambda f: _position_text(f.first_lla)),
    text_column("Last", lambda f: _position_text(f.last_lla)),
    Column("Height, first and last [m]", lambda f: f"{f.first_lla[2]:.1f} / {f.last_lla[2]:.1f}"),
    Column(
        "Accuracy, median and worst [m]",
        lambda f: NOTHING if f.accuracy_m is None else f"{f.accuracy_m:.2f} / {f.worst_accuracy_m:.2f}",
    ),
)


def _trajectories(scene: Scene) -> list[Trajectory]:
    """The trajectories of a scene, else the first trajectory that a sensor's poses report."""
    if scene.trajectories:
        return list(scene.trajectories.values())
    for sensor in scene.sensors:
        path: Poses | None = getattr(sensor, "poses", None)
        in_world = getattr(sensor, "coordinates", Coordinates.WORLD) is Coordinates.WORLD
        if path is not None and in_world and not path.static:
            name = f"poses of {sensor.id}"
            return [Trajectory(name, path.timestamps_ns, path.positions, path.quaternions_xyzw)]
    return []


def _trajectory(trajectory: Trajectory, start_ns: int, *, found_now: bool) -> TrajectoryMetrics:
    rows = np.isfinite(trajectory.positions).all(axis=1)
    times = (trajectory.timestamps_ns[rows] - start_ns) / 1e9
    locations = trajectory.positions[rows] if rows.any() else np.zeros((1, 3))
    times = times if len(times) else np.zeros(1)
    steps = np.linalg.norm(np.diff(locations, axis=0), axis=1)
    grid = np.unique(np.linspace(times[0], times[-1], min(max(len(times), 2), MOST_CORNERS)))
    speeds = _speeds(times, locations, grid)
    at = np.column_stack([np.interp(grid, times, locations[:, axis]) for axis in range(3)])
    climbs = _climbs(at[:, 2])
    quaternions = trajectory.quaternions_xyzw
    return TrajectoryMetrics(
        name=trajectory.name,
        found_now=found_now,
        poses=len(trajectory.timestamps_ns),
        seconds=float(times[-1] - times[0]),
        metres=float(steps.sum()),
        oriented=quaternions is not None,
        start=float(times[0]),
        stop=float(times[-1]),
        farthest=float(np.linalg.norm(locations - locations[0], axis=1).max()),
        lowest=float(locations[:, 2].min()),
        highest=float(locations[:, 2].max()),
        climb=climbs[0],
        descent=climbs[1],
        mean_speed=float(steps.sum() / max(times[-1] - times[0], 1e-9)) if len(times) > 1 else 0.0,
        top_speed=float(np.percentile(speeds, 99)),
        stationary_share=float((speeds < _STANDS).mean()),
        rotated_deg=None if quaternions is None else _rotated(quaternions[rows]),
        corners=tuple(
            Corner(seconds=round(s, 4), x=round(x, 3), y=round(y, 3), z=round(z, 3), speed=round(v, 3))
            for s, (x, y, z), v in zip(grid.tolist(), at.tolist(), speeds.tolist(), strict=True)
        ),
    )


def _speeds(times: Float64Array, locations: Float64Array, grid: Float64Array) -> Float64Array:
    """Speeds [m/s] at times of a grid, each over a window of its own."""
    if len(times) < 2:
        return np.zeros(len(grid))
    half = max(_HALF_WINDOW, float(np.median(np.diff(times))))
    before, after = np.maximum(grid - half, times[0]), np.minimum(grid + half, times[-1])
    moved = np.column_stack(
        [np.interp(after, times, locations[:, k]) - np.interp(before, times, locations[:, k]) for k in range(3)]
    )
    speeds: Float64Array = np.linalg.norm(moved, axis=1) / np.maximum(after - before, 1e-9)
    return speeds


def _climbs(heights: Float64Array) -> tuple[float, float]:
    """How much a trajectory climbs and descends [m]; up and down within 5 cm is noise."""
    climb = descent = 0.0
    held = float(heights[0])
    for height in heights.tolist():
        if abs(height - held) >= 0.05:
            climb, descent = climb + max(height - held, 0.0), descent + max(held - height, 0.0)
            held = height
    return climb, descent


def _rotated(quaternions_xyzw: Float64Array) -> float:
    """Changes of the heading of the body's most level axis, added up [deg]; steps below 0.05 degrees are noise."""
    matrices = matrix_from_quaternion(quaternions_xyzw)
    axis = int(np.argmin(np.abs(matrices[:, 2]).mean(axis=0)))
    headings = np.unwrap(np.arctan2(matrices[:, 1, axis], matrices[:, 0, axis]))
    thinned = headings[spread_rows(len(headings), MOST_CORNERS, nearest=False)]
    rotations = np.degrees(np.abs(np.diff(thinned)))
    return float(rotations[rotations > 0.05].sum())


def _fixes(receiver: GnssSensor, origin_lla: Float64Array, start_ns: int) -> Fixes:
    rows, lla = usable_positions(receiver)
    shown = spread_rows(len(rows), MOST_CORNERS, nearest=False)
    enu = enu_from_geodetic(lla[shown], origin_lla)
    seconds = (receiver.timestamps_ns[rows[shown]] - start_ns) / 1e9
    stated = receiver.accuracies[rows]
    stated = stated[np.isfinite(stated)]
    return Fixes(
        sensor=receiver.id,
        count=len(receiver.timestamps_ns),
        usable=len(rows),
        first_lla=_three(lla[0]),
        last_lla=_three(lla[-1]),
        south=float(lla[:, 0].min()),
        west=float(lla[:, 1].min()),
        north=float(lla[:, 0].max()),
        east=float(lla[:, 1].max()),
        accuracy_m=float(np.median(stated)) if len(stated) else None,
        worst_accuracy_m=float(stated.max()) if len(stated) else None,
        locations=tuple(
            (round(s, 4), *(round(value, 3) for value in location))
            for s, location in zip(seconds.tolist(), enu.tolist(), strict=True)
        ),
    )


def _three(values: Float64Array | Int64Array) -> tuple[float, float, float]:
    a, b, c = (float(value) for value in values)
    return a, b, c


def _north(trajectory: Trajectory, receiver: GnssSensor, origin_lla: Float64Array) -> North | None:
    """Lay fixes onto the trajectory by a shift and a rotation about the upright axis; None: that leaves north open."""
    rows, locations = usable_positions(receiver)
    enu = enu_from_geodetic(locations, origin_lla)
    times, first = np.unique(receiver.timestamps_ns[rows], return_index=True)
    if len(times) < 3 or np.linalg.norm(enu - enu[0], axis=1).max() < _LEAST_LENGTH:
        return None
    try:
        reported = evaluate_trajectory(Trajectory("fixes", times, enu[first]), trajectory, align="yaw", rpe_deltas=())
    except (PoseError, OptionError, ArrayError):
        return None
    x, y = matrix_from_quaternion(np.array([reported.alignment.quaternion_xyzw]))[0][:2, 1]
    return North(
        direction_deg=float(np.degrees(np.arctan2(y, x))),
        shift=reported.alignment.translation,
        rms=reported.absolute.horizontal.rms,
        trajectory=trajectory.name,
    )


_TRUTH = "groundTruth"  # the name of trajectories that are taken for the truth


class Metrics(msgspec.Struct, frozen=True, kw_only=True):
    """Comparisons with the truth.

    Attributes:
        trajectories: one per trajectory that was compared with a reference.
        tracks: objects of the drive against those of the truth; None if one of them has none.
        skipped: what could not be compared, and why.
    """

    trajectories: tuple[TrajectoryReport, ...] = ()
    tracks: TrackingReport | None = None
    skipped: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, scene: Scene, *, source: Path | str | None, truth: Path | str | None, compare: tuple[str, ...] = ()
    ) -> "Metrics":
        """Compare the trajectories of a scene with its true one, and with a truth that lies elsewhere.

        Args:
            source: the drive's path, to be compared with `truth`; None if it is in memory only.
            truth: a trajectory, or a scene or KITTI's text with the true objects and trajectory; None for none.
            compare: trajectories to be estimated and compared, too: "lidar", "gnss".

        Raises:
            DataError: neither the drive's trajectory nor its objects can be compared with `truth`, or one of `compare`
                cannot be estimated or compared.
        """
        collected = _Comparisons()
        true_trajectory = scene.trajectories.get(_TRUTH)
        reference = next(iter(scene.trajectories.values()), None) if true_trajectory is None else true_trajectory
        if true_trajectory is not None:
            for name, trajectory in scene.trajectories.items():
                if name != _TRUTH and not same_direction(trajectory, true_trajectory):
                    collected.compare(trajectory, true_trajectory)
        for name in compare:
            collected.find_and_compare(scene, name, reference)
        if truth is not None:
            collected.against(scene, source, truth)
        return cls(
            trajectories=tuple(collected.trajectories), tracks=collected.tracks, skipped=tuple(collected.skipped)
        )

    def section(self, missing: str | None) -> Section | None:
        """Errors of trajectories and metrics of tracks; None where nothing was compared."""
        if not self.trajectories and self.tracks is None and not self.skipped and missing is None:
            return None
        errors = Table(
            "Trajectories against their reference, aligned by translation and rotation",
            _ERROR_COLUMNS,
            self.trajectories,
        )
        warnings = [warning for report in self.trajectories for warning in report.warnings]
        notes = [counted(w.count, w.kind, w.location, w.message) for w in warnings]
        return Section(
            key="truth",
            name="Against the truth",
            missing=missing,
            blocks=[
                Block(tables=[errors]),
                Block(tables=[] if self.tracks is None else [_track_table(self.tracks)]),
                Block(list_title=f"Notes: {len(notes)}", listed=notes),
                Block(list_title=f"Could not be compared: {len(self.skipped)}", listed=self.skipped),
            ],
        )


_ERROR_COLUMNS = (
    text_column("Trajectory", lambda report: report.estimate),
    text_column("Against", lambda report: report.reference),
    Column("Pairs", lambda report: count(report.pairs)),
    Column("Covered", lambda report: percent(report.coverage, 0)),
    Column(
        "Position error, rms / largest [m]",
        lambda report: f"{report.absolute.translation.rms:.3f} / {report.absolute.translation.max:.3f}",
    ),
    Column(
        "Horizontal / vertical rms [m]",
        lambda report: f"{report.absolute.horizontal.rms:.3f} / {report.absolute.vertical.rms:.3f}",
    ),
    Column(
        "Rotation error, rms [deg]",
        lambda report: NOTHING if report.absolute.rotation_deg is None else fixed(report.absolute.rotation_deg.rms, 3),
    ),
    Column(
        "Drift over 10 m [%]",
        lambda report: fixed(next((s.translation_percent for s in report.relative if s.delta == "10m"), None), 2),
    ),
    Column(
        "KITTI [%]",
        lambda report: NOTHING if report.kitti is None else fixed(report.kitti.overall.translation_percent, 2),
    ),
)


def _track_table(tracks: TrackingReport) -> Table:
    shares = ("hota.hota", "hota.deta", "hota.assa", "clear.mota", "identity.idf1")
    names = ("HOTA", "DetA", "AssA", "MOTA", "IDF1")

    def share(path: str) -> Any:
        group, field = path.split(".")
        return lambda row: f"{100 * getattr(getattr(row[1], group), field):.1f}"

    table_columns = (
        text_column("Class", lambda row: row[0]),
        *(Column(name, share(path)) for name, path in zip(names, shares, strict=True)),
        Column("Switches", lambda row: count(row[1].clear.idsw)),
        Column("True objects", lambda row: count(row[1].true_objects)),
        Column("Found objects", lambda row: count(row[1].found_objects)),
    )
    rows = [(label, numbers.combined) for label, numbers in tracks.classes.items()]
    return Table(f"Objects against {tracks.truth}, by boxes of the kind {tracks.similarity} [%]", table_columns, rows)


class _Comparisons:
    """The comparisons so far; what cannot be compared is noted, and raised only if it was asked for by name."""

    def __init__(self) -> None:
        self.trajectories: list[TrajectoryReport] = []
        self.tracks: TrackingReport | None = None
        self.skipped: list[str] = []

    def compare(self, estimate: Trajectory, reference: Trajectory | Path | str) -> None:
        try:
            self.trajectories.append(evaluate_trajectory(estimate, reference))
        except SceneloomError as error:
            self.skipped.append(f"{estimate.name}: {error}")

    def find_and_compare(self, scene: Scene, name: str, reference: Trajectory | None) -> None:
        try:
            if reference is None:
                raise DataError(scene.source, "", "the drive has no trajectory to be compared with")
            path = find_ego_motion(scene, name=name).path
            found = Trajectory(name, path.timestamps_ns, path.positions, path.quaternions_xyzw)
            self.trajectories.append(evaluate_trajectory(found, reference))
        except SceneloomError as error:
            problem = f"nothing can be compared with what is found from {name}: {getattr(error, 'problem', error)}"
            raise DataError(scene.source, "", f"{problem}; leave `--compare {name}` out") from error

    def against(self, scene: Scene, source: Path | str | None, truth: Path | str) -> None:
        """Compare the drive's trajectory and its objects with a truth that may have only one of both."""
        refused: list[str] = []
        before = len(self.trajectories)
        if scene.trajectories:
            reported = len(self.skipped)
            self.compare(next(iter(scene.trajectories.values())), truth)
            refused += self.skipped[reported:]
            del self.skipped[reported:]
        if source is not None:
            try:
                self.tracks = compare_tracks(source, truth)
            except SceneloomError as error:
                refused.append(f"objects: {error}")
        if self.tracks is None and len(self.trajectories) == before:
            reasons = "; ".join(refused) or "the drive has neither a trajectory nor objects"
            raise DataError(
                truth,
                "",
                f"cannot be compared with the drive: {reasons}. Expected a trajectory whose times overlap with the "
                "drive's, or objects of the same frames; name such a file, or leave `--truth` out",
            )
