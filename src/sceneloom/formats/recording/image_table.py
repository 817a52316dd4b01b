"""The images of one camera of a recording: small columns, from which each image is made when asked for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any, ClassVar

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError
from sceneloom.formats.files import open_file
from sceneloom.formats.identity import FileIdentity
from sceneloom.formats.recording.column_arrays import nanoseconds, time_order, view
from sceneloom.formats.recording.columns import CameraColumns, FrameColumns
from sceneloom.formats.recording.image_files import ImageFiles
from sceneloom.formats.recording.json_faults import DECODER_FAULTS
from sceneloom.formats.recording.line_shapes import FrameEntry
from sceneloom.formats.recording.old_forms import has_old_frame, with_frames
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage

_HELD_KEYS = frozenset(FrameEntry.__struct_fields__)

OWN_FIELDS = frozenset({"file_seconds", "number", "line_seconds", "line", "entry"})
"""Extras of an image that are no fields of its entry; fields of these names are under "entry"."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageTable:
    """The images of one camera, in time order.

    Attributes:
        camera_index: `cameraInd`.
        camera: the camera model of images that have none of their own.
        timestamps_ns: (N,) int64 [ns].
        seconds: (N,) float64 [s], as the file has them.
        line_seconds: (N,) float64 [s], `time` of the line that each image is in.
        numbers: (N,) int64, `number` of that line.
        offsets: (N,) int64, byte at which that line begins if it says more, else -1.
        indices: (N,) int64, location among the encoded images.
        camera_model_texts: (N,) int64, key in `camera_models`, -1 for none.
        mount_texts: (N,) int64, key in `mounts`, -1 for none.
        camera_models: camera models of single images.
        mounts: mountings of single images, `ego_from_camera`.
        texts: every different text of a camera model or mounting of single images.
        missing: how many entries have no image (`missingBitmap`).
        data_file: `data.jsonl`, as it was when its lines were read.
    """

    OWN: ClassVar[int] = -1

    camera_index: int
    camera: Camera
    timestamps_ns: Int64Array
    seconds: Float64Array
    line_seconds: Float64Array
    numbers: Int64Array
    offsets: Int64Array
    indices: Int64Array
    camera_model_texts: Int64Array
    mount_texts: Int64Array
    camera_models: Mapping[int, Camera]
    mounts: Mapping[int, RigidTransform]
    texts: Sequence[bytes]
    missing: int
    data_file: FileIdentity

    def image(self, k: int, *, files: ImageFiles | None) -> CameraImage:
        """Make image `k`; a table with images has files.

        Raises:
            DataError: `data.jsonl` was changed since it was opened.
        """
        decode = _no_pixels if files is None else files.rgb
        return CameraImage(
            timestamp_ns=int(self.timestamps_ns[k]),
            camera=self.camera_models.get(int(self.camera_model_texts[k]), self.camera),
            decode=partial(decode, int(self.indices[k])),
            mount=self.mounts.get(int(self.mount_texts[k])),
            extras=MappingProxyType(self._extras(k)),
        )

    def _extras(self, k: int) -> dict[str, Any]:
        extras: dict[str, Any] = {"file_seconds": float(self.seconds[k]), "number": int(self.numbers[k])}
        if self.line_seconds[k] != self.seconds[k]:
            extras["line_seconds"] = float(self.line_seconds[k])
        for name, location in (
            ("cameraParameters", self.camera_model_texts[k]),
            ("imuToCamera", self.mount_texts[k]),
        ):
            if location != self.OWN:
                extras[name] = msgspec.json.decode(self.texts[location])
        return {**extras, **further_fields(self.data_file, int(self.offsets[k]), self.camera_index)}

    def first_fields(self) -> dict[str, Any]:
        """Give what the first image's line says beyond the columns."""
        return (
            further_fields(self.data_file, int(self.offsets[0]), self.camera_index)
            if len(self.offsets)
            else {}
        )


def further_fields(data_file: FileIdentity, offset: int, camera_index: int) -> dict[str, Any]:
    """Read again what a line says beyond the columns: lists of features can be long, so they are not kept.

    Args:
        data_file: `data.jsonl`, as it was when its lines were read.
        offset: byte at which the line begins, -1 for one that says nothing more.
        camera_index: `cameraInd` of the entry.

    Returns:
        Further fields of the entry, and under "line" those beside `frames`; under "entry" fields of the entry whose
        names are taken.

    Raises:
        DataError: the file was changed since it was opened.
    """
    if offset < 0:
        return {}
    data_file.check()
    try:
        with open_file(data_file.path) as file:
            file.seek(offset)
            line = msgspec.json.decode(file.readline())
        line = with_frames(line) if has_old_frame(line) else line
        entry = next(entry for entry in line["frames"] if entry["cameraInd"] == camera_index)
    except (OSError, *DECODER_FAULTS, KeyError, TypeError, StopIteration) as error:
        raise DataError(data_file.name, f"byte {offset}", "was changed after it was opened") from error
    further = {key: value for key, value in entry.items() if key not in _HELD_KEYS | OWN_FIELDS}
    hidden = {key: value for key, value in entry.items() if key in OWN_FIELDS}
    if entry.get("missingBitmap") is False:
        further["missingBitmap"] = False
    if hidden:
        further["entry"] = hidden
    beside = {key: value for key, value in line.items() if key not in {"frames", "number", "time"}}
    return {**further, "line": beside} if beside else further


def _no_pixels(index: int) -> UInt8Array:
    raise DataError("", f"image {index}", "there are no images")


def build_table(
    camera_index: int,
    camera: Camera,
    frames: FrameColumns,
    indices: Int64Array,
    camera_models: Mapping[int, Camera],
    mounts: Mapping[int, RigidTransform],
    data_file: FileIdentity,
    *,
    shift: float = 0.0,
) -> ImageTable:
    """Bring a camera's entries into the order of time; those without image, camera model or mounting are left out.

    Args:
        camera: the camera model of entries that have none of their own.
        frames: the frames lines.
        indices: (N,) int64, the image of each entry, -1 for none.
        camera_models: by number of their text.
        mounts: by number of their text.
        shift: what is added to the file's times [s].
    """
    columns = frames.cameras.get(camera_index, CameraColumns())
    camera_model_texts, mount_texts = (
        np.asarray(columns.parameters, np.int64),
        np.asarray(columns.mounts, np.int64),
    )
    missing = np.asarray(columns.missing, np.bool_)
    usable = (indices >= 0) & ~missing
    usable &= np.isin(camera_model_texts, [ImageTable.OWN, *camera_models]) & np.isin(
        mount_texts, [ImageTable.OWN, *mounts]
    )
    seconds = view(columns.seconds)
    chosen = np.flatnonzero(usable)[time_order(seconds[usable])]
    lines = np.asarray(columns.rows, np.int64)[chosen]
    return ImageTable(
        camera_index=camera_index,
        camera=camera,
        timestamps_ns=nanoseconds(seconds[chosen] + shift),
        seconds=seconds[chosen],
        line_seconds=view(frames.seconds)[lines],
        numbers=np.asarray(frames.numbers, np.int64)[lines],
        offsets=np.asarray(frames.offsets, np.int64)[lines],
        indices=indices[chosen],
        camera_model_texts=camera_model_texts[chosen],
        mount_texts=mount_texts[chosen],
        camera_models=camera_models,
        mounts=mounts,
        texts=tuple(frames.texts),
        missing=int(missing.sum()),
        data_file=data_file,
    )
