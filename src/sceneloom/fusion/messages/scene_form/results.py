"""Results of sensor-data fusion as records of table 9, and such records in the scene model."""

from collections.abc import Sequence
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float32Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import unproject
from sceneloom.colouring.results import FusedFrame, FusedView
from sceneloom.errors import OptionError
from sceneloom.fusion.messages.fused import DEPTH_KINDS, SensorFusionData
from sceneloom.fusion.messages.scene_form.clouds import fields_of, point_columns
from sceneloom.fusion.messages.sensor_data import ImageData
from sceneloom.fusion.messages.tables import SENSOR_FUSION
from sceneloom.fusion.messages.timestamps import Timestamp
from sceneloom.kernels.depth_images import draw_depths
from sceneloom.scene.clouds import LidarPoints
from sceneloom.scene.depth import DepthFrame


def sensor_fusion_of(
    frame: FusedFrame,
    view: FusedView,
    points: LidarPoints,
    *,
    camera_id: int,
    lidar_id: int,
    image_seq: int,
    points_seq: int,
    depth_kind: str = "z",
    point_frame: str = "lidar",
    motion_compensated: bool = False,
    fields: Sequence[str] | None = None,
    image: ImageData | None = None,
) -> SensorFusionData:
    """Give the record of a sweep and one of the images that it was paired with.

    Args:
        frame: the sweep.
        view: the image.
        points: the points to give, in the frame that `point_frame` names.
        camera_id, lidar_id: numbers of the sensors in the record.
        image_seq, points_seq: numbers of the image and of the sweep.
        depth_kind: "z" along the optical axis, or "range" along the ray, from the camera's centre.
        point_frame: "lidar" or "camera".
        motion_compensated: whether the ego trajectory was taken into account.
        fields: what to give of each point; None for all that there is.
        image: the image as it was sent, whose encoding and data the record gets; None for its pixels as rgb8.

    Raises:
        DataError: a number cannot stand in the record.
        OptionError: the kind of depth is not known, or the points have no such field.
    """
    if depth_kind not in DEPTH_KINDS:
        raise OptionError(f"depth_kind {depth_kind!r}; expected one of {', '.join(DEPTH_KINDS)}")
    names = tuple(fields_of(points) if fields is None else fields)
    data = point_columns(points, names, frame.timestamp_ns)
    return SensorFusionData(
        timestamp=Timestamp.of(frame.timestamp_ns),
        image_seq=image_seq,
        points_seq=points_seq,
        camera_id=camera_id,
        lidar_id=lidar_id,
        height=view.camera.height,
        width=view.camera.width,
        encoding="rgb8" if image is None else image.encoding,
        image_channel=3 if image is None else image.channel,
        image_data=view.rgb if image is None else image.data,
        image_depth=view.depth_image if depth_kind == "z" else range_image(frame, view),
        point_num=len(data),
        point_fields=names,
        fields_number=len(names),
        point_data=data,
        depth_kind=depth_kind,
        point_frame=point_frame,
        motion_compensated=motion_compensated,
        image_timestamp=Timestamp.of(view.timestamp_ns),
    )


def range_image(frame: FusedFrame, view: FusedView) -> Float32Array:
    """Draw how far the visible points are from the camera's centre.

    Returns:
        (H, W) float32 [m], the nearest point of each pixel, 0 for none.
    """
    positions_world = frame.points.positions[view.point_ids].astype(np.float64)
    ranges = np.linalg.norm(positions_world - view.world_from_camera.translation, axis=1)
    image = np.zeros((view.camera.height, view.camera.width), np.float32)
    draw_depths(view.pixel_numbers, ranges.astype(np.float32), view.visible, image)
    return image


def depth_frame_of(record: SensorFusionData, camera: Camera) -> DepthFrame:
    """Give the depth image of a result; distances along the rays become depths along the axis at the pixels' centres.

    A record that does not state which kind it holds is taken to hold depths along the axis.

    Raises:
        DataError: the result's size is not that of the camera.
    """
    for name in ("width", "height"):
        if getattr(record, name) != getattr(camera, name):
            problem = f"{getattr(record, name)}; expected {getattr(camera, name)} as in the calibration"
            raise SENSOR_FUSION.fault(name, problem)
    timestamp = record.timestamp if record.image_timestamp is None else record.image_timestamp
    depth = record.depths
    if record.depth_kind == "range":
        depth = _along_axis(depth, camera)
    frame = DepthFrame.of(timestamp.nanoseconds, camera, depth)
    extras = MappingProxyType({"sensor_id": record.camera_id, "seq": record.image_seq})
    return DepthFrame(frame.timestamp_ns, camera, frame.decode, extras=extras)


def _along_axis(ranges: Float32Array, camera: Camera) -> Float32Array:
    rows, columns = np.nonzero(ranges)
    rays = unproject(camera, np.column_stack([columns, rows]).astype(np.float64))
    depth = np.zeros_like(ranges)
    depth[rows, columns] = ranges[rows, columns] * np.nan_to_num(np.maximum(rays[:, 2], 0.0))
    return depth
