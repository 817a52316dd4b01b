"""The files of sweeps, radar cycles and images."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.formats.clouds.layout import NUSCENES
from sceneloom.formats.loss import Loss, Support
from sceneloom.formats.rig.images import ImageFile
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame, RadarFrame
from sceneloom.scene.types import PointsFrame

JPEG_QUALITY = 95
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
    path.write_bytes(encode_jpeg(rgb, JPEG_QUALITY, "RGB", colorsubsampling="444"))
    what = f"encoded as JPEG of quality {JPEG_QUALITY}"
    losses.add("sensors.camera.images.rgb", what, 1, Support.APPROXIMATED)
    return path


def _png(image: CameraImage) -> bytes:
    from io import BytesIO

    from PIL import Image

    content = BytesIO()
    Image.fromarray(image.rgb).save(content, "PNG", compress_level=1)
    return content.getvalue()
