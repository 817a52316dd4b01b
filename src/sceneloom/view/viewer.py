"""Views saved to a file, shown in Rerun's window, or served to a browser on this machine."""

import http.client
import importlib.util
import os
import platform
import socket
import subprocess
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, partial
from heapq import merge
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import MappingProxyType
from typing import Any
from urllib.parse import quote

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError, MissingExtraError, OptionError, OutputError, how_to_install
from sceneloom.formats.base.output import check_output, replacing
from sceneloom.formats.base.registry import SharedOptions, open_scene
from sceneloom.geometry.rigid import conjugate_quaternion, rotate_vectors
from sceneloom.scene.annotations import EventAnnotation, PlainAnnotation
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, PlainSensor
from sceneloom.scene.scene import Scene, time_span
from sceneloom.scene.time_range import cut_scene
from sceneloom.scene.types import Identifier, Key, Progress, key_of
from sceneloom.view.annotations import ATTRIBUTES, EVENTS, LIST, RELATIONS, AnnotationView
from sceneloom.view.images import DEPTH, IMAGE, camera_feed, fused_depth_feed, with_straight_camera_models
from sceneloom.view.motion import EARTH, EGO, GNSS, IMU, MAP, show_motion
from sceneloom.view.objects import detection_feeds, track_feed
from sceneloom.view.points import SENSORS, WORLD, LidarView, RadarView, show_map
from sceneloom.view.poses import Locations
from sceneloom.view.settings import DrivePart, DriveShown, Source, ViewReport, ViewSettings
from sceneloom.view.stream import TIME, Feed, Stream, escaped, sdk
from sceneloom.warnings import DataWarning, Finding, Severity, WarningKind

_NOTES = "notes"

_LEVELS: Mapping[str, str] = MappingProxyType(
    {
        WarningKind.ASSUMED: "INFO",
        WarningKind.REPAIRED: "INFO",
        WarningKind.SKIPPED: "WARN",
        Severity.ERROR: "ERROR",
        Severity.WARNING: "WARN",
        Severity.HINT: "INFO",
    }
)


@dataclass(slots=True)
class _Reported:
    """Gathers what could not be shown, counted by code and location."""

    lines: dict[tuple[str, str], tuple[str, int]] = field(default_factory=dict)

    def __call__(self, code: str, location: str, message: str) -> None:
        """Take one more."""
        first, count = self.lines.get((code, location), (message, 0))
        self.lines[code, location] = first, count + 1

    @property
    def warnings(self) -> tuple[DataWarning, ...]:
        """All of it."""
        return tuple(
            DataWarning(
                kind=WarningKind.REPAIRED if code == "straightened" else WarningKind.SKIPPED,
                code=code,
                location=location,
                message=message,
                count=count,
            )
            for (code, location), (message, count) in self.lines.items()
        )


def _findings(scene: Scene) -> tuple[Finding, ...]:
    """What the rules of `validate` that need no frames report."""
    from sceneloom.checks.validation import validate

    return validate(scene, frames=False).findings


def _log_notes(stream: Stream, time_ns: int, warnings: Sequence[DataWarning], findings: Sequence[Finding]) -> None:
    """Log them at a time, the worst first; warnings that a finding reports already are not repeated."""
    reported = {finding.message for finding in findings}
    order = {level: k for k, level in enumerate(("ERROR", "WARN", "INFO"))}
    lines = [(_LEVELS[one.severity], f"{one.path}: {one.message}; {one.remedy} [{one.rule}]") for one in findings]
    lines += [
        (
            _LEVELS[one.kind],
            f"{one.kind}: {one.location}: {one.message}" + (f" ({one.count} times)" if one.count > 1 else ""),
        )
        for one in warnings
        if one.message not in reported
    ]
    for level, text in sorted(lines, key=lambda line: order[line[0]]):
        stream.log(time_ns, stream.path(_NOTES), sdk().TextLog(text, level=level), kind="notes")


_BEHIND, _ABOVE, _AHEAD = 14.0, 7.0, 8.0  # where the eye stands behind the ego, and where it looks [m]
_MOVED = 2.0  # how far the ego must have moved before its trajectory tells where forward is [m]
_IN_IMAGES = ("annotations", "tracks/boxes", "tracks/history")
"""What has a location in the world and is shown through the camera models, too."""
_BACKGROUND = (16, 18, 22)


def _eye(locations: Locations) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Behind and above the ego, looking where it goes; seen from the ego, whose axes may point anywhere."""
    forward, up = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    path = locations.path
    if path is not None:
        back = conjugate_quaternion(path.quaternions_xyzw[:1])
        up = rotate_vectors(back, up[None])[0]
        steps = np.linalg.norm(path.positions - path.positions[0], axis=1)
        trajectory = path.positions[int(np.argmax(steps > _MOVED))] - path.positions[0]
        if steps.max() > _MOVED:
            forward = rotate_vectors(back, trajectory[None])[0]
        forward = forward - (forward @ up) * up
        length = float(np.linalg.norm(forward))
        forward = forward / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    eye = _ABOVE * up - _BEHIND * forward
    return tuple(eye.tolist()), tuple((_AHEAD * forward).tolist())


@cache
def _blueprint_sdk() -> Any:
    """Import `rerun.blueprint`, of which layouts are made."""
    sdk()
    import rerun.blueprint

    return rerun.blueprint


def _layout_of(view: "DriveView") -> Any:
    """The layout of one drive: its world, tabs of what has no location, and the images of its cameras."""
    rrb, scene, root = _blueprint_sdk(), view.scene, f"/{escaped(view.name)}"
    world_path, follows = f"{root}/{WORLD}", view.locations.path is not None
    eye, target = _eye(view.locations)

    def world(name: str, *, following: bool) -> Any:
        """The world with the eye behind the ego; of a drive that moves also whole, the eye where the viewer puts it."""
        controls = {"position": eye, "look_target": target} if following or not follows else {}
        return rrb.Spatial3DView(
            origin=f"{world_path}/{EGO}" if following else world_path,
            contents=f"+ {world_path}/**",
            name=name,
            background=_BACKGROUND,
            line_grid=not following,
            eye_controls=rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, **controls),
        )

    def camera(camera_id: Identifier) -> Any:
        """The images of a camera with what is drawn into them and what its model sees of the world; fused depths."""
        path = f"{world_path}/{SENSORS}/{escaped(camera_id)}/{IMAGE}"
        through = [f"+ {world_path}/{name}/**" for name in _IN_IMAGES]
        contents = ["+ $origin/**", f"- $origin/{DEPTH}/**", *through]
        images = rrb.Spatial2DView(origin=path, contents=contents, name=str(camera_id))
        if view.settings.depth is None:
            return images
        depths = rrb.Spatial2DView(origin=path, contents=[f"+ $origin/{DEPTH}/**"], name=f"{camera_id}: depth")
        return rrb.Tabs(images, depths, active_tab=0, name=str(camera_id))

    worlds = [world("world", following=follows)]
    if follows:
        worlds.append(world("from afar", following=False))
    top = rrb.Tabs(*worlds, active_tab=0) if len(worlds) > 1 else worlds[0]
    left = rrb.Vertical(top, rrb.Tabs(*_tabs(view, root), active_tab=0), row_shares=[3, 1])
    images = [camera(sensor.id) for sensor in scene.sensors if isinstance(sensor, CameraSensor | DepthCameraSensor)]
    if not images:
        return rrb.Horizontal(left, name=view.name)
    side = rrb.Grid(*images, grid_columns=1 if len(images) <= 3 else 2) if len(images) > 1 else images[0]
    return rrb.Horizontal(left, side, column_shares=[3, 2], name=view.name)


def _tabs(view: "DriveView", root: str) -> list[Any]:
    """What has no location in the world, as far as the drive has it."""
    rrb, scene, annotations = _blueprint_sdk(), view.scene, view.scene.annotations
    gnss = any(isinstance(sensor, GnssSensor) and len(sensor.timestamps_ns) for sensor in scene.sensors)
    views = [rrb.TextLogView(origin=root, contents=[f"+ {root}/{_NOTES}", f"+ {root}/{EVENTS}/**"], name="log")]
    if gnss:
        views.append(rrb.TimeSeriesView(origin=f"{root}/{GNSS}", name="satellite fixes"))
    for sensor in scene.sensors:
        if isinstance(sensor, ImuSensor) and sensor.streams:
            base = f"{root}/{IMU}/{escaped(sensor.id)}"
            plots = [rrb.TimeSeriesView(origin=f"{base}/{escaped(name)}", name=name) for name in sensor.streams]
            views.append(rrb.Horizontal(*plots, name=str(sensor.id)))
    if gnss or view.locations.path is not None:
        views.append(rrb.Spatial2DView(origin=f"{root}/{MAP}", name="map [m]", background=_BACKGROUND))
    if gnss and view.settings.map_tiles:
        views.append(rrb.MapView(origin=f"{root}/{EARTH}", name="map", background=rrb.MapProvider.OpenStreetMap))
    if any(isinstance(one, EventAnnotation) for one in annotations):
        views.append(rrb.StateTimelineView(origin=f"{root}/{EVENTS}", name="events"))
    if any(one.is_timed and one.values for one in scene.attributes):
        views.append(rrb.TimeSeriesView(origin=f"{root}/{ATTRIBUTES}", name="attributes"))
        views.append(rrb.StateTimelineView(origin=f"{root}/{ATTRIBUTES}", name="attributes in words"))
    if annotations or any(not one.is_timed for one in scene.attributes):
        views.append(rrb.TextDocumentView(origin=f"{root}/{LIST}", name="annotations"))
    if any(one.parent_id is not None or one.type in {"link", "group", "object"} for one in annotations):
        views.append(rrb.GraphView(origin=f"{root}/{RELATIONS}", name="relations"))
    return views


_READ_BY_THREADS = frozenset({"recording", "sfs"})
"""Formats in which each camera has a reader of its own, so that several may be read at once."""


@dataclass(frozen=True, slots=True, eq=False)
class DriveView:
    """A drive before it is logged.

    Attributes:
        scene: the shown part of it, camera models made straight.
        measured: the same with its own camera models.
        reference_ns: (N,) int64 [ns], by which frames of the drive are counted.
        bent: cameras whose images hang nowhere.
        reported: what could not be shown.
    """

    name: str
    scene: Scene
    measured: Scene
    reference_ns: Int64Array
    locations: Locations
    bent: frozenset[Key]
    settings: ViewSettings
    reported: _Reported

    @classmethod
    def of(cls, scene: Scene, name: str, settings: ViewSettings, *, progress: Progress | None = None) -> "DriveView":
        """Choose what of a scene is shown, and find where its sensors are.

        Raises:
            OptionError: a sensor or trajectory is not there, or no frame lies in the part.
            PoseError: the named trajectory cannot be used.
        """
        reported = _Reported()
        scene = scene.corrected()
        chosen = scene
        if settings.sensors is not None:
            ids = {str(sensor.id): sensor.id for sensor in scene.sensors}
            keys = {key_of(scene.sensor(ids.get(str(stated), stated)).id) for stated in settings.sensors}
            chosen = replace(scene, sensors=tuple(one for one in scene.sensors if key_of(one.id) in keys))
        part = cut_scene(chosen, start=settings.start, stop=settings.stop)
        straight, bent = with_straight_camera_models(part, reported)
        locations = Locations.of(straight, trajectory=settings.trajectory, heading=settings.heading, progress=progress)
        return cls(name, straight, part, _reference_ns(scene), locations, bent, settings, reported)

    @staticmethod
    def layout(views: "Sequence[DriveView]") -> Any:
        """The layout of one drive, or of several, each under a tab of its own, with all worlds over each other."""
        rrb, parts = _blueprint_sdk(), [_layout_of(view) for view in views]
        content = parts[0]
        if len(parts) > 1:
            worlds = [f"+ /{escaped(view.name)}/{WORLD}/**" for view in views]
            together = rrb.Spatial3DView(origin="/", contents=worlds, name="together")
            content = rrb.Tabs(*parts, together, active_tab=0)
        return rrb.Blueprint(
            content,
            rrb.BlueprintPanel(state="expanded"),
            rrb.SelectionPanel(state="collapsed"),
            rrb.TimePanel(state="collapsed", timeline=TIME),
            auto_layout=False,
            auto_views=False,
        )

    def log(self, recording: Any, *, calendar: bool, progress: Progress | None = None) -> DriveShown:
        """Log the drive to an open stream of Rerun's, frame by frame.

        Args:
            calendar: whether times are shown as times of day, else as seconds.

        Raises:
            DataError: a frame cannot be read, and the reading is not lenient.
            OptionError: angles of cuboids have a unit or order that is not known.
        """
        scene, reported = self.scene, self.reported
        stream = Stream(recording, f"/{escaped(self.name)}", calendar, self.reference_ns)
        show_motion(stream, self.locations, scene)
        span_ns = time_span(scene) or (0, 0)
        findings = _findings(self.measured) if self.settings.findings else ()
        _log_notes(stream, span_ns[0], (*scene.warnings, *self.locations.warnings), findings)
        run = _Run(self, stream, AnnotationView.of(stream, self.locations, scene, reported))
        run.log_maps()
        feeds = run.feeds()
        total = sum(map(len, feeds))
        lenient = bool(self.settings.reading.get("lenient"))

        def passed_over(error: Exception) -> bool:
            """Whether to go on after a moment that cannot be read, and report it."""
            if not (lenient and isinstance(error, DataError)):
                return False
            reported("unreadable", error.location or error.file, error.problem)
            return True

        for done, _ in enumerate(_play(feeds, passed_over), start=1):
            if progress is not None:
                progress(done, total)
        run.annotations.finish()
        _log_notes(stream, span_ns[0], (*reported.warnings, *stream.warnings), ())
        return run.shown(span_ns, findings)


def _reference_ns(scene: Scene) -> Int64Array:
    """When the frames begin by which a drive is counted: the sweeps of the first lidar, else the first images."""
    for sensor in scene.lidars:
        if len(sensor.frames):
            return np.sort(sensor.frames.timestamps_ns)
    for camera in scene.cameras:
        if len(camera.images):
            return np.sort(camera.images.timestamps_ns)
    return np.zeros(0, np.int64)


@dataclass(slots=True, eq=False)
class _Run:
    """The logging of one drive."""

    view: DriveView
    stream: Stream
    annotations: AnnotationView
    lidars: list[LidarView] = field(default_factory=list)

    def feeds(self) -> list[Feed]:
        """All that has a time, sensor by sensor."""
        scene, every = self.view.scene, self.view.settings.every
        feeds = [self._sweeps(lidar, first=lidar is scene.lidars[0]) for lidar in scene.lidars]
        for sensor in scene.sensors:
            if isinstance(sensor, RadarSensor):
                shown = RadarView(self.stream, self.view.locations, sensor, self.view.reported)
                feeds.append(_thinned(Feed(sensor.frames.timestamps_ns, shown.log), every))
            elif isinstance(sensor, CameraSensor | DepthCameraSensor):
                feeds += self._camera(sensor)
        return [*feeds, *self._accompanying()]

    def _sweeps(self, lidar: LidarSensor, *, first: bool) -> Feed:
        settings = self.view.settings
        shown = LidarView(
            self.stream, self.view.locations, lidar, settings.colour_by, settings.as_measured, self.view.reported
        )
        self.lidars.append(shown)

        def log(k: int, _: None) -> None:
            time_ns, positions = shown.log(k)
            if positions is not None:
                self.annotations.labelled.log(lidar.id, k, shown.path, time_ns, positions)
            if first:
                self.annotations.note(time_ns)

        return _thinned(Feed(lidar.frames.timestamps_ns, log), settings.every)

    def _camera(self, sensor: CameraSensor | DepthCameraSensor) -> list[Feed]:
        """Images, and at once all that is drawn into them, which is small."""
        view, every = self.view, self.view.settings.every
        if isinstance(sensor, CameraSensor):
            self.annotations.log_in_images(sensor.id, np.unique(sensor.images.timestamps_ns[::every]))
        feed = camera_feed(
            self.stream,
            view.locations,
            sensor,
            view.reported,
            every=every,
            has_pinhole=key_of(sensor.id) not in view.bent,
            ahead=view.scene.format in _READ_BY_THREADS,
        )
        if feed is None:
            return []
        log_image, times_ns = feed.log, feed.times_ns

        def log(k: int, prepared: Any) -> None:
            log_image(k, prepared)
            self.annotations.note(int(times_ns[k]))

        counts_moments = not view.scene.lidars and sensor is next(iter(view.scene.cameras), None)
        return [_thinned(replace(feed, log=log) if counts_moments else feed, every)]

    def _accompanying(self) -> list[Feed]:
        """What files beside the drive hold."""
        view, settings, origin = self.view, self.view.settings, self.view.locations.origin_world
        feeds: list[Feed] = []
        if settings.detections is not None:
            feeds += detection_feeds(self.stream, settings.detections, origin)
        if settings.tracks is not None:
            feeds.append(track_feed(self.stream, settings.tracks, view.scene, origin))
        if settings.depth is not None:
            feeds.append(fused_depth_feed(self.stream, settings.depth, view.measured, view.scene))
        span_ns = time_span(view.scene)
        if span_ns is None:
            return feeds
        first, last = span_ns  # the moments that lie in the shown part of the drive
        return [_chosen(one, np.flatnonzero((one.times_ns >= first) & (one.times_ns <= last))) for one in feeds]

    def log_maps(self) -> None:
        """Log clouds without time, and report what cannot be shown."""
        view, stream, scene = self.view, self.stream, self.view.scene
        for sensor in scene.sensors:
            if isinstance(sensor, PointsSensor):
                show_map(stream, view.locations, sensor)
                path = stream.path("world", "clouds", sensor.id)
                with np.errstate(over="ignore"):  # what overflows is left out
                    positions = (sensor.positions - view.locations.origin_world).astype(np.float32)
                self.annotations.labelled.log(sensor.id, None, path, None, positions)
        for kind, things in (("sensors", scene.sensors), ("annotations", scene.annotations)):
            for one in things:
                if isinstance(one, PlainSensor | PlainAnnotation):
                    problem = f"nothing is known of the type {one.type!r}"
                    view.reported("not-shown", f"{kind}[{one.id!r}]", problem)

    def shown(self, span_ns: tuple[int, int], findings: tuple[Finding, ...]) -> DriveShown:
        """What was logged."""
        view, stream = self.view, self.stream
        colours = {str(one.lidar.id): one.painter.used for one in self.lidars}
        wanted = view.settings.colour_by
        for sensor_id, used in colours.items():
            if wanted is not None and used is not None and used is not wanted:
                problem = f"its points have no {wanted}; they show {used}"
                view.reported("colours-missing", f"sensors[{sensor_id!r}]", problem)
        return DriveShown(
            source=view.scene.source,
            format=view.scene.format,
            root=stream.root,
            origin=tuple(view.locations.origin_world.tolist()),
            seconds=(span_ns[1] - span_ns[0]) / 1e9,
            colours={sensor_id: used.value for sensor_id, used in colours.items() if used is not None},
            logged=dict(sorted(stream.counts.items())),
            findings=dict(Counter(str(finding.severity) for finding in findings)),
            warnings=(*view.scene.warnings, *view.locations.warnings, *view.reported.warnings, *stream.warnings),
        )


_MOST_THREADS = 4


@dataclass(slots=True)
class _Ahead:
    """Prepares the next moment of a feed while others are logged."""

    feed: Feed
    pool: ThreadPoolExecutor
    coming: "Future[Any] | None" = None

    def begin(self, k: int) -> None:
        """Begin to prepare moment `k`, if there is one."""
        if self.feed.prepare is not None and k < len(self.feed):
            self.coming = self.pool.submit(self.feed.prepare, k)

    def log(self, k: int) -> None:
        """Log moment `k`, and begin to prepare the next one."""
        coming, self.coming = self.coming, None
        try:
            prepared = None if coming is None else coming.result()
        finally:
            self.begin(k + 1)
        self.feed.log(k, prepared)


def _play(feeds: Sequence[Feed], on_fault: Callable[[Exception], bool]) -> Iterator[None]:
    """Log the moments of all feeds in the order of time; `on_fault` says whether to go on after what went wrong."""
    threads = min(_MOST_THREADS, os.cpu_count() or 1)
    with ThreadPoolExecutor(threads, thread_name_prefix="sceneloom-view") as pool:
        ahead = [_Ahead(feed, pool) for feed in feeds]
        for one in ahead:
            one.begin(0)
        try:
            for _, order, k in merge(*(_keyed(order, feed) for order, feed in enumerate(feeds))):
                try:
                    ahead[order].log(k)
                except Exception as error:
                    if not on_fault(error):
                        raise
                yield
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _keyed(order: int, feed: Feed) -> Iterator[tuple[int, int, int]]:
    return ((time_ns, order, k) for k, time_ns in enumerate(feed.times_ns.tolist()))


def _thinned(feed: Feed, every: int) -> Feed:
    """Every Nth moment, in the order of time."""
    rows = np.arange(0, len(feed), every)
    return _chosen(feed, rows[np.argsort(feed.times_ns[rows], kind="stable")])


def _chosen(feed: Feed, rows: Int64Array) -> Feed:
    """Some moments of a feed: (M,) numbers of them."""
    numbers: list[int] = rows.tolist()
    prepare = feed.prepare
    return Feed(
        feed.times_ns[rows],
        lambda k, prepared: feed.log(numbers[k], prepared),
        None if prepare is None else lambda k: prepare(numbers[k]),
    )


_APPLICATION = "sceneloom"
_SUFFIX = ".rrd"
_SINCE_EPOCH_NS = 100_000_000_000_000_000
"""Timestamps from here on (March 1973) count from 1970; smaller ones from the beginning of the drive."""
_MOST_DRIVES = 32  # more tabs would be hard to find


@contextmanager
def _opened_drives(
    sources: Sequence[Source], settings: ViewSettings, *, progress: Progress | None = None
) -> Iterator[tuple[DriveView, ...]]:
    """Open drives, each under a root of its own name."""
    if not sources:
        raise OptionError("no drive to show; expected one or more paths")
    if len(sources) > _MOST_DRIVES:
        raise OptionError(
            f"{len(sources)} drives, or parts of drives; expected no more than {_MOST_DRIVES} at once: choose some, as "
            f"`sceneloom catalog query … --limit {_MOST_DRIVES}` does"
        )
    settings.check_drives(len(sources))
    parts = [source if isinstance(source, DrivePart) else DrivePart(source) for source in sources]
    shared = SharedOptions(settings.reading)
    with ExitStack() as stack:
        scenes = [
            part.source
            if isinstance(part.source, Scene)
            else stack.enter_context(shared.read(partial(_open, part.source, part.reading)))
            for part in parts
        ]
        shared.check()
        yield tuple(
            DriveView.of(scene, name, part.settings(settings), progress=progress)
            for scene, name, part in zip(scenes, _roots(parts), parts, strict=True)
        )


def _open(location: str | Path, own: Mapping[str, Any], **reading: Any) -> Scene:
    return open_scene(location, **{**reading, **own})


def _roots(parts: Sequence[DrivePart]) -> list[str]:
    """The names of drives, each once."""
    roots: list[str] = []
    for part in parts:
        taken = sum(root == part.name or root.startswith(f"{part.name} (") for root in roots)
        roots.append(f"{part.name} ({taken + 1})" if taken else part.name)
    return roots


def _new_recording(views: Sequence[DriveView]) -> Any:
    """A stream of Rerun's whose only times are those of the drives."""
    rr = sdk()
    name = ", ".join(view.name for view in views)
    recording = rr.RecordingStream(_APPLICATION, send_properties=False)
    rr.set_log_tick_enabled(False, recording=recording)
    rr.set_log_time_enabled(False, recording=recording)
    recording.send_recording_name(name)
    return recording


def _log_drives(
    views: Sequence[DriveView], recording: Any, *, progress: Progress | None = None
) -> tuple[DriveShown, ...]:
    """Log drives one after another to an open stream."""
    spans = [time_span(view.scene) for view in views]
    calendar = all(span is not None and span[0] >= _SINCE_EPOCH_NS for span in spans)
    return tuple(view.log(recording, calendar=calendar, progress=progress) for view in views)


def save_view(
    sources: Sequence[Source],
    output: str | Path,
    *,
    settings: ViewSettings | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> ViewReport:
    """Save drives with a layout of the viewer to a file that `rerun FILE` opens.

    Args:
        sources: paths of recordings, scenes, …, scenes that are open, or parts of either; each is under a root of its
            own.
        output: the file, which ends in `.rrd`.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        OptionError: an option cannot be followed.
        OutputError: the file exists or cannot be written.
        UnknownFormatError: no format fits a path.
        DataError: a frame cannot be read.
    """
    sdk()
    started, target = time.perf_counter(), Path(output)
    if target.suffix.lower() != _SUFFIX:
        raise OptionError(f"{target}: expected a name that ends in {_SUFFIX}")
    check_output(target, overwrite=overwrite)
    with (
        _opened_drives(sources, settings or ViewSettings(), progress=progress) as views,
        replacing(target, overwrite=overwrite) as draft,
    ):
        recording = _new_recording(views)
        recording.save(draft, default_blueprint=DriveView.layout(views))
        try:
            drives = _log_drives(views, recording, progress=progress)
            recording.flush()
        finally:
            recording.disconnect()
    return ViewReport(
        output=str(target), size_bytes=target.stat().st_size, drives=drives, seconds=time.perf_counter() - started
    )


_LOOPBACK = "127.0.0.1"  # nobody but this machine is answered
_TILES = "https://tile.openstreetmap.org https://*.tile.openstreetmap.org"
_PASSED_ON = ("Content-Type", "rerun-final-length")
_PIECE = 1 << 20
_ANSWER_SECONDS = 60.0


def policy(sink_port: int, *, map_tiles: bool) -> str:
    """What the page may fetch: itself, the data of this machine, and map tiles where they are wanted.

    Source: W3C "Content Security Policy Level 3".
    """
    connect = f"'self' http://{_LOOPBACK}:{sink_port} data: blob:" + (f" {_TILES}" if map_tiles else "")
    return "; ".join(
        (
            "default-src 'self'",
            "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:",
            "style-src 'self' 'unsafe-inline'",
            "img-src 'self' data: blob:",
            "worker-src 'self' blob:",
            f"connect-src {connect}",
            "frame-ancestors 'none'",
            "form-action 'none'",
        )
    )


def _handler(page_port: int, stated: str) -> type[BaseHTTPRequestHandler]:
    class Forwarding(BaseHTTPRequestHandler):
        """Passes requests on to Rerun's own server, and its answers back with the policy."""

        def do_GET(self) -> None:
            upstream = http.client.HTTPConnection(_LOOPBACK, page_port, timeout=_ANSWER_SECONDS)
            try:
                upstream.request("GET", self.path)
                answer = upstream.getresponse()
                self._pass_on(answer)
            except (OSError, http.client.HTTPException):
                self.close_connection = True
            finally:
                upstream.close()

        def _pass_on(self, answer: http.client.HTTPResponse) -> None:
            content = answer.read()
            self.send_response(answer.status)
            for name in _PASSED_ON:
                if (value := answer.getheader(name)) is not None:
                    self.send_header(name, value)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Content-Security-Policy", stated)
            self.send_header("Referrer-Policy", "no-referrer")
            self.end_headers()
            for start in range(0, len(content), _PIECE):
                self.wfile.write(content[start : start + _PIECE])

        def log_message(self, format: str, *arguments: object) -> None:
            """Report nothing: the library does not print."""

    return Forwarding


@contextmanager
def guarded_page(page_port: int, sink_port: int, *, map_tiles: bool = False) -> Iterator[int]:
    """Serve Rerun's page on this machine with the policy; gives the port.

    Args:
        page_port: where Rerun serves it.
        sink_port: where the page gets its data.
        map_tiles: let it fetch tiles of OpenStreetMap.
    """
    server = ThreadingHTTPServer((_LOOPBACK, 0), _handler(page_port, policy(sink_port, map_tiles=map_tiles)))
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield int(server.server_address[1])
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


_FOLDERS = ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME", "XDG_STATE_HOME")
"""Where programs of a desktop keep what they remember.

Source: XDG Base Directory Specification 0.8.
"""
_PROXIES = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY")
_NOBODY = "http://127.0.0.1:1"  # a proxy that is not there: what would go through it goes nowhere
_NEAR = "127.0.0.1,localhost"


def viewer_command(*options: str) -> list[str]:
    """The words that run Rerun's own program, which is installed with its SDK.

    The program itself and not the Python module that starts it: a program that is ended would leave its child behind.

    Raises:
        MissingExtraError: it is not installed.
    """
    sdk()
    found = importlib.util.find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise MissingExtraError(f"Rerun's viewer is missing: {how_to_install('view')}")
    name = "rerun.exe" if platform.system() == "Windows" else "rerun"
    return [str(Path(found.origin).with_name(name)), *options]


def silent_environment(folder: Path, given: Mapping[str, str] | None = None, *, offline: bool = True) -> dict[str, str]:
    """Give an environment in which Rerun's program sends no usage data and writes to `folder` only.

    The program sends none after its own command `analytics disable`, which it keeps in its folder of settings: that is
    a folder of ours here, so that nothing is written to the home folder, and what a person has set there stays as is.
    It would still ask for its newest version and for examples; that goes to a proxy that is not there.

    Args:
        folder: an empty folder that lives as long as the program.
        given: the environment to begin with; None for this process's.
        offline: let the program reach this machine only.
    """
    environment = {**(os.environ if given is None else given), **dict.fromkeys(_FOLDERS, str(folder))}
    if offline:
        # both spellings are in use, and the small one counts more
        for name in _PROXIES:
            environment |= {name: _NOBODY, name.lower(): _NOBODY}
        environment |= {"NO_PROXY": _NEAR, "no_proxy": _NEAR}
    if platform.system() == "Darwin":
        environment["HOME"] = str(folder)
    subprocess.run(  # noqa: S603 - our own words
        viewer_command("analytics", "disable"),
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=True,
    )
    return environment


_SERVER_MEMORY = "2GiB"  # what the browser's server holds for it; beyond that the earliest frames go
_PATIENCE = 30.0
_POLL = 0.05


@dataclass(frozen=True, slots=True)
class Viewer:
    """A viewer's program that runs.

    Attributes:
        sink: where it takes what is logged.
        address: where a browser finds it, or None of one with a window of its own.
    """

    process: "subprocess.Popen[bytes]"
    sink: str
    address: str | None


def has_screen(environment: Mapping[str, str] | None = None) -> bool:
    """Whether a window can be opened, as far as the environment reports."""
    if platform.system() in {"Darwin", "Windows"}:
        return True
    known = os.environ if environment is None else environment
    return bool(known.get("DISPLAY") or known.get("WAYLAND_DISPLAY"))


def show_view(
    sources: Sequence[Source],
    *,
    settings: ViewSettings | None = None,
    web: bool = False,
    ready: Callable[[Viewer], None] | None = None,
    progress: Progress | None = None,
) -> ViewReport:
    """Show drives in the viewer, and wait until it is closed.

    The viewer listens on this machine only, sends no usage data and writes nothing to the home folder.

    Args:
        sources: paths of recordings, scenes, …, scenes that are open, or parts of either; each is under a root of its
            own.
        web: in a browser instead of a window: until the program is interrupted.
        ready: reported when the viewer runs, before anything is logged.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        OptionError: an option cannot be followed, or there is no screen for a window.
        OutputError: the viewer does not start.
        UnknownFormatError: no format fits a path.
        DataError: a frame cannot be read.
    """
    sdk()
    if not web and not has_screen():
        raise OptionError(
            "there is no screen to open a window on; use `--save FILE.rrd` to keep the view in a file, or `--web` to "
            "look at it in a browser"
        )
    started = time.perf_counter()
    wanted = settings or ViewSettings()
    with (
        _opened_drives(sources, wanted, progress=progress) as views,
        _viewer(web=web, map_tiles=wanted.map_tiles) as viewer,
    ):
        if ready is not None:
            ready(viewer)
        recording = _new_recording(views)
        recording.connect_grpc(viewer.sink, default_blueprint=DriveView.layout(views))
        try:
            drives = _log_drives(views, recording, progress=progress)
            recording.flush()
        finally:
            recording.disconnect()
        report = ViewReport(output=None, size_bytes=0, drives=drives, seconds=time.perf_counter() - started)
        _wait(viewer)
    return report


def _wait(viewer: Viewer) -> None:
    """Wait until the window is closed, or the program interrupted: all has been shown by then."""
    try:
        viewer.process.wait()
    except KeyboardInterrupt:
        return


@contextmanager
def _viewer(*, web: bool, map_tiles: bool) -> Iterator[Viewer]:
    """Start Rerun's program, and end it in the end."""
    port, page = _free_ports()
    options = ["--bind", _LOOPBACK, "--port", str(port), "--hide-welcome-screen"]
    if web:
        options += ["--serve-web", "--web-viewer-port", str(page), "--server-memory-limit", _SERVER_MEMORY]
    else:
        options += ["--expect-data-soon"]
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="sceneloom-view-"))
        process = subprocess.Popen(  # noqa: S603 - our own words
            viewer_command(*options),
            env=silent_environment(Path(folder), offline=not map_tiles),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        stack.callback(_end, process)
        sink = f"rerun+http://{_LOOPBACK}:{port}/proxy"
        _await_port(process, port)
        if not web:
            yield Viewer(process, sink, None)
            return
        _await_port(process, page)
        guarded = stack.enter_context(guarded_page(page, port, map_tiles=map_tiles))
        query = f"url={quote(sink, safe=':/')}&hide_welcome_screen=1"
        yield Viewer(process, sink, f"http://{_LOOPBACK}:{guarded}/?{query}")


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.terminate()
    try:
        process.wait(timeout=5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _free_ports() -> tuple[int, int]:
    """Two ports of this machine that nobody listens on."""
    with socket.create_server((_LOOPBACK, 0)) as one, socket.create_server((_LOOPBACK, 0)) as other:
        return one.getsockname()[1], other.getsockname()[1]


def _await_port(process: "subprocess.Popen[bytes]", port: int) -> None:
    """Wait until the program listens."""
    deadline = time.monotonic() + _PATIENCE
    while process.poll() is None and time.monotonic() < deadline:
        try:
            socket.create_connection((_LOOPBACK, port), timeout=1.0).close()
        except OSError:
            time.sleep(_POLL)
        else:
            return
    reported = "ended at once" if process.poll() is not None else f"did not listen within {_PATIENCE:.0f} s"
    raise OutputError(
        f"Rerun's viewer {reported}; look at `{' '.join(viewer_command('--version'))}`, or state `--save`"
    )
