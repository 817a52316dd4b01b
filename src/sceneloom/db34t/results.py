"""Results of the fusion system as records of tables 9 and 10, in the coordinate frames that the session declares."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array, UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.colouring.blending import NO_CAMERA, colour_points
from sceneloom.colouring.results import FusedFrame, FusedView
from sceneloom.db34t.calibration import SensorKind
from sceneloom.db34t.records import Boxes2d, Boxes3d, FusedDetections, ImageData, SensorFusionData
from sceneloom.db34t.scene_objects import COLOR_NAMES, point_table, result_fields, whole_corners
from sceneloom.db34t.setting import Setting
from sceneloom.db34t.types import Timestamp
from sceneloom.detections.results import NO_BOX, FusedBoxes
from sceneloom.fusion.algorithms import BUILT_IN, FusionType
from sceneloom.fusion.box_fusion import FusedDetectionFrame
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.projection import draw_depths
from sceneloom.scene.clouds import LidarFrame, LidarPoints


@dataclass(frozen=True, slots=True, eq=False)
class FoundObjects:
    """The objects of a sweep and an image, and where the lidar was.

    Attributes:
        frame: the objects, in the lidar's frame of the standard axes.
        world_from_lidar: at the time of the sweep; the identity where the ego trajectory did not count.
        origin: (3,) float64 [m], where that world's origin is in the world of the vehicle's trajectory.
        setting: the configuration in force when the sweep came.
    """

    frame: FusedDetectionFrame
    world_from_lidar: RigidTransform
    origin: Float64Array
    setting: Setting


def sensor_fusion_record(
    frame: FusedFrame,
    view: FusedView,
    world_from_lidar: RigidTransform,
    setting: Setting,
    *,
    sent: LidarFrame,
    image: ImageData,
    numbers: Mapping[str, Any],
    motion_compensated: bool,
) -> SensorFusionData:
    """The record of a sweep and one of its images.

    The points have x, y, z, then what else was sent of them in its order, then r, g, b, whatever the values are.

    Args:
        world_from_lidar: the lidar at the sweep's reference time; where the ego stood, the identity.
        numbers: camera_id, lidar_id, image_seq and points_seq.

    Source: DB34/T 4101-2022, table 9; READINGS of table 9 in docs/CONVENTIONS.md.
    """
    of_lidar = setting.properties["reference_frame"] == 1
    world_from_frame = world_from_lidar if of_lidar else view.world_from_camera
    kind = SensorKind.LIDAR if of_lidar else SensorKind.CAMERA
    points = replace(
        sent.points,
        positions=_moved(frame.points, world_from_frame, setting.axes[kind].standard_from_declared(kind).T),
        colors=_colors_of(frame, view, setting),
        camera_index=None,
        extras={name: values for name, values in sent.points.extras.items() if name not in COLOR_NAMES},
    )
    fields, depth_kind = result_fields(sent), setting.properties["depth_kind"]
    data = point_table(points, fields, frame.timestamp_ns)
    return SensorFusionData(
        **numbers,
        timestamp=Timestamp.of(frame.timestamp_ns),
        height=view.camera.height,
        width=view.camera.width,
        encoding=image.encoding,
        image_channel=image.channel,
        image_data=image.data,
        image_depth=view.depth_image if depth_kind == "z" else _range_image(frame, view),
        point_num=len(data),
        point_fields=fields,
        fields_number=len(fields),
        point_data=data,
        depth_kind=depth_kind,
        point_frame=kind.value,
        motion_compensated=motion_compensated,
        image_timestamp=Timestamp.of(view.timestamp_ns),
    )


def _range_image(frame: FusedFrame, view: FusedView) -> Float32Array:
    """Distances [m] of the nearest visible points from the camera's centre, (H, W) float32, 0 for none."""
    positions_world = frame.points.positions[view.point_ids].astype(np.float64)
    ranges = np.linalg.norm(positions_world - view.world_from_camera.translation, axis=1)
    image = np.zeros((view.camera.height, view.camera.width), np.float32)
    draw_depths(view.pixel_numbers, ranges.astype(np.float32), view.visible, image)
    return image


def _colors_of(frame: FusedFrame, view: FusedView, setting: Setting) -> UInt8Array:
    """The colours that one image gives the points: those of the cloud, where it is the only one that gave them.

    Algorithms of other packages may colour a cloud as they like. Points that the image does not show are grey.
    """
    own = setting.properties.algorithms[FusionType.SENSOR_DATA] in BUILT_IN[FusionType.SENSOR_DATA]
    colors, shown_by = frame.points.colors, frame.points.camera_index
    if not own or len(frame.views) != 1 or colors is None or shown_by is None:
        colors, shown_by = colour_points(len(frame.points), [view], [0])
    unseen = shown_by == NO_CAMERA
    if unseen.any():
        colors = colors.copy()
        colors[unseen] = 128  # red, green and blue alike: grey
    return colors


def _moved(points: LidarPoints, world_from_frame: RigidTransform, declared_from_standard: Float64Array) -> Float32Array:
    """Give points of the world in a frame of declared axes, (N, 3) float32 [m]."""
    frame_from_world = world_from_frame.inverse()
    rotation = declared_from_standard @ frame_from_world.rotation
    translation = declared_from_standard @ frame_from_world.translation
    if np.array_equal(rotation, np.eye(3)) and not translation.any():
        return points.positions
    return (points.positions @ rotation.T + translation).astype(np.float32)


def fused_detections_record(
    frame: FusedDetectionFrame,
    boxes_3d: Boxes3d,
    boxes_2d: Boxes2d,
    setting: Setting,
    *,
    camera: Camera,
    lidar_id: int,
    camera_id: int,
    motion_compensated: bool,
) -> FusedDetections:
    """The records of the objects of a sweep and an image.

    Args:
        camera: the camera model of the image, to whose size boxes are cut.

    Source: DB34/T 4101-2022, table 10.
    """
    fused = frame.fused
    columns, sound = declared_columns(fused, setting.declared_from_standard, camera)
    _tilt(columns, fused, boxes_3d, setting.standard_from_lidar)
    fields: dict[str, Any] = {
        "timestamp": boxes_3d.timestamp,
        "image_seq": boxes_2d.seq,
        "points_seq": boxes_3d.seq,
        "camera_id": camera_id,
        "lidar_id": lidar_id,
        "id": fused.ids.astype(np.int32),
        "class_names": fused.labels,
        "box_3d_ids": _numbers(fused.rows_3d, boxes_3d),
        "box_2d_ids": _numbers(fused.rows_2d, boxes_2d),
        "motion_compensated": int(motion_compensated),
        "image_timestamp": Timestamp.of(frame.image_timestamp_ns),
    }
    return FusedDetections.of_sound_numbers(**fields, **columns) if sound else FusedDetections(**fields, **columns)


def _tilt(columns: dict[str, Any], fused: FusedBoxes, boxes_3d: Boxes3d, standard_from_declared: Float64Array) -> None:
    """Let directions rise and fall as those that were sent do: objects of the fusion system are upright."""
    rows = np.flatnonzero(fused.rows_3d != NO_BOX)
    up = standard_from_declared[2]
    sent = boxes_3d.directions[fused.rows_3d[rows]].astype(np.float64)
    lifts = sent @ up
    tilted = np.flatnonzero(lifts)
    if not len(tilted):
        return
    rows, sent, lifts = rows[tilted], sent[tilted], lifts[tilted]
    level = np.sqrt((sent * sent).sum(axis=1) - lifts * lifts)
    headings = columns["directions"][rows].astype(np.float64)
    # an object may have been found to head the other way, and then goes down where the box went up
    along = np.sign((headings * sent).sum(axis=1))
    tilts = np.where(along == 0, 0.0, along) * np.arctan2(lifts, level)
    directions = headings * np.cos(tilts)[:, None] + np.sin(tilts)[:, None] * up
    columns["directions"][rows] = directions
    if columns["velocity_vectors"] is not None:
        columns["velocities"][rows] = (columns["velocity_vectors"][rows] * directions).sum(axis=1)


def tracked_detections_record(
    record: FusedDetections, fused: FusedBoxes, setting: Setting, camera: Camera
) -> FusedDetections:
    """The record of a sweep and an image with tracks (in the lidar's standard axes) instead of its objects.

    Boxes are cut to the size of the camera's image.
    """
    columns, _ = declared_columns(fused, setting.declared_from_standard, camera)
    none: tuple[None, ...] = (None,) * len(fused)
    numbers = (fused.ids & (2**31 - 1)).astype(np.int32)
    return replace(record, id=numbers, class_names=fused.labels, box_3d_ids=none, box_2d_ids=none, **columns)


def declared_columns(
    fused: FusedBoxes, declared_from_standard: Float64Array, camera: Camera
) -> tuple[dict[str, Any], bool]:
    """The columns of numbers of objects as records of table 10 have them, and whether all of them make sense.

    Scores are cut to 0 to 1, covariances made symmetric, and boxes rounded outwards to whole pixels within the camera's
    image. Objects make sense where all numbers are finite, no size or variance is below 0, no box is inside out, and
    what a lidar saw has a size.

    Args:
        declared_from_standard: (3, 3) float64, a signed permutation: from the standard axes of the lidar to those of
            the record.
    """
    rotation, none = declared_from_standard, np.zeros(len(fused))
    velocities = np.zeros((len(fused), 3)) if fused.velocities is None else fused.velocities
    with np.errstate(invalid="ignore", over="ignore"):
        headings = np.stack([np.cos(fused.yaws), np.sin(fused.yaws), none], axis=1)
        numbers = {
            "confidence": np.clip(fused.scores, 0.0, 1.0),
            "centers": fused.centers @ rotation.T,
            "center_covs": _symmetric(rotation @ fused.center_covariances @ rotation.T),
            "sizes_lwh": fused.sizes_lwh,
            "size_covs": _symmetric(fused.size_covariances),
            "directions": headings @ rotation.T,
            "velocities": (velocities * headings).sum(axis=1),
            "velocity_vectors": velocities @ rotation.T,
        }
        columns: dict[str, Any] = {name: values.astype(np.float32) for name, values in numbers.items()}
    corners = whole_corners(fused.corners_xyxy, (camera.width, camera.height))
    sizes, seen = columns["sizes_lwh"], fused.rows_3d != NO_BOX
    variances = np.diagonal([columns["center_covs"], columns["size_covs"]], axis1=2, axis2=3)
    sound = (
        all(np.isfinite(values).all() for values in columns.values())
        and (variances >= 0.0).all()
        and (sizes >= 0.0).all()
        and (sizes[seen] > 0.0).all()
        and (corners[:, :2] <= corners[:, 2:]).all()
    )
    # what is cut off at the image's edge is beside the view, and has no outline
    corners[~(corners[:, 2:] > corners[:, :2]).all(axis=1)] = 0
    columns["corners_xyxy"] = corners
    if fused.velocities is None:
        columns["velocity_vectors"] = None
    return columns, bool(sound)


def _symmetric(matrices: Float64Array) -> Float64Array:
    return (matrices + matrices.transpose(0, 2, 1)) / 2.0


def _numbers(rows: Int64Array, boxes: Boxes3d | Boxes2d) -> tuple[int | None, ...]:
    ids = boxes.id.tolist()
    return tuple(None if row == NO_BOX else ids[row] for row in rows.tolist())
