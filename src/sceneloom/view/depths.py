"""Depth images: of cameras that measure depth, and those that fusion wrote."""

import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float32Array, UInt16Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.undistortion import Undistortion, undistorted_camera
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.depth_images import read_depth_png
from sceneloom.formats.files import check_regular, file_faults, open_file
from sceneloom.scene.depth import DepthCameraSensor, DepthFrame
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier
from sceneloom.view.feeds import Feed, Report
from sceneloom.view.images import PlacedCamera, image_path
from sceneloom.view.sdk import sdk
from sceneloom.view.stream import Stream

_STEPS_PER_METRE = 256
"""Shown depths are whole steps of 1/256 m, as in KITTI's depth images: 4 mm, up to 256 m."""
_LARGEST = 65535

DEPTH = "depth"
"""The entity of fused depth images, below that of the images that they belong to."""


def depth_image(depths: Float32Array) -> Any:
    """An image of depths (H, W) [m], 0 for none, as the viewer takes it."""
    steps: UInt16Array = np.clip(np.rint(np.nan_to_num(depths) * _STEPS_PER_METRE), 0, _LARGEST).astype(
        np.uint16
    )
    rr = sdk()
    near = steps[steps > 0]
    farthest = float(np.percentile(near, 98)) if len(near) else _LARGEST
    return rr.DepthImage(steps, meter=_STEPS_PER_METRE, depth_range=[0, farthest], colormap="turbo")


@dataclass(slots=True, eq=False)
class Straightener:
    """Resamples depth images to a pinhole by the nearest pixel: no depth between two others is made up."""

    known: Undistortion | None = None

    def straight(self, camera: Camera, depths: Float32Array) -> tuple[Camera, Float32Array]:
        """Give the camera model that is shown, and the depths as it sees them.

        Raises:
            CalibrationError: no pinhole can stand for the camera model.
        """
        if camera.model == "pinhole":
            return camera, depths
        if self.known is None or self.known.source != camera:
            self.known = Undistortion.between(camera, undistorted_camera(camera))
        locations = np.nan_to_num(self.known.locations, nan=-1.0)
        columns, rows = (np.rint(locations[..., axis]).astype(np.int64) for axis in (0, 1))
        inside = self.known.seen
        limits = np.clip(rows, 0, camera.height - 1), np.clip(columns, 0, camera.width - 1)
        return self.known.target, np.where(inside, depths[limits], np.float32(0.0))


@dataclass(frozen=True, slots=True, eq=False)
class DepthView:
    """Shows the images of one depth camera."""

    camera: PlacedCamera
    frames: Any
    straightener: Straightener

    def log(self, k: int, _: None) -> None:
        """Log image `k`."""
        frame: DepthFrame = self.frames[k]
        stream = self.camera.stream
        camera_model, depths = self.straightener.straight(frame.camera, frame.depth)
        self.camera.log(frame.timestamp_ns, camera_model, frame.mount)
        path = image_path(stream, self.camera.sensor.id)
        stream.log(frame.timestamp_ns, path, depth_image(depths), kind="depth images", size=2 * depths.size)


def depth_feed(camera: PlacedCamera, sensor: DepthCameraSensor, notify: Report) -> Feed | None:
    """Show a depth camera; None where no pinhole can stand for its camera model."""
    if sensor.camera.model != "pinhole":
        try:
            undistorted_camera(sensor.camera)
        except CalibrationError as error:
            notify("camera-model-left", f"sensors[{sensor.id!r}]", f"its depth images are not shown: {error}")
            return None
    return Feed(sensor.frames.timestamps_ns, DepthView(camera, sensor.frames, Straightener()).log)


class _Entry(msgspec.Struct, frozen=True):
    """A line of the index that a folder of depth images has."""

    file: str
    sweep_ns: int
    camera: Identifier
    image_ns: int


def written_depths(folder: Path) -> Iterator[_Entry]:
    """The images of a folder that `fuse --depth` or `depth` wrote, by its index.

    Raises:
        DataError: the index is missing or faulty.
    """
    index = folder / "index.jsonl"
    if not index.is_file():
        raise DataError(index, "", "is missing; expected the folder that `fuse --depth` or `depth` wrote")
    with file_faults(index), open_file(index) as lines:
        for number, line in enumerate(lines, start=1):
            try:
                yield msgspec.json.decode(line, type=_Entry)
            except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
                raise DataError(index, f"line {number}", f"{error}; expected a depth image") from error


@dataclass(frozen=True, slots=True, eq=False)
class FusedDepthView:
    """Shows depth images of a folder over the images that they belong to.

    They are in the camera's own, distorted grid; a straightened camera takes them straightened the same way.
    """

    stream: Stream
    folder: Path
    entries: tuple[_Entry, ...]
    maps: dict[Identifier, Undistortion | None]

    def log(self, k: int, _: None) -> None:
        """Log image `k`."""
        entry = self.entries[k]
        depths = _read(self.folder / entry.file)
        undistortion = self.maps.get(entry.camera)
        if undistortion is not None:
            depths = Straightener(undistortion).straight(undistortion.source, depths)[1]
        path = f"{image_path(self.stream, entry.camera)}/{DEPTH}"
        self.stream.log(
            entry.image_ns, path, depth_image(depths), kind="fused depth images", size=2 * depths.size
        )


def fused_depth_feed(stream: Stream, folder: Path, measured: Scene, shown: Scene) -> Feed:
    """Show a folder of depth images.

    Args:
        stream: where to.
        folder: of the images.
        measured: the scene with its own camera models, in whose grids the images are.
        shown: the scene with the camera models that are shown.

    Raises:
        DataError: the index is missing or faulty.
    """
    camera_models = {camera.id: camera.camera for camera in measured.cameras}
    ends = {camera.id: camera.camera for camera in shown.cameras}
    maps = {
        camera_id: Undistortion.between(camera_model, ends[camera_id])
        if camera_model != ends[camera_id] and camera_model.model != "pinhole"
        else None
        for camera_id, camera_model in camera_models.items()
    }
    entries = sorted(
        (e for e in written_depths(folder) if e.camera in camera_models), key=lambda e: e.image_ns
    )
    times_ns = np.array([entry.image_ns for entry in entries], np.int64)
    return Feed(times_ns, FusedDepthView(stream, folder, tuple(entries), maps).log)


def _read(path: Path) -> Float32Array:
    with file_faults(path):
        try:
            if path.suffix == ".npz":
                check_regular(path)
                with np.load(path) as arrays:
                    return np.asarray(arrays["depth"], np.float32)
            return read_depth_png(path)
        except (ValueError, KeyError, EOFError, SyntaxError, zipfile.BadZipFile, zlib.error) as error:
            raise DataError(path, "", f"cannot be read as a depth image: {error}") from error
