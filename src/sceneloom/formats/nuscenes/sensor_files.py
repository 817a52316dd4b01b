"""Sweeps, radar cycles and images of nuScenes: read when they are asked for, and written."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError
from sceneloom.formats.base.images import ImageFile, is_jpeg
from sceneloom.formats.base.losses import Loss, Support
from sceneloom.formats.points.cloud import NUSCENES, Cloud
from sceneloom.formats.points.npz import read_bin
from sceneloom.formats.points.pcd import read_pcd
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame, LidarPoints, RadarFrame, RadarPoints
from sceneloom.scene.types import PointsFrame

_Facts = tuple[tuple[str, Any], ...]
"""What the tables state about a file, as pairs of name and value."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameFiles:
    """The files of one sensor.

    Attributes:
        files: of each frame.
        timestamps_ns: (N,) int64 [ns].
        facts: of each frame, for its `extras`.
    """

    files: tuple[Path, ...]
    timestamps_ns: Int64Array
    facts: tuple[_Facts, ...]

    def timestamp(self, k: int) -> int:
        """The time of frame `k` [ns]."""
        return int(self.timestamps_ns[k])

    def extras(self, k: int) -> MappingProxyType[str, Any]:
        """What the tables state about frame `k`."""
        return MappingProxyType(dict(self.facts[k]))


@dataclass(frozen=True, slots=True, eq=False)
class SweepFiles:
    """Reads the sweeps of a lidar; every row of a file stays a point, since labels count the rows."""

    frames: FrameFiles

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`.

        Raises:
            DataError: the file is missing, cut off or no cloud.
        """
        return LidarFrame(
            self.frames.timestamp(k), _lidar_points(self.frames.files[k]), self.frames.extras(k)
        )


def _lidar_points(file: Path) -> LidarPoints:
    is_pcd = file.suffix.lower() == ".pcd"
    cloud = read_pcd(file) if is_pcd else read_bin(file, layout=NUSCENES)
    extras: dict[str, AnyArray] = {}
    return LidarPoints(
        positions=_positions(cloud),
        intensities=_whole(cloud, "intensity", np.uint8, extras),
        rings=_whole(cloud, "ring", np.uint16, extras),
        extras=MappingProxyType(extras),
    )


def _positions(cloud: Cloud) -> Float32Array:
    missing = [axis for axis in "xyz" if axis not in cloud.columns]
    if missing:
        problem = f"no column {' or '.join(missing)}; it has {' '.join(cloud.columns) or 'none'}"
        raise DataError(cloud.file, "", problem)
    return read_only(np.stack([cloud.columns[axis] for axis in "xyz"], axis=1), np.float32)


def _whole(cloud: Cloud, name: str, dtype: type[Any], extras: dict[str, AnyArray]) -> Any:
    """A column as whole numbers; what that changes of it is kept beside it."""
    column = cloud.columns.get(name)
    if column is None:
        return None
    limit = np.iinfo(dtype)
    rounded = np.clip(np.rint(np.nan_to_num(column, nan=0.0)), limit.min, limit.max)
    if not np.array_equal(rounded, column):
        extras[name] = read_only(column)
    return read_only(rounded, dtype)


@dataclass(frozen=True, slots=True, eq=False)
class CycleFiles:
    """Reads the cycles of a radar."""

    frames: FrameFiles

    def __call__(self, k: int) -> RadarFrame:
        """Read cycle `k`.

        Raises:
            DataError: the file is missing, cut off or no cloud.
        """
        cloud = _returns(read_pcd(self.frames.files[k]))
        positions = _positions(cloud)
        directions, lengths = _velocities(cloud, positions)
        further = {name: read_only(c) for name, c in cloud.columns.items() if name not in "xyz"}
        points = RadarPoints(positions, directions, lengths, extras=MappingProxyType(further))
        return RadarFrame(self.frames.timestamp(k), points, self.frames.extras(k))


def _returns(cloud: Cloud) -> Cloud:
    """The returns of a cycle: one without any has a single row that is no number.

    Source: class RadarPointCloud of the development kit.
    """
    first = [cloud.columns[axis][:1] for axis in "xyz" if axis in cloud.columns]
    if not any(np.isnan(value).any() for value in first):
        return cloud
    return Cloud(cloud.file, 0, {name: column[:0] for name, column in cloud.columns.items()})


def _velocities(cloud: Cloud, positions: Float32Array) -> tuple[Float32Array | None, Float32Array | None]:
    """Direction and length of `vx`, `vy`; what does not move points along the line of sight.

    Source: class RadarPointCloud of the development kit: vx and vy are measured, vx_comp and vy_comp compensated.
    """
    if not {"vx", "vy"} <= cloud.columns.keys():
        return None, None
    velocities = np.zeros((cloud.count, 3))
    velocities[:, 0], velocities[:, 1] = cloud.columns["vx"], cloud.columns["vy"]
    lengths = np.linalg.norm(velocities, axis=1)
    distances = np.linalg.norm(positions.astype(np.float64), axis=1)
    directions = np.tile([1.0, 0.0, 0.0], (cloud.count, 1))
    placed, moving = distances > 0, lengths > 0
    directions[placed] = positions[placed] / distances[placed, None]
    directions[moving] = velocities[moving] / lengths[moving, None]
    return read_only(directions, np.float32), read_only(lengths, np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class ImageFiles:
    """Reads the images of a camera.

    Attributes:
        cameras: camera model of each image.
        mounts: `ego_from_camera` of each image, None where it is the camera's.
    """

    frames: FrameFiles
    cameras: tuple[Camera, ...]
    mounts: tuple[RigidTransform | None, ...]

    def __call__(self, k: int) -> CameraImage:
        """Make image `k` without decoding it."""
        camera = self.cameras[k]
        file = ImageFile(self.frames.files[k], camera.width, camera.height)
        encoded = file.encoded if is_jpeg(file.path) else None
        return CameraImage(
            self.frames.timestamp(k),
            camera,
            file,
            self.mounts[k],
            extras=self.frames.extras(k),
            encoded=encoded,
        )


_JPEG_QUALITY = 95
"""Of images that come from a video or from memory."""

_RADAR = (
    *((name, "F", 4) for name in ("x", "y", "z")),
    *(("dyn_prop", "I", 1), ("id", "I", 2), ("rcs", "F", 4)),
    *((name, "F", 4) for name in ("vx", "vy", "vx_comp", "vy_comp")),
    *((name, "I", 1) for name in ("is_quality_valid", "ambig_state", "x_rms", "y_rms")),
    *((name, "I", 1) for name in ("invalid_state", "pdh0", "vx_rms", "vy_rms")),
)
"""Name, type and size of the columns of radar files. Source: class RadarPointCloud of the development kit."""

_RADAR_ROW = np.dtype([(name, f"<{letter.lower()}{size}") for name, letter, size in _RADAR])

_USUAL = {"is_quality_valid": 1, "ambig_state": 3}
"""What a return has to state for the development kit to show it; all other numbers are 0."""


@dataclass(slots=True)
class FrameLosses:
    """What is lost of frames, counted."""

    counts: Counter[tuple[str, str, Support]] = field(default_factory=Counter)
    largest: dict[tuple[str, str, Support], float] = field(default_factory=dict)

    def add(
        self,
        name: str,
        what: str,
        count: int,
        support: Support = Support.DROPPED,
        *,
        error: float | None = None,
    ) -> None:
        """Count a loss; a count of 0 is none."""
        if count:
            self.counts[name, what, support] += count
            if error is not None:
                self.largest[name, what, support] = max(error, self.largest.get((name, what, support), 0.0))

    def __iter__(self) -> Iterator[Loss]:
        for (name, what, support), count in self.counts.items():
            worst = self.largest.get((name, what, support))
            yield Loss(field=name, what=what, count=count, support=support, largest_error=worst)


def in_sensor_frame(
    positions: AnyArray, points_frame: PointsFrame, mount: RigidTransform, world_from_ego: RigidTransform
) -> Float64Array | AnyArray:
    """Points (N, 3) [m] in the sensor's frame, by the pose and mounting that are written beside them."""
    if points_frame is PointsFrame.SENSOR:
        return positions
    here = mount if points_frame is PointsFrame.EGO else world_from_ego @ mount
    return here.inverse().apply(positions)


def write_sweep(path: Path, frame: LidarFrame, positions: AnyArray, losses: FrameLosses) -> None:
    """Write a sweep as rows of x, y, z, intensity and ring."""
    points = frame.points
    rows = np.zeros(len(points), NUSCENES.dtype)
    rows["x"], rows["y"], rows["z"] = np.asarray(positions).T
    for name, column in (("intensity", points.intensities), ("ring", points.rings)):
        if column is not None:
            rows[name] = column
    location = "sensors.lidar.frames.points"
    count = len(points)
    if points.timestamps_ns is not None:
        losses.add(f"{location}.timestamps_ns", "points have no times", count)
    for name in ("colors", "camera_index"):
        if getattr(points, name) is not None:
            losses.add(f"{location}.{name}", "points have x, y, z, intensity and ring", count)
    if points.extras:
        losses.add(f"{location}.extras", "points have x, y, z, intensity and ring", count)
    path.write_bytes(rows.tobytes())


def write_cycle(path: Path, frame: RadarFrame, positions: AnyArray, losses: FrameLosses) -> None:
    """Write a radar cycle as a PCD file; one without returns has a return that is no number, as nuScenes has it."""
    points = frame.points
    count = len(points)
    rows = np.zeros(max(count, 1), _RADAR_ROW)
    rows["x"] = np.nan if count == 0 else 0.0
    location = "sensors.radar.frames.points"
    if count:
        for axis, column in zip("xyz", np.asarray(positions).T, strict=True):
            rows[axis] = column
        _fill_radar(rows, points.extras)
        _fill_velocities(rows, frame, losses)
    known = set(_RADAR_ROW.names or ())
    if set(points.extras) - known:
        losses.add(f"{location}.extras", "returns have the columns of nuScenes' radars", count)
    if points.timestamps_ns is not None:
        losses.add(f"{location}.timestamps_ns", "points have no times", count)
    # the development kit wants a byte after the last row, as nuScenes' own files have one
    path.write_bytes(_pcd_head(len(rows)) + rows.tobytes() + b"\n")


def _fill_radar(rows: AnyArray, extras: Any) -> None:
    for name, _, _ in _RADAR[3:]:
        column = extras.get(name)
        usable = column is not None and column.shape == rows.shape and column.dtype.kind in "fiub"
        rows[name] = column if usable else _USUAL.get(name, 0)
    if "id" not in extras:
        rows["id"] = np.arange(len(rows)) % (1 << 15)


def _fill_velocities(rows: AnyArray, frame: RadarFrame, losses: FrameLosses) -> None:
    points, location = frame.points, "sensors.radar.frames.points"
    if points.directions is None or points.lengths is None:
        return
    velocities = points.directions * points.lengths[:, None]
    if "vx" not in points.extras or "vy" not in points.extras:
        rows["vx"], rows["vy"] = velocities[:, 0], velocities[:, 1]
        upright = np.abs(velocities[:, 2])
        what = "the part of the speed along the sensor's z is left out [m/s]"
        error = float(upright.max(initial=0.0))
        losses.add(
            f"{location}.directions", what, int((upright > 0).sum()), Support.APPROXIMATED, error=error
        )
    if "vx_comp" not in points.extras:
        rows["vx_comp"], rows["vy_comp"] = rows["vx"], rows["vy"]


def _pcd_head(count: int) -> bytes:
    lines = (
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(name for name, _, _ in _RADAR)}",
        f"SIZE {' '.join(str(size) for _, _, size in _RADAR)}",
        f"TYPE {' '.join(letter for _, letter, _ in _RADAR)}",
        f"COUNT {' '.join('1' for _ in _RADAR)}",
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        "DATA binary",
    )
    return ("\n".join(lines) + "\n").encode()


def write_image(stem: Path, image: CameraImage, form: str, losses: FrameLosses) -> Path:
    """Write an image: a JPEG or PNG file as it is, else anew; gives its path, with its suffix.

    Args:
        stem: the path without suffix.
        image: what is written.
        form: "copy" writes anew what is no such file as JPEG, "png" everything that is no PNG as PNG.
        losses: takes what is lost.

    Raises:
        DataError: it cannot be decoded.
    """
    source = image.decode
    is_png = isinstance(source, ImageFile) and source.path.suffix.lower() == ".png"
    if is_png or form == "png":
        path = stem.with_name(f"{stem.name}.png")
        path.write_bytes(source.encoded() if isinstance(source, ImageFile) and is_png else _png(image))
        return path
    path = stem.with_name(f"{stem.name}.jpg")
    if image.encoded is not None:
        path.write_bytes(image.encoded())
        return path
    from simplejpeg import encode_jpeg

    rgb = np.ascontiguousarray(image.rgb)
    path.write_bytes(encode_jpeg(rgb, _JPEG_QUALITY, "RGB", colorsubsampling="444"))
    what = f"encoded as JPEG of quality {_JPEG_QUALITY}"
    losses.add("sensors.camera.images.rgb", what, 1, Support.APPROXIMATED)
    return path


def _png(image: CameraImage) -> bytes:
    from io import BytesIO

    from PIL import Image

    content = BytesIO()
    Image.fromarray(image.rgb).save(content, "PNG", compress_level=1)
    return content.getvalue()
