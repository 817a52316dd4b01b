"""A scene whose cuboids report where its cameras see them."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.cuboids import Activation, CuboidAnnotation, Projection
from sceneloom.scene.assumed_camera_models import check_camera_models
from sceneloom.scene.at import cuboid_at
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.sample_boxes import BoxTable
from sceneloom.scene.sample_positions import choose_ego, locations_of
from sceneloom.scene.sample_selection import ALL, Choice, chosen_sensors
from sceneloom.scene.scene import Scene
from sceneloom.scene.shutter import Shutter
from sceneloom.scene.types import Identifier, Progress, key_of
from sceneloom.scene.warnings import DataWarning, WarningKind
from sceneloom.visibility.activations import activation_of
from sceneloom.visibility.counted import with_attributes
from sceneloom.visibility.evidence import SweptPoints
from sceneloom.visibility.observations import Observations, visibility
from sceneloom.visibility.points import points_position
from sceneloom.visibility.rolled_outlines import Rolling
from sceneloom.visibility.rolling_shutter import ShutterDirection

SHARES = ("truncation", "occlusion", "occlusion_by_points")
"""Names of the attributes that report the shares."""

LEAST_POINTS = 5
"""Fewer points before and on a cuboid report no share."""

_STANDS = 1e-9
"""What goes less far than this while a image is taken does not move [m]."""

_DECIMALS = 3
"""Of shares and pixels that are written: far below what they are good for."""


@dataclass(frozen=True, slots=True)
class _Observation:
    """One cuboid in one image; its shares in the order of `SHARES`."""

    image: int
    box_xyxy: tuple[float, ...]
    shares: tuple[float | None, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """What one camera saw: observations by row of the table, and its images' times (F,) [ns]."""

    camera_id: Identifier
    timestamps_ns: Int64Array
    observations: dict[int, list[_Observation]]
    unplaced: int


def project_cuboids(
    scene: Scene,
    *,
    cameras: Choice = ALL,
    trajectory: str | EgoMotion | None = None,
    min_pixels: float = 1.0,
    see_through: Iterable[str] = (),
    lidar: Identifier | None = None,
    activations: bool = False,
    progress: Progress | None = None,
) -> Scene:
    """See all cuboids with the cameras of a scene, and fill their `projections`.

    A cuboid gets a projection for each camera that ever sees it: one row per image while it is there, NaN where that
    image does not show it. Attributes `truncation` and `occlusion` of the camera report which share of it lies outside
    the image and which share of the rest nearer cuboids hide, 0 to 1, at the images that show it. What it had of
    these cameras is replaced, but for boxes that a person confirmed.

    Args:
        scene: with cuboids in its world. Images are not decoded.
        cameras: whose images: "all", an id, or several. Of "all", a camera that is nowhere is passed over.
        trajectory: name of the ego trajectory, as for `Scene.samples`.
        min_pixels: what is narrower or lower than this in an image is not seen in it [px].
        see_through: labels of what fills little of its box and shall hide nothing, such as trees.
        lidar: id of a lidar whose points are asked, too: an attribute `occlusion_by_points` reports which share of its
            points before and on a cuboid, as the camera sees it, lie before. They know of walls and trees without one.
        activations: find anew when each camera sees it, by the paths; else only what is active for a camera is seen
            by it, by its own computed cuboids.
        progress: reported after each image how many are done, and of how many.

    Raises:
        OptionError: there is no such camera, lidar or trajectory, or no camera at all.
        CalibrationError: nothing confirms the formula of a camera model, and computing with it was not asked for.
        PoseError: it is not known where a chosen camera was, or any.
        DataError: an image cannot be read.
    """
    scene = scene.corrected()
    chosen = chosen_sensors(scene, "camera", scene.cameras, cameras)
    if not scene.cameras:
        raise OptionError(f"{scene.source}: has no camera that could see the cuboids")
    check_camera_models(scene, chosen)
    ego = choose_ego(scene, trajectory)
    locations = locations_of(scene, chosen, ego)
    swept = None
    if lidar is not None:
        (asked,) = chosen_sensors(scene, "lidar", scene.lidars, [lidar])
        swept = SweptPoints(asked, points_position(scene, asked, ego))
    placed = [(camera, source) for camera in chosen if (source := locations[camera.id].source) is not None]
    lost = [camera for camera in chosen if locations[camera.id].source is None]
    if lost and (not placed or cameras != ALL):
        raise PoseError(locations[lost[0].id].problem)
    table, views, done = BoxTable(scene), [], 0
    look = _Look(table, frozenset(see_through), min_pixels, swept, anew=activations)
    total = sum(len(camera.images) for camera, _ in placed)
    for camera, source in placed:
        view = _View(camera.id, camera.images.timestamps_ns, {}, _unplaced(camera, source))
        for k, found, rows in look.through(camera, source):
            _keep(view, k, found, rows)
            done += 1
            if progress is not None:
                progress(done, total)
        views.append(view)
    numbers = {key_of(annotation.id): row for row, annotation in enumerate(table.annotations)}
    writer = _Writer(views, numbers, table, activations)
    reported = [_lost(camera) for camera in lost] + [_beyond(view) for view in views if view.unplaced]
    annotations = tuple(writer.written(annotation) for annotation in scene.annotations)
    return replace(scene, annotations=annotations, warnings=(*scene.warnings, *reported))


def _unplaced(camera: CameraSensor, source: PoseSource) -> int:
    poses = source.at(camera.images.timestamps_ns)
    return int((~np.isfinite(poses.positions).all(axis=1)).sum())


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """How images are looked at; arguments of `project_cuboids`."""

    table: BoxTable
    see_through: Collection[str | None]
    min_pixels: float
    swept: SweptPoints | None
    anew: bool

    def query(self, camera: CameraSensor) -> Identifier | None:
        """The sensor by whose activations cuboids are there; None where activations are found anew."""
        return None if self.anew else camera.id

    def through(
        self, camera: CameraSensor, source: PoseSource
    ) -> Iterator[tuple[int, Observations | None, Int64Array]]:
        """What each image shows: its number, the observations (None where its pose is not known).

        The rows of its boxes.
        """
        shutter = Shutter.of(camera)
        for k, time_ns in enumerate(camera.images.timestamps_ns.tolist()):
            image = camera.images[k]
            location = source.mounted(image.mount)
            pose = location.at(np.array([time_ns], np.int64))
            rows, boxes = self.table.find(time_ns, sensor_id=self.query(camera))
            if not np.isfinite(pose.positions).all():
                yield k, None, rows
                continue
            observations = visibility(
                image.camera,
                RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0]),
                boxes,
                hides=np.array([label not in self.see_through for label in boxes.labels], np.bool_),
                min_pixels=self.min_pixels,
                points_world=None if self.swept is None else self.swept.at(time_ns),
                rolling=self._rolling(shutter, time_ns, location, rows, self.query(camera)),
            )
            yield k, observations, rows

    def _rolling(
        self, shutter: Shutter, time_ns: int, location: PoseSource, rows: Int64Array, query: Identifier | None
    ) -> Rolling | None:
        """What moved while an image was taken; None where nothing did, or all lines were taken at once."""
        if shutter.seconds == 0.0 or len(rows) == 0:
            return None
        first, last = (
            self.table.placed(rows, end, sensor_id=query) for end in shutter.knots_ns(time_ns, 2).tolist()
        )
        drifts = last.corners_world - first.corners_world
        trajectory = ShutterDirection.of(shutter, time_ns, location)
        if trajectory is None and not (np.abs(drifts) > _STANDS).any():
            return None
        return Rolling(trajectory or ShutterDirection.at_rest(shutter), drifts)


def _keep(view: _View, image: int, found: Observations | None, rows: Int64Array) -> None:
    if found is None:
        return
    for k, row in enumerate(rows[found.rows].tolist()):
        before, on = found.evidences[k].tolist()
        by_points = before / (before + on) if before + on >= LEAST_POINTS else None
        shares = (float(found.truncations[k]), float(found.occlusions[k]), by_points)
        reported = tuple(None if share is None else round(share, _DECIMALS) for share in shares)
        observation = _Observation(image, tuple(found.boxes_xyxy[k].tolist()), reported)
        view.observations.setdefault(row, []).append(observation)


@dataclass(frozen=True, slots=True, eq=False)
class _Writer:
    """Writes what the cameras saw into annotations; `rows` gives the row of a cuboid in the table."""

    views: Sequence[_View]
    rows: dict[tuple[type, Identifier], int]
    table: BoxTable
    activations: bool

    def written(self, annotation: Annotation) -> Annotation:
        row = self.rows.get(key_of(annotation.id))
        if not isinstance(annotation, CuboidAnnotation) or row is None:
            return annotation
        seeing = [view for view in self.views if row in view.observations]
        ids = [view.camera_id for view in self.views]
        keys = {key_of(camera_id) for camera_id in ids}
        rows = [
            cuboid_at(
                annotation,
                view.timestamps_ns,
                angles=self.table.angles,
                sensor_id=None if self.activations else view.camera_id,
            )
            for view in seeing
        ]
        projections = [
            self._projection(annotation, row, view, *placed)
            for view, placed in zip(seeing, rows, strict=True)
        ]
        others = [each for each in annotation.projections if key_of(each.sensor_id) not in keys]
        attributes = [path for view in seeing for path in _shares(view, view.observations[row])]
        written = with_attributes(annotation, attributes, names=SHARES, sensor_ids=ids)
        written = replace(written, projections=(*others, *projections))
        if not self.activations:
            return written
        active = [each for each in annotation.activations if key_of(each.sensor_id) not in keys]
        made = [self._activation(row, view, cuboids) for view, (cuboids, _) in zip(seeing, rows, strict=True)]
        return replace(written, activations=(*active, *(each for each in made if each is not None)))

    def _projection(
        self,
        annotation: CuboidAnnotation,
        row: int,
        view: _View,
        cuboids: Float64Array,
        there: BoolArray,
    ) -> Projection:
        boxes = np.full((len(there), 4), np.nan)
        for found in view.observations[row]:
            left, top, right, bottom = found.box_xyxy
            boxes[found.image] = left, top, right - left, bottom - top
        boxes = np.round(boxes, _DECIMALS)
        confirmed = _keep_confirmed(annotation, view, boxes)
        kept = there | confirmed
        reported = tuple(confirmed[kept].tolist()) if confirmed.any() else None
        return Projection(view.camera_id, view.timestamps_ns[kept], boxes[kept], reported, cuboids[kept])

    def _activation(self, row: int, view: _View, cuboids: Float64Array) -> Activation | None:
        seen = np.zeros(len(view.timestamps_ns), np.bool_)
        seen[[found.image for found in view.observations[row]]] = True
        return activation_of(view.camera_id, view.timestamps_ns, seen, cuboids)


def _keep_confirmed(annotation: CuboidAnnotation, view: _View, boxes: Float64Array) -> BoolArray:
    """Put back the boxes that a person confirmed; says at which images."""
    confirmed = np.zeros(len(boxes), np.bool_)
    for older in annotation.projections:
        if (
            key_of(older.sensor_id) != key_of(view.camera_id)
            or older.boxes is None
            or older.confirmed is None
        ):
            continue
        for time_ns, box, is_confirmed in zip(
            older.timestamps_ns.tolist(), older.boxes, older.confirmed, strict=True
        ):
            images = np.flatnonzero(view.timestamps_ns == time_ns) if is_confirmed else ()
            for image in images:
                boxes[image], confirmed[image] = box, True
    return confirmed


def _shares(view: _View, observations: Sequence[_Observation]) -> Iterator[AttributePath]:
    for k, name in enumerate(SHARES):
        reported = [found for found in observations if found.shares[k] is not None]
        if reported:
            times = view.timestamps_ns[[found.image for found in reported]]
            yield AttributePath(
                name, tuple(found.shares[k] for found in reported), times, sensor_id=view.camera_id
            )


def _lost(camera: CameraSensor) -> DataWarning:
    message = f"camera {camera.id!r} sees nothing: it is not known where it was"
    return DataWarning(kind=WarningKind.SKIPPED, code="camera-unplaced", location="sensors", message=message)


def _beyond(view: _View) -> DataWarning:
    message = f"images of camera {view.camera_id!r} see nothing: they lie beyond the ends of its trajectory"
    return DataWarning(
        kind=WarningKind.SKIPPED,
        code="images-unplaced",
        location="sensors",
        message=message,
        count=view.unplaced,
    )
