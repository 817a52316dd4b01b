"""One drive, ready to be logged: what there is of it, in the order of time."""

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError, OptionError
from sceneloom.scene.annotations.plain import PlainAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.findings import Finding
from sceneloom.scene.part import cut_scene
from sceneloom.scene.plain import PlainSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import time_span
from sceneloom.scene.types import Identifier, Key, Progress, key_of
from sceneloom.view.annotations.corrections import show_corrections
from sceneloom.view.annotations.layers import AnnotationLayers, annotation_layers
from sceneloom.view.annotations.points import LabelledPoints
from sceneloom.view.annotations.relations import show_graph
from sceneloom.view.annotations.states import list_annotations, show_attributes, show_events
from sceneloom.view.clouds import LidarView, RadarView, lidar_view, show_map
from sceneloom.view.depths import depth_feed, fused_depth_feed
from sceneloom.view.feeds import Feed, play
from sceneloom.view.found_files import read_detections, read_tracks
from sceneloom.view.images import CameraView, PlacedCamera, ShownImage, with_straight_camera_models
from sceneloom.view.layout import Facts
from sceneloom.view.locations import Locations, find_locations
from sceneloom.view.motion import show_motion
from sceneloom.view.notes import Reported, find_mistakes, log_notes
from sceneloom.view.objects import ObjectsView, by_camera
from sceneloom.view.report import DriveShown
from sceneloom.view.settings import ViewSettings
from sceneloom.view.stream import Stream

_READ_BY_THREADS = frozenset({"recording", "sfs"})
"""Formats in which each camera has a reader of its own, so that several may be read at once."""


@dataclass(frozen=True, slots=True, eq=False)
class DriveView:
    """A drive before it is logged.

    Attributes:
        name: of its root entity.
        scene: the shown part of it, camera models made straight.
        measured: the same with its own camera models.
        reference_ns: (N,) int64 [ns], by which frames of the drive are counted.
        locations: where its sensors are.
        bent: cameras whose images hang nowhere.
        settings: what of it is shown.
        reported: what could not be shown.
    """

    name: str
    scene: Scene
    measured: Scene
    reference_ns: Int64Array
    locations: Locations
    bent: frozenset[Key]
    settings: ViewSettings
    reported: Reported

    @property
    def facts(self) -> Facts:
        """What its layout depends on."""
        kinds = CameraSensor | DepthCameraSensor
        cameras = tuple(sensor.id for sensor in self.scene.sensors if isinstance(sensor, kinds))
        return Facts.of(self.name, self.scene, self.locations, cameras, self.settings)


def prepare_drive(
    scene: Scene, name: str, settings: ViewSettings, *, progress: Progress | None = None
) -> DriveView:
    """Choose what of a scene is shown, and find where its sensors are.

    Args:
        scene: as it was read.
        name: of its root entity.
        settings: what of it is shown.
        progress: reported while the ego trajectory is computed.

    Raises:
        OptionError: a sensor or trajectory is not there, or no frame lies in the part.
        PoseError: the named trajectory cannot be used.
    """
    reported = Reported()
    scene = scene.corrected()
    reference_ns = _reference_ns(scene)
    chosen = _with_sensors(scene, settings.sensors)
    part = cut_scene(chosen, start=settings.start, stop=settings.stop)
    straight, bent = with_straight_camera_models(part, reported)
    locations = find_locations(
        straight, trajectory=settings.trajectory, heading=settings.heading, progress=progress
    )
    return DriveView(name, straight, part, reference_ns, locations, bent, settings, reported)


def _reference_ns(scene: Scene) -> Int64Array:
    """When the frames begin by which a drive is counted: the sweeps of the first lidar, else the first images."""
    for sensor in scene.lidars:
        if len(sensor.frames):
            return np.sort(sensor.frames.timestamps_ns)
    for camera in scene.cameras:
        if len(camera.images):
            return np.sort(camera.images.timestamps_ns)
    return np.zeros(0, np.int64)


def _with_sensors(scene: Scene, chosen: tuple[Identifier, ...] | None) -> Scene:
    if chosen is None:
        return scene
    ids = {str(sensor.id): sensor.id for sensor in scene.sensors}
    keys = {key_of(scene.sensor(ids.get(str(stated), stated)).id) for stated in chosen}
    return replace(scene, sensors=tuple(sensor for sensor in scene.sensors if key_of(sensor.id) in keys))


@dataclass(slots=True, eq=False)
class _Run:
    """The logging of one drive."""

    view: DriveView
    stream: Stream
    annotations: AnnotationLayers
    labelled: LabelledPoints
    lidars: list[LidarView] = field(default_factory=list)

    def feeds(self) -> list[Feed]:
        """All that has a time, sensor by sensor."""
        scene, every = self.view.scene, self.view.settings.every
        feeds = [self._sweeps(lidar, first=lidar is scene.lidars[0]) for lidar in scene.lidars]
        for sensor in scene.sensors:
            if isinstance(sensor, RadarSensor):
                shown = RadarView(self.stream, self.view.locations, sensor, self.view.reported)
                feeds.append(_thinned(Feed(sensor.frames.timestamps_ns, shown.log), every))
            elif isinstance(sensor, CameraSensor):
                feeds.append(self._images(sensor))
            elif isinstance(sensor, DepthCameraSensor):
                feeds += self._depths(sensor)
        return [*feeds, *self._accompanying()]

    def _sweeps(self, lidar: LidarSensor, *, first: bool) -> Feed:
        settings = self.view.settings
        shown = lidar_view(
            self.stream,
            self.view.locations,
            lidar,
            colour_by=settings.colour_by,
            as_measured=settings.as_measured,
            notify=self.view.reported,
        )
        self.lidars.append(shown)

        def log(k: int, _: None) -> None:
            time_ns, positions = shown.log(k)
            if positions is not None:
                self.labelled.log(lidar.id, k, shown.path, time_ns, positions)
            if first:
                self.annotations.note(time_ns)

        return _thinned(Feed(lidar.frames.timestamps_ns, log), settings.every)

    def _images(self, sensor: CameraSensor) -> Feed:
        """Images, and at once all that is drawn into them, which is small."""
        view, every = self.view, self.view.settings.every
        times_ns = sensor.images.timestamps_ns
        self.annotations.log_in_images(sensor.id, np.unique(times_ns[::every]))
        has_pinhole = key_of(sensor.id) not in view.bent
        shown = CameraView(self._placed(sensor, times_ns, has_pinhole=has_pinhole), sensor.images)
        counts_moments = not view.scene.lidars and sensor is view.scene.cameras[0]

        def log(k: int, prepared: ShownImage | None) -> None:
            shown.log(shown.prepare(k) if prepared is None else prepared)
            if counts_moments:
                self.annotations.note(int(times_ns[k]))

        ahead = view.scene.format in _READ_BY_THREADS
        return _thinned(Feed(times_ns, log, shown.prepare if ahead else None), every)

    def _placed(
        self, sensor: CameraSensor | DepthCameraSensor, times_ns: Int64Array, *, has_pinhole: bool = True
    ) -> PlacedCamera:
        placed = PlacedCamera(
            self.stream, self.view.locations, sensor, self.view.reported, has_pinhole=has_pinhole
        )
        placed.log_poses(np.unique(times_ns[:: self.view.settings.every]))
        return placed

    def _depths(self, sensor: DepthCameraSensor) -> list[Feed]:
        feed = depth_feed(self._placed(sensor, sensor.frames.timestamps_ns), sensor, self.view.reported)
        return [] if feed is None else [_thinned(feed, self.view.settings.every)]

    def _accompanying(self) -> list[Feed]:
        """What files beside the drive hold."""
        view, settings, feeds = self.view, self.view.settings, []
        origin = view.locations.origin_world
        if settings.detections is not None:
            for camera_id, moments in by_camera(read_detections(settings.detections)).items():
                shown = ObjectsView(
                    self.stream, ("detections", camera_id), moments, origin, has_history=False
                )
                feeds.append(shown.feed)
        if settings.tracks is not None:
            moments = read_tracks(settings.tracks, view.scene)
            feeds.append(ObjectsView(self.stream, ("tracks",), moments, origin, has_history=True).feed)
        if settings.depth is not None:
            feeds.append(fused_depth_feed(self.stream, settings.depth, view.measured, view.scene))
        span_ns = time_span(view.scene)
        return [_within(feed, span_ns) for feed in feeds]


def _thinned(feed: Feed, every: int) -> Feed:
    """Every Nth moment, in the order of time."""
    rows = np.arange(0, len(feed), every)
    return _chosen(feed, rows[np.argsort(feed.times_ns[rows], kind="stable")])


def _within(feed: Feed, span_ns: tuple[int, int] | None) -> Feed:
    """The moments of a file that lie in the shown part of its drive."""
    if span_ns is None:
        return feed
    return _chosen(feed, np.flatnonzero((feed.times_ns >= span_ns[0]) & (feed.times_ns <= span_ns[1])))


def _chosen(feed: Feed, rows: Int64Array) -> Feed:
    """Some moments of a feed: (M,) numbers of them."""
    numbers: list[int] = rows.tolist()
    prepare = feed.prepare
    return Feed(
        feed.times_ns[rows],
        lambda k, prepared: feed.log(numbers[k], prepared),
        None if prepare is None else lambda k: prepare(numbers[k]),
    )


def log_drive(view: DriveView, stream: Stream, *, progress: Progress | None = None) -> DriveShown:
    """Log a drive, frame by frame.

    Raises:
        DataError: a frame cannot be read, and the reading is not lenient.
        OptionError: angles of cuboids have a unit or order that is not known.
    """
    scene, reported = view.scene, view.reported
    show_motion(stream, view.locations, scene)
    span_ns = time_span(scene) or (0, 0)
    findings = find_mistakes(view.measured) if view.settings.findings else ()
    log_notes(stream, span_ns[0], (*scene.warnings, *view.locations.warnings), findings)
    run = _Run(
        view,
        stream,
        annotation_layers(stream, view.locations, scene),
        LabelledPoints.of(stream, scene.annotations),
    )
    _log_lasting(run)
    feeds = run.feeds()
    total = sum(map(len, feeds))
    lenient = bool(view.settings.reading.get("lenient"))
    for done, _ in enumerate(play(feeds, partial(_passed_over, reported, lenient)), start=1):
        if progress is not None:
            progress(done, total)
    run.annotations.finish()
    log_notes(stream, span_ns[0], (*reported.warnings, *stream.warnings), ())
    return _shown(run, span_ns, findings)


def _log_lasting(run: _Run) -> None:
    """What holds at all times, or is stated over time by few values."""
    view, stream, scene = run.view, run.stream, run.view.scene
    for sensor in scene.sensors:
        if isinstance(sensor, PointsSensor):
            show_map(stream, view.locations, sensor)
            path = stream.path("world", "clouds", sensor.id)
            with np.errstate(over="ignore"):  # what overflows is left out
                positions = (sensor.positions - view.locations.origin_world).astype(np.float32)
            run.labelled.log(sensor.id, None, path, None, positions)
    for kind, things in (("sensors", scene.sensors), ("annotations", scene.annotations)):
        for one in things:
            if isinstance(one, PlainSensor | PlainAnnotation):
                view.reported(
                    "not-shown", f"{kind}[{one.id!r}]", f"nothing is known of the type {one.type!r}"
                )
    show_corrections(stream, view.locations, scene.annotations, view.reported)
    show_events(stream, scene.annotations)
    show_attributes(stream, scene)
    show_graph(stream, scene.annotations, view.reported)
    list_annotations(stream, scene)


def _passed_over(reported: Reported, lenient: bool, error: Exception) -> bool:  # noqa: FBT001 - bound by `partial`
    """Whether to go on after a moment that cannot be read, and report it."""
    if not (lenient and isinstance(error, DataError)):
        return False
    reported("unreadable", error.location or error.file, error.problem)
    return True


def _shown(run: _Run, span_ns: tuple[int, int], findings: tuple[Finding, ...]) -> DriveShown:
    view = run.view
    colours = {str(one.lidar.id): one.painter.used for one in run.lidars}
    wanted = view.settings.colour_by
    for sensor_id, used in colours.items():
        if wanted is not None and used is not None and used is not wanted:
            view.reported(
                "colours-missing", f"sensors[{sensor_id!r}]", f"its points have no {wanted}; they show {used}"
            )
    return DriveShown(
        source=view.scene.source,
        format=view.scene.format,
        root=run.stream.root,
        origin=tuple(view.locations.origin_world.tolist()),
        seconds=(span_ns[1] - span_ns[0]) / 1e9,
        colours={sensor_id: used.value for sensor_id, used in colours.items() if used is not None},
        logged=dict(sorted(run.stream.counts.items())),
        findings=dict(Counter(str(finding.severity) for finding in findings)),
        warnings=(
            *view.scene.warnings,
            *view.locations.warnings,
            *view.reported.warnings,
            *run.stream.warnings,
        ),
    )


def check_single(count: int, settings: ViewSettings) -> None:
    """Refuse files that belong to one drive where several are shown.

    Raises:
        OptionError: naming them.
    """
    if count > 1 and settings.accompanied:
        raise OptionError(
            f"detections, tracks and depth images belong to one drive; {count} drives are shown"
        )
