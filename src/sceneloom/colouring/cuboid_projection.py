"""Cuboids projected into the images of a scene: 2D box, truncation and occlusion of each."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, FloatArray, Int64Array, check_array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project, unproject
from sceneloom.colouring.box_outlines import (
    CENTRE_TO_CORNER,
    Rolling,
    box_extents,
    rolled_extents,
    widest_angle,
)
from sceneloom.colouring.cuboid_points import activation_of, points_in_world, points_position, with_attributes
from sceneloom.colouring.rolling_shutter import ShutterDirection, pixels_by_lines, project_by_lines
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.boxes import box_corners
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import conjugate_quaternion, multiply_quaternions
from sceneloom.kernels.boxes import count_evidence, count_observations
from sceneloom.scene.annotations import Activation, Annotation, AttributePath, CuboidAnnotation, Projection
from sceneloom.scene.annotations_at import Boxes, BoxTable, cuboid_at
from sceneloom.scene.cameras import CameraSensor, Shutter
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.point_times import timed_frame
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.sampling import ALL, Choice, choose_ego, chosen_sensors, locations_of
from sceneloom.scene.scene import Scene, check_camera_models, sweep_period_ns
from sceneloom.scene.types import Identifier, Progress, key_of
from sceneloom.warnings import DataWarning, WarningKind

_LATEST_PERIODS = 2
"""A sweep that began more than so many periods before an image is no evidence of it."""


@dataclass(slots=True)
class _SweptPoints:
    """Gives the points that a lidar measured about a time; the last sweep is kept, since images follow each other.

    Attributes:
        lidar: the lidar.
        location: takes its points as stored into the world.
    """

    lidar: LidarSensor
    location: PoseSource
    _kept: tuple[int, FloatArray | None] = field(default=(-1, None))

    def at(self, time_ns: int) -> FloatArray | None:
        """Give the points (N, 3) [m] of the sweep that is under way at a time [ns]; None where there is none.

        Raises:
            DataError: the sweep cannot be read.
        """
        timestamps = self.lidar.frames.timestamps_ns
        index = int(np.searchsorted(timestamps, time_ns, side="right")) - 1
        period_ns = sweep_period_ns(self.lidar)
        if index < 0 or time_ns - int(timestamps[index]) > _LATEST_PERIODS * period_ns:
            return None
        if self._kept[0] != index:
            frame = timed_frame(self.lidar.frames[index], period_ns).frame
            times = frame.points.timestamps_ns
            if times is None:
                times = np.full(len(frame.points), frame.timestamp_ns, np.int64)
            self._kept = index, points_in_world(self.location, frame.points.positions, times)
        return self._kept[1]


_NEAR = 0.05
"""A box nearer to the camera than this holds the camera: it is not seen, and hides nothing [m]."""

_FARTHEST = 1e8
"""Boxes farther away, or larger, are not seen [m]."""

_ON_BOX = 0.2
"""A point so near to a box is on it [m]: boxes are drawn tightly, and things move between sweep and image."""

_RAYS = ((8.0, 6), (32.0, 12), (np.inf, 24))
"""Rays to a box along each side of its location in the image, to report how much of it others hide.

So many where it is up
to so many pixels long."""

_CELLS = 24
"""Cells along each side of a face, to report how much of a box the image cuts off."""

_BOXES_AT_ONCE = 256
"""Whose cells are looked at together: enough to be quick, few enough for little memory."""

_AT_ONCE = np.zeros((0, 4))
"""`lines` of images whose lines were taken at once."""


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """The boxes that an image shows.

    Attributes:
        rows: (S,) int64, rising, which of the boxes they are.
        boxes_xyxy: (S, 4) float64 [px], left, top, right, bottom of what is in the image, corner convention.
        truncations: (S,) float64, which share of the box, of what the camera would see of it with an static image,
            lies outside the image: a share of the solid angle, so that it means the same with every camera model.
        occlusions: (S,) float64, which share of its area in the image nearer boxes hide.
        evidences: (S, 2) int64, points of a lidar that lie before it, as the camera sees it, and on it; 0 without one.
    """

    rows: Int64Array
    boxes_xyxy: Float64Array
    truncations: Float64Array
    occlusions: Float64Array
    evidences: Int64Array

    def __post_init__(self) -> None:
        count = check_array("rows", self.rows, (None,), np.int64)
        check_array("boxes_xyxy", self.boxes_xyxy, (count, 4), np.float64)
        check_array("truncations", self.truncations, (count,), np.float64)
        check_array("occlusions", self.occlusions, (count,), np.float64)
        check_array("evidences", self.evidences, (count, 2), np.int64)


@np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
def observe_cuboids(
    camera: Camera,
    world_from_camera: RigidTransform,
    boxes: Boxes,
    *,
    hides: BoolArray | None = None,
    min_pixels: float = 1.0,
    points_world: FloatArray | None = None,
    rolling: Rolling | None = None,
) -> Observations:
    """See boxes with a camera.

    Boxes with numbers that are not finite, without volume, or around the camera are not seen and hide nothing.

    Args:
        camera: the camera model; any model.
        world_from_camera: where it is.
        boxes: in the world.
        hides: (B,) bool, which of the boxes hide what is behind them; None for all.
        points_world: (N, 3) [m], what a lidar saw about then, as evidence of what hides the boxes; None for none.
        min_pixels: what is narrower or lower than this in the image is not seen, but hides [px].
        rolling: how camera and boxes moved while the lines were taken, `world_from_camera` and `boxes` being of the
            image's time; None where all lines were taken at once.

    Raises:
        CalibrationError: the camera model is unknown.
    """
    rows, near = _in_view(camera, world_from_camera, boxes, rolling)
    corners = box_corners(near.centers, near.sizes, near.quaternions)
    trajectory = None if rolling is None else rolling.trajectory
    if rolling is None or trajectory is None:
        extents, shares = box_extents(camera, corners)
    else:
        drifts = rolling.drifts_world[rows] @ world_from_camera.rotation
        extents, shares = rolled_extents(camera, corners, drifts, trajectory)
    whole = shares == 1.0
    there = np.flatnonzero((extents[:, 2:] > extents[:, :2]).all(axis=1))
    rows, near, extents, whole = rows[there], near.some(there), extents[there], whole[there]
    solid = np.ones(len(rows), np.bool_) if hides is None else hides[rows]
    occlusions = _occlusions(camera, near, extents, solid, trajectory)
    truncations = np.zeros(len(rows))
    truncations[~whole] = _truncations(camera, near.some(np.flatnonzero(~whole)), trajectory)
    seen = np.flatnonzero((extents[:, 2:] - extents[:, :2] >= min_pixels).all(axis=1))
    evidences = np.zeros((len(rows), 2), np.int64)
    if points_world is not None:
        finite = points_world[np.isfinite(points_world).all(axis=1)].astype(np.float64)
        evidences = _evidences(camera, world_from_camera, finite, near, extents, trajectory)
    return Observations(rows[seen], extents[seen], truncations[seen], occlusions[seen], evidences[seen])


@dataclass(frozen=True, slots=True, eq=False)
class _Near:
    """Boxes in the camera's frame: centres (B, 3), sizes (B, 3) [m], quaternions (B, 4) and axes (B, 3, 3).

    `drifts` (B, 3) [m]: how far they go while the image is taken.
    """

    centers: Float64Array
    sizes: Float64Array
    quaternions: Float64Array
    axes: Float64Array
    drifts: Float64Array

    def some(self, rows: Int64Array) -> "_Near":
        return _Near(
            self.centers[rows], self.sizes[rows], self.quaternions[rows], self.axes[rows], self.drifts[rows]
        )

    @property
    def arrays(self) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Centres, axes and half sizes, as the kernels take them."""
        return tuple(map(np.ascontiguousarray, (self.centers, self.axes, self.sizes / 2.0)))  # type: ignore[return-value]

    @property
    def cameras_box(self) -> Float64Array:
        """Where the camera is in the frame of each box, (B, 3) [m]."""
        location: Float64Array = -np.einsum("bij,bi->bj", self.axes, self.centers)
        return location


def _in_view(
    camera: Camera, world_from_camera: RigidTransform, boxes: Boxes, rolling: Rolling | None
) -> tuple[Int64Array, _Near]:
    """The boxes that may be in the image, in the camera's frame, and which they are."""
    locations = (np.abs(boxes.centers_world) < _FARTHEST).all(axis=1) & np.isfinite(
        boxes.quaternions_xyzw
    ).all(axis=1)
    sized = ((boxes.sizes_lwh > 0) & (boxes.sizes_lwh < _FARTHEST)).all(axis=1)
    rows = np.flatnonzero(locations & sized)
    camera_from_world = world_from_camera.inverse()
    centers, sizes = camera_from_world.apply(boxes.centers_world[rows]), boxes.sizes_lwh[rows]
    distances, reaches = np.linalg.norm(centers, axis=1), np.linalg.norm(sizes, axis=1) / 2.0
    drifts, widest = np.zeros_like(centers), widest_angle(camera)
    if rolling is not None:
        drifts = rolling.drifts_world[rows].mean(axis=1) @ world_from_camera.rotation
        reaches = (
            reaches
            + rolling.trajectory.trajectory
            + np.linalg.norm(rolling.drifts_world[rows], axis=2).max(axis=1)
        )
        widest += rolling.trajectory.rotation
    off_axis = np.arccos(np.clip(centers[:, 2] / np.maximum(distances, _NEAR), -1.0, 1.0))
    spreads = np.arcsin(np.clip(reaches / np.maximum(distances, _NEAR), 0.0, 1.0))
    kept = np.flatnonzero((reaches >= distances) | (off_axis - spreads <= widest))
    rotations = multiply_quaternions(
        conjugate_quaternion(world_from_camera.quaternion_xyzw), boxes.quaternions_xyzw[rows[kept]]
    )
    axes = world_from_camera.rotation.T @ boxes.rotations_world[rows[kept]]
    near = _Near(centers[kept], sizes[kept], rotations, axes, drifts[kept])
    away = np.maximum(np.abs(near.cameras_box) - near.sizes / 2.0, 0.0)
    outside = np.flatnonzero(np.linalg.norm(away, axis=1) > _NEAR)
    return rows[kept][outside], near.some(outside)


def _occlusions(
    camera: Camera, near: _Near, extents: Float64Array, solid: BoolArray, trajectory: ShutterDirection | None
) -> Float64Array:
    """Which share of each box in the image others hide: rays through a grid over its location in the image."""
    count = len(extents)
    if count == 0:
        return np.zeros(0)
    pixels, starts = _grids(extents)
    rays, lines = unproject(camera, pixels), _AT_ONCE
    if trajectory is not None:
        rotations, lines = _eyes(camera, pixels, trajectory)
        rays = np.einsum("nij,nj->ni", rotations, rays)
    rivals, rival_starts = _rivals(near, extents, solid)
    met, hidden = np.zeros(count, np.int64), np.zeros(count, np.int64)
    count_observations(
        rays,
        starts,
        *near.arrays,
        lines,
        near.drifts,
        rival_starts,
        rivals,
        met,
        hidden,
    )
    shares: Float64Array = hidden / np.maximum(met, 1)
    return shares


def _eyes(
    camera: Camera, pixels: Float64Array, trajectory: ShutterDirection
) -> tuple[Float64Array, Float64Array]:
    """How the camera was rotated at the lines of pixels, (R, 3, 3), and `lines` of `count_observations`, (R, 4).

    Both are in the frame of the camera at the image's time.
    """
    lines = pixels[:, trajectory.axis]
    poses = trajectory.poses_at(lines, camera)
    rotations = np.ascontiguousarray(poses[:, :, :3].transpose(0, 2, 1))
    locations = -np.einsum("nij,nj->ni", rotations, poses[:, :, 3])
    shares = np.clip((lines + 0.5) / trajectory.line_count(camera) - 0.5, -0.5, 0.5)
    return rotations, np.column_stack([locations, shares])


def _grids(extents: Float64Array) -> tuple[Float64Array, Int64Array]:
    """Pixels of a grid over each box's location in the image, (R, 2), and where those of each begin, (B + 1,)."""
    spans = extents[:, 2:] - extents[:, :2]
    sides = np.array([side for _, side in _RAYS])[np.searchsorted([px for px, _ in _RAYS], spans.max(axis=1))]
    starts = np.concatenate([[0], np.cumsum(sides**2)])
    grids = np.empty((int(starts[-1]), 2))
    for side in np.unique(sides).tolist():
        rows = np.flatnonzero(sides == side)
        v, u = (grid.ravel() for grid in np.mgrid[0:side, 0:side])
        shares = (np.column_stack([u, v]) + 0.5) / side
        pixels = extents[rows, None, :2] + shares * spans[rows, None] - CENTRE_TO_CORNER
        locations = starts[rows, None] + np.arange(side * side)
        grids[locations.ravel()] = pixels.reshape(-1, 2)
    return grids, starts


def _evidences(
    camera: Camera,
    world_from_camera: RigidTransform,
    points_world: Float64Array,
    near: _Near,
    extents: Float64Array,
    trajectory: ShutterDirection | None,
) -> Int64Array:
    """How many points lie before each box and on it."""
    points, lines = world_from_camera.inverse().apply(points_world), _AT_ONCE
    if trajectory is None:
        pixels, visible = project(camera, points)
        points, pixels = points[visible], pixels[visible]
    else:
        rolled = project_by_lines(points_world, camera, world_from_camera, trajectory)
        pixels = rolled.pixels.astype(np.float64)
        lines = _eyes(camera, pixels, trajectory)[1]
        points = points[rolled.point_ids] - lines[:, :3]
    evidences = np.zeros((len(extents), 2), np.int64)
    count_evidence(
        np.ascontiguousarray(points),
        pixels + CENTRE_TO_CORNER,
        np.ascontiguousarray(extents),
        *near.arrays,
        lines,
        near.drifts,
        _ON_BOX,
        evidences,
    )
    return evidences


def _rivals(near: _Near, extents: Float64Array, solid: BoolArray) -> tuple[Int64Array, Int64Array]:
    """Of each box the solid others that overlap it in the image and begin before it ends, one box after another."""
    distances, reaches = np.linalg.norm(near.centers, axis=1), np.linalg.norm(near.sizes, axis=1) / 2.0
    # only solid boxes, as columns, from the one that begins nearest: each box then asks no more than those before it
    solids = np.flatnonzero(solid)
    solids = solids[np.argsort((distances - reaches)[solids], kind="stable")]
    begins = (distances - reaches)[solids]
    lefts, tops, rights, bottoms = np.ascontiguousarray(extents[solids].T)
    counts = np.searchsorted(begins, distances + reaches, side="left")
    found = []
    for b, (count, (left, top, right, bottom)) in enumerate(
        zip(counts.tolist(), extents.tolist(), strict=True)
    ):
        overlap = (lefts[:count] < right) & (rights[:count] > left)
        overlap &= (tops[:count] < bottom) & (bottoms[:count] > top)
        rivals = solids[:count][overlap]
        found.append(rivals[rivals != b])
    starts = np.concatenate([[0], np.cumsum([len(rows) for rows in found])]).astype(np.int64)
    return np.concatenate(found), starts


def _truncations(camera: Camera, near: _Near, trajectory: ShutterDirection | None) -> Float64Array:
    """Which share of the solid angle of each box lies outside the image: of the faces that look at the camera."""
    all_of, inside_of = np.zeros(len(near.centers)), np.zeros(len(near.centers))
    sides = near.cameras_box / (near.sizes / 2.0)
    for axis in range(3):
        facing = np.flatnonzero(np.abs(sides[:, axis]) > 1.0)
        for begin in range(0, len(facing), _BOXES_AT_ONCE):
            rows = facing[begin : begin + _BOXES_AT_ONCE]
            some = near.some(rows)
            corners = _face_grids(some, axis, np.sign(sides[rows, axis]))
            angles = _solid_angles(corners)
            middles = (corners[:, :-1, :-1] + corners[:, 1:, 1:]).reshape(-1, 3) / 2.0
            inside = _shown(
                camera, middles, np.repeat(some.drifts, len(middles) // len(rows), axis=0), trajectory
            )
            all_of[rows] += angles.sum(axis=1)
            inside_of[rows] += np.where(inside.reshape(angles.shape), angles, 0.0).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.clip(1.0 - inside_of / all_of, 0.0, 1.0)


def _shown(
    camera: Camera, points: Float64Array, drifts: Float64Array, trajectory: ShutterDirection | None
) -> BoolArray:
    """Report which points fall into the image."""
    if trajectory is None:
        return project(camera, points)[1]
    pixels = pixels_by_lines(points, drifts, camera, trajectory) + CENTRE_TO_CORNER
    shown: BoolArray = np.all((pixels >= 0.0) & (pixels <= (camera.width, camera.height)), axis=1)
    return shown


def _face_grids(near: _Near, axis: int, sides: Float64Array) -> Float64Array:
    """Corners of the cells of one face of each box, (B, C + 1, C + 1, 3) [m], in the camera's frame."""
    steps = np.linspace(-0.5, 0.5, _CELLS + 1)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    spans = near.axes * near.sizes[:, None]
    middles = near.centers + spans[:, :, axis] * (sides / 2.0)[:, None]
    along = steps[:, None, None] * spans[:, None, None, :, first]
    across = steps[:, None] * spans[:, None, None, :, second]
    grids: Float64Array = middles[:, None, None] + along + across
    return grids


def _solid_angles(corners: Float64Array) -> Float64Array:
    """Solid angles of the cells of faces, as seen from the origin, (B, C * C) [sr].

    Source: Van Oosterom and Strackee 1983, "The Solid Angle of a Plane Triangle", of two triangles per cell.
    """
    a, b, c, d = corners[:, :-1, :-1], corners[:, 1:, :-1], corners[:, 1:, 1:], corners[:, :-1, 1:]
    return (_solid_angle(a, b, c) + _solid_angle(a, c, d)).reshape(len(corners), -1)


def _solid_angle(a: Float64Array, b: Float64Array, c: Float64Array) -> Float64Array:
    la, lb, lc = (np.linalg.norm(vertex, axis=-1) for vertex in (a, b, c))
    volume = np.abs((a * np.cross(b, c)).sum(axis=-1))
    spread = la * lb * lc + (a * b).sum(axis=-1) * lc + (b * c).sum(axis=-1) * la + (c * a).sum(axis=-1) * lb
    angle: Float64Array = 2.0 * np.arctan2(volume, spread)
    return angle


_SHARES = ("truncation", "occlusion", "occlusion_by_points")
"""Names of the attributes that report the shares."""

_LEAST_POINTS = 5
"""Fewer points before and on a cuboid report no share."""

_STANDS = 1e-9
"""What goes less far than this while a image is taken does not move [m]."""

_DECIMALS = 3
"""Of shares and pixels that are written: far below what they are good for."""


@dataclass(frozen=True, slots=True)
class _Observation:
    """One cuboid in one image; its shares in the order of `_SHARES`."""

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
        swept = _SweptPoints(asked, points_position(scene, asked, ego))
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
    swept: _SweptPoints | None
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
            observations = observe_cuboids(
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
        by_points = before / (before + on) if before + on >= _LEAST_POINTS else None
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
        written = with_attributes(annotation, attributes, names=_SHARES, sensor_ids=ids)
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
    for k, name in enumerate(_SHARES):
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
