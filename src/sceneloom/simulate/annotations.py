"""A simulated drive with every annotation of the Sensor Fusion Scene format."""

from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array
from sceneloom.cameras.projection import project
from sceneloom.errors import OptionError
from sceneloom.geometry.boxes import box_corners
from sceneloom.scene.annotations import (
    Activation,
    Annotation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CameraCalibration,
    CuboidAnnotation,
    EventAnnotation,
    GroupAnnotation,
    LabeledPoints,
    LabeledPointsAnnotation,
    LinkAnnotation,
    LocalizationAdjustment,
    ObjectAnnotation,
    PointPath,
    PointProjection,
    PointsAnnotation,
    Projection,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
)
from sceneloom.scene.annotations_at import cuboid_poses
from sceneloom.scene.poses import Poses
from sceneloom.simulate.drive import SimulatedDrive
from sceneloom.simulate.street import StreetObject

_CAMERA, _LIDAR = "camera0", "lidar"
_CORNER_FROM_CENTRE = 0.5
_OUTLINE_DIRECTIONS = 24
_LEAST_PIXELS = 200
_LANE_AHEAD = 25.0
_SLIGHT_ROTATION_XYZW = (0.0, 0.0, 0.0087265, 0.9999619)  # one degree about the upright axis
_UNTIL_AFTER_NS = 1_000_000  # activations last until just after the last frame: their ends no longer count


def annotate(drive: SimulatedDrive) -> SimulatedDrive:
    """Give a drive one annotation of each type of the format beside the boxes that it has, from its exact truth.

    They are about the two cars that the camera "camera0" sees best in its middle image.

    Raises:
        OptionError: the drive has no sensors of these names, or its images show fewer than two cars.
    """
    known = {sensor.id for sensor in drive.scene.sensors}
    if not {_CAMERA, _LIDAR} <= known:
        raise OptionError(f"sensors {', '.join(map(str, known))}; expected {_CAMERA} and {_LIDAR} among them")
    view = _View.of(drive)
    first, second = _best_seen(drive, view)
    reported = {thing.instance: f"car-{thing.instance}" for thing in (first, second)}
    boxes = tuple(_box(a, view, first, reported, drive) for a in drive.scene.annotations)
    further: tuple[Annotation, ...] = (
        *_in_images(drive, view, first),
        *_in_world(drive, view, first),
        _keypoints(drive, view, first),
        _labelled(drive, first, "labeled_points"),
        _labelled(drive, second, "point_segmentation"),
        *_relations(view, reported[first.instance], reported[second.instance]),
        *_corrections(drive, view),
    )
    weather = AttributePath("weather", ("dry", "rain"), view.times_ns[[0, len(view.times_ns) // 2]])
    return replace(drive, scene=replace(drive.scene, annotations=(*boxes, *further), attributes=(weather,)))


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """What the images show: times (K,) int64 [ns], instances (K, H, W)."""

    times_ns: Int64Array
    instances: AnyArray

    @classmethod
    def of(cls, drive: SimulatedDrive) -> "_View":
        camera = next(camera for camera in drive.scene.cameras if camera.id == _CAMERA)
        times = camera.images.timestamps_ns
        return cls(times, np.stack([drive.truth.instances(_CAMERA, k) for k in range(len(times))]))

    @property
    def middle(self) -> int:
        """Number of the middle image."""
        return len(self.times_ns) // 2

    def masks(self, thing: StreetObject) -> BoolArray:
        """Which pixels show an object, (K, H, W)."""
        shown: BoolArray = self.instances == thing.instance
        return shown

    def boxes(self, thing: StreetObject) -> Float64Array:
        """The box of an object's pixels, (K, 4) `left top width height` [px] in the corner convention; NaN unseen."""
        boxes = np.full((len(self.times_ns), 4), np.nan)
        for k, mask in enumerate(self.masks(thing)):
            rows, columns = np.nonzero(mask)
            if len(rows):
                left, top = columns.min(), rows.min()
                boxes[k] = (left, top, columns.max() + 1 - left, rows.max() + 1 - top)
        return boxes


def _best_seen(drive: SimulatedDrive, view: _View) -> tuple[StreetObject, StreetObject]:
    """The two cars of which the middle image shows most, without those that its edge cuts."""
    shown = view.instances[view.middle]
    edge = set(np.concatenate([shown[:, 0], shown[:, -1], shown[-1]]).tolist())
    counts = np.bincount(shown[shown > 0], minlength=len(drive.truth.objects) + 1)
    cars = [thing for thing in drive.truth.objects if thing.label == "car" and counts[thing.instance] > _LEAST_PIXELS]
    whole = [thing for thing in cars if thing.instance not in edge]
    best = sorted(whole, key=lambda thing: -int(counts[thing.instance]))
    if len(best) < 2:
        raise OptionError(f"{len(best)} cars whole in the middle image; expected two: take another seed")
    return best[0], best[1]


def _box(
    annotation: Annotation, view: _View, seen: StreetObject, reported: dict[int, str], drive: SimulatedDrive
) -> Annotation:
    """Report of the cuboids that matter whose they are, and of one of them where and when it is seen."""
    if not isinstance(annotation, CuboidAnnotation) or annotation.id not in reported.values():
        return annotation
    annotation = replace(annotation, parent_id="parked")
    if annotation.id != reported[seen.instance]:
        return annotation
    boxes, times = view.boxes(seen), view.times_ns
    there = np.isfinite(boxes[:, 0])
    sweep_ns = drive.truth.lidar.timestamps_ns
    values = np.repeat(annotation.path.values[:1], len(times), axis=0)
    return replace(
        annotation,
        attributes=(
            AttributePath("colour", ("unknown",), times[:1], static=True),
            AttributePath("pixels", tuple(int(m.sum()) for m in view.masks(seen)), times, sensor_id=_CAMERA),
        ),
        activations=(
            Activation(_LIDAR, sweep_ns[:1], (int(np.ptp(sweep_ns)) + _UNTIL_AFTER_NS,)),
            Activation(_CAMERA, times[there][:1], (int(np.ptp(times[there])) + _UNTIL_AFTER_NS,)),
        ),
        projections=(Projection(_CAMERA, times, boxes, (True, *(False,) * (len(times) - 1)), values),),
    )


def _in_images(drive: SimulatedDrive, view: _View, car: StreetObject) -> tuple[Annotation, ...]:
    boxes, times = view.boxes(car), view.times_ns
    there = np.flatnonzero(np.isfinite(boxes[:, 0]))
    seen_ns, box = times[there], boxes[there]
    outlines = tuple(_outline(view.masks(car)[k]) for k in there)
    middles = tuple((row[:2] + row[2:] / 2)[None] for row in box)
    lanes = tuple(_lane_pixels(drive, int(k)) for k in there)
    shapes = {ShapeType.POLYGON_2D: outlines, ShapeType.POINT_2D: middles, ShapeType.POLYLINE_2D: lanes}
    labels = {ShapeType.POLYGON_2D: "outline", ShapeType.POINT_2D: "middle", ShapeType.POLYLINE_2D: "trajectory"}
    return (
        Box2DAnnotation("box", _CAMERA, BoxPath(seen_ns, box), label="car", parent_id="vehicle"),
        *(
            ShapeAnnotation(str(kind), kind, VertexPath(seen_ns, vertices), _CAMERA, label=labels[kind])
            for kind, vertices in shapes.items()
        ),
    )


def _outline(mask: BoolArray) -> Float64Array:
    """The farthest pixels in each of several directions, round the mask, (V, 2) [px] in the corner convention."""
    rows, columns = np.nonzero(mask)
    pixels = np.column_stack([columns, rows]) + _CORNER_FROM_CENTRE
    angles = np.linspace(0.0, 2.0 * np.pi, _OUTLINE_DIRECTIONS, endpoint=False)
    farthest = (pixels @ np.stack([np.cos(angles), np.sin(angles)])).argmax(axis=0)
    kept = farthest[np.flatnonzero(np.diff(farthest, prepend=farthest[-1]))]
    outline: Float64Array = pixels[kept if len(kept) else farthest[:1]]
    return outline


def _path_ahead(drive: SimulatedDrive) -> Float64Array:
    """The ego trajectory on the ground, and straight on, (V, 3) [m]."""
    trajectory = next(iter(drive.scene.trajectories.values())).positions
    along = (trajectory[-1] - trajectory[-2])[:2]
    ahead = trajectory[-1, :2] + along / np.linalg.norm(along) * np.linspace(1.0, _LANE_AHEAD, 12)[:, None]
    locations = np.concatenate([trajectory[np.linspace(0, len(trajectory) - 1, 12).astype(np.int64), :2], ahead])
    return np.column_stack([locations, np.zeros(len(locations))])


def _lane_pixels(drive: SimulatedDrive, k: int) -> Float64Array:
    """The ego trajectory as image k shows it, (V, 2) [px] in the corner convention."""
    camera_from_world = drive.truth.world_from_camera(_CAMERA, k).inverse()
    camera = next(camera.camera for camera in drive.scene.cameras if camera.id == _CAMERA)
    pixels, visible = project(camera, camera_from_world.apply(_path_ahead(drive)))
    return pixels[visible] + _CORNER_FROM_CENTRE


def _in_world(drive: SimulatedDrive, view: _View, car: StreetObject) -> tuple[Annotation, ...]:
    corners = _corners(drive, car)
    ground = corners[:4]
    middle = ground.mean(axis=0)
    plot = middle + 1.3 * (ground - middle)
    pole, stand = _most_seen(drive, view, "pole"), _most_seen(drive, view, "bin")
    vertices = {
        ShapeType.POLYGON: corners[[0, 1, 5, 4]],
        ShapeType.POLYGON_TOPDOWN: plot + np.array([[0, 0, 0], [0, 0, 0.05], [0, 0, 0], [0, 0, 0.05]]),
        ShapeType.POLYLINE: plot,
        ShapeType.POINT: np.array([pole.center_world]),
        ShapeType.POINT_TOPDOWN: np.array([[*stand.center_world[:2], 0.0]]),
    }
    labels = ("side", "parking space", "kerb", "lamp", "bin")
    times = view.times_ns[:1]
    return tuple(
        ShapeAnnotation(
            str(kind),
            kind,
            VertexPath(times, (locations,)),
            label=label,
            stationary=True,
            is_closed=True if kind is ShapeType.POLYLINE else None,
        )
        for (kind, locations), label in zip(vertices.items(), labels, strict=True)
    )


def _most_seen(drive: SimulatedDrive, view: _View, label: str) -> StreetObject:
    """The object of a class that the middle image shows best; any object where the street has none."""
    shown = view.instances[view.middle]
    things = [thing for thing in drive.truth.objects if thing.label == label] or list(drive.truth.objects)
    return max(things, key=lambda thing: int(np.count_nonzero(shown == thing.instance)))


def _corners(drive: SimulatedDrive, car: StreetObject) -> Float64Array:
    """The corners of a car's box, (8, 3) [m], as `geometry.boxes` orders them."""
    boxes = {a.id: a for a in drive.scene.annotations if isinstance(a, CuboidAnnotation)}
    box = boxes[f"car-{car.instance}"]
    poses = cuboid_poses(box, box.path.timestamps_ns[:1])
    return box_corners(poses.centers_world[0], poses.sizes_lwh[0], poses.quaternions_xyzw[0])


def _keypoints(drive: SimulatedDrive, view: _View, car: StreetObject) -> PointsAnnotation:
    """The corners of the car's roof, with where each image shows them."""
    roof, times = _corners(drive, car)[4:], view.times_ns
    camera = next(camera.camera for camera in drive.scene.cameras if camera.id == _CAMERA)
    pixels = np.stack(
        [project(camera, drive.truth.world_from_camera(_CAMERA, k).inverse().apply(roof))[0] for k in range(len(times))]
    )
    names = ("front left", "back left", "back right", "front right")
    return PointsAnnotation(
        "roof",
        tuple(PointPath(times[:1], corner[None], id=k) for k, corner in enumerate(roof)),
        labels=names,
        projections=tuple(
            (PointProjection(_CAMERA, times, pixels[:, k] + _CORNER_FROM_CENTRE),) for k in range(len(roof))
        ),
        stationary=True,
        parent_id="vehicle",
        attributes=(AttributePath("visible", ("yes",), times[:1], point_index=0),),
    )


def _labelled(drive: SimulatedDrive, car: StreetObject, type_name: str) -> LabeledPointsAnnotation:
    """The points of all sweeps that lie on a car."""
    frames = range(len(drive.truth.lidar.timestamps_ns))
    ids = (np.flatnonzero(drive.truth.sweep(k).instances == car.instance) for k in frames)
    parts = tuple(LabeledPoints(_LIDAR, found.astype(np.uint32), k) for k, found in enumerate(ids))
    return LabeledPointsAnnotation(type_name, parts, label="car", is_instance=True, type=type_name)


def _relations(view: _View, first: str, second: str) -> tuple[Annotation, ...]:
    times = view.times_ns
    speed = AttributePath("speed limit", (30, 50.5), times[[0, view.middle]])
    return (
        ObjectAnnotation("vehicle", label="vehicle"),
        ObjectAnnotation("street", label="street", attributes=(speed,), type="attributes"),
        GroupAnnotation("parked", label="parked cars"),
        LinkAnnotation("behind", first, second, label="one row", is_bidirectional=True),
        EventAnnotation(
            "passing", int(times[0]), int(times[view.middle] - times[0]), label="passing", sensor_id=_CAMERA
        ),
    )


def _corrections(drive: SimulatedDrive, view: _View) -> tuple[Annotation, ...]:
    """A localisation that drifts by 0.3 m to the side, and a camera that is rotated by a degree."""
    ends = view.times_ns[[0, -1]]
    still, rotation = np.array([[0.0, 0.0, 0.0, 1.0]] * 2), np.array([_SLIGHT_ROTATION_XYZW])
    drift = Poses(ends, np.array([[0.0, 0.0, 0.0], [0.0, 0.3, 0.0]]), still)
    camera_model = next(camera.camera for camera in drive.scene.cameras if camera.id == _CAMERA)
    repaired = replace(camera_model, fx=1.01 * camera_model.fx, fy=1.01 * camera_model.fy)
    rotated = Poses(ends[:1], np.zeros((1, 3)), rotation / np.linalg.norm(rotation))
    return (
        LocalizationAdjustment("drift", drift),
        CameraCalibration("repaired", _CAMERA, rotated, repaired, time_offset_ns=2_000_000),
    )
