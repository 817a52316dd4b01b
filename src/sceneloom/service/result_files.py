"""Where fetched results are written: JSON lines, a folder of depth images, images and points, or a scene file."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote
from zipfile import ZIP_DEFLATED, ZipFile

import msgspec
import numpy as np

from sceneloom.db34t.events import Result
from sceneloom.db34t.json import to_json
from sceneloom.db34t.records import ENCODINGS, FusedDetections, SensorFusionData
from sceneloom.db34t.scene_objects import lidar_frame_of_result
from sceneloom.db34t.types import bytes_of
from sceneloom.errors import OptionError
from sceneloom.formats.base.images import encode_jpeg, write_depth_image
from sceneloom.formats.base.output import filling, replacing
from sceneloom.formats.sfs.writer import SceneWriter
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.frames import LazyFrames


def described(result: Result) -> dict[str, Any]:
    """A result as a JSON object with the standard's names; arrays of sensor data are left out."""
    if isinstance(result.record, FusedDetections):
        return {"number": result.number, **to_json(result.record, lists=True)}
    content = to_json(result.record)
    for name in ("image_data", "image_depth", "point_data"):
        content.pop(name, None)
    return {"number": result.number, **content}


@contextmanager
def open_sink(
    path: Path, *, detections: bool, overwrite: bool = False
) -> "Iterator[JsonLines | SceneFile | ResultFolder]":
    """Give what writes results to a path; it is there, whole, when the block ends without an error.

    Args:
        path: of detections a file of JSON lines; of sensor data a scene file, `.sfs`, else a folder.
        detections: whether detections are fetched, rather than sensor data.

    Raises:
        OutputError: it is there, or cannot be written.
    """
    if detections:
        with replacing(path, overwrite=overwrite) as draft, draft.open("wb") as file:
            yield JsonLines(file)
    elif path.suffix.lower() == ".sfs":
        with SceneWriter(path, overwrite=overwrite) as writer:
            yield SceneFile(writer)
    else:
        with filling(path, overwrite=overwrite) as folder:
            yield ResultFolder(folder)


@dataclass(slots=True)
class JsonLines:
    """Writes one object a line."""

    file: BinaryIO

    def add(self, result: Result) -> None:
        """Take one result."""
        self.file.write(msgspec.json.encode(described(result)) + b"\n")


@dataclass(slots=True)
class SceneFile:
    """Writes the points of sensor data, coloured by the camera, as sweeps of one lidar for each pair of sensors."""

    writer: SceneWriter
    _known: set[str] = field(default_factory=set)

    def add(self, result: Result) -> None:
        """Take one result.

        Raises:
            OptionError: its points are in the camera's frame.
        """
        record = _sensor_data(result)
        if record.point_frame == "camera":
            raise OptionError("points in the camera's frame; expected the property reference_frame to be 1")
        name = f"lidar{record.lidar_id}_camera{record.camera_id}"
        if name not in self._known:
            self._known.add(name)
            self.writer.add_sensor(LidarSensor(name, LazyFrames.of([], [])))
        frame = lidar_frame_of_result(record)
        self.writer.add_frame(name, LidarFrame(frame.timestamp_ns, frame.points))


@dataclass(slots=True)
class ResultFolder:
    """Writes sensor data: `results.jsonl`, and of each result a depth image, an image and the points.

    `depth/NNNNNN.png` has 16 bits, metres times 256; `points/NNNNNN.npz` one array for each field;
    names that could be paths are percent-encoded there.
    """

    folder: Path

    def add(self, result: Result) -> None:
        """Take one result."""
        record, name = _sensor_data(result), f"{result.number:06d}"
        is_png = record.encoding == "png"
        files = {
            "depth": f"depth/{name}.png",
            "points": f"points/{name}.npz",
            "image": f"images/{name}.{'png' if is_png else 'jpg'}",
        }
        paths = {part: self.folder / file for part, file in files.items()}
        for path in paths.values():
            path.parent.mkdir(exist_ok=True)
        beyond = write_depth_image(record.depths, paths["depth"])
        _write_columns(paths["points"], record)
        pixels = record.pixels
        if pixels is None:
            paths["image"].write_bytes(bytes_of(record.image_data))
        else:
            paths["image"].write_bytes(encode_jpeg(ENCODINGS[record.encoding].rgb(pixels)))
        line = described(result) | {
            "depth": files["depth"],
            "depth_beyond_range": beyond,
            "points": files["points"],
            "image": files["image"],
        }
        with (self.folder / "results.jsonl").open("ab") as lines:
            lines.write(msgspec.json.encode(line) + b"\n")


def _write_columns(path: Path, record: SensorFusionData) -> None:
    """Write an `.npz` with one array for each field of the points; names come from anywhere, and are no paths."""
    with ZipFile(path, "w", ZIP_DEFLATED) as archive:
        for k, name in enumerate(record.point_fields):
            plain = name if name.isprintable() and not set(name) & set("/\\:") else quote(name, safe="")
            with archive.open(f"{plain}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.ascontiguousarray(record.points[:, k]), allow_pickle=False)


def _sensor_data(result: Result) -> SensorFusionData:
    if not isinstance(result.record, SensorFusionData):
        raise OptionError(f"a result of {type(result.record).__name__}; expected sensor data")
    return result.record
