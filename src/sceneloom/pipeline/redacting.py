"""The redact job: hide regions of images for good, in videos and image files; and lists of boxes to hide.

Detectors of faces and licence plates write such lists as CSV with a header, or as JSON.
"""

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

import msgspec

from sceneloom.arrays import Int64Array
from sceneloom.editing.redact import ImageBox, find_hidings, hide_in_images, regions_of
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.files import open_file, read_bytes
from sceneloom.formats.base.images import PNG_START, encode_png, without_metadata
from sceneloom.formats.base.losses import Loss, LossReport, Support
from sceneloom.formats.base.registry import check_scene_output
from sceneloom.formats.video.writer import VideoWriter
from sceneloom.pipeline.editing import EditReport, edit_files
from sceneloom.scene.cameras import CameraImage, CameraSensor, VideoContent
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Identifier, Key, Progress, key_of

_PixelsByImage = Mapping[int, Int64Array]  # what is hidden in each image: (K, 4) left, top, right, bottom [px]


def _with_hidden_files(scene: Scene, hidden: Scene, pixels: Mapping[Key, _PixelsByImage]) -> Scene:
    """Give a scene with hidden locations the files of its images again."""
    before = {key_of(camera.id): camera.images for camera in scene.cameras}
    sensors: list[Any] = []
    for sensor in hidden.sensors:
        if isinstance(sensor, CameraSensor):
            key = key_of(sensor.id)
            read = partial(_with_file, before[key], sensor.images, pixels[key])
            sensor = replace(sensor, images=LazyFrames(sensor.images.timestamps_ns, read))  # noqa: PLW2901
        sensors.append(sensor)
    return replace(hidden, sensors=tuple(sensors))


def _with_file(
    before: LazyFrames[CameraImage], after: LazyFrames[CameraImage], pixels: _PixelsByImage, k: int
) -> CameraImage:
    """An image with hidden locations, and its file where that is not left to the writer."""
    old, image = before[k], after[k]
    if old.encoded is None:
        return image
    if k not in pixels:
        return replace(image, encoded=partial(_without_metadata, old))
    # a JPEG is made by the writer, which says so; PNG files stay what they are
    is_png = old.encoded().startswith(PNG_START)
    return replace(image, encoded=partial(_png_of, image)) if is_png else image


def _png_of(image: CameraImage) -> bytes:
    return encode_png(image.rgb)


def _without_metadata(image: CameraImage) -> bytes:
    """The image's file without what it says besides the image."""
    content = b"" if image.encoded is None else image.encoded()
    try:
        return without_metadata(content)[0]
    except DataError:
        return _png_of(image)  # a file that cannot be taken apart is made anew from its pixels


_DEFAULT_FPS = 25.0


class _CameraBlur(msgspec.Struct, frozen=True, kw_only=True):
    """What was hidden in the images of one camera."""

    camera: Identifier
    boxes: int
    hidden: int
    images: int
    of_images: int
    without_image: int
    outside: int
    cut: int
    encoded: int | None = None  # images of its video, all of which are encoded again


class BlurReport(msgspec.Struct, frozen=True, kw_only=True):
    """What was done.

    Attributes:
        fill: what took the position of what was there.
        margin: by what share of its size each box grew on each side.
    """

    edit: EditReport
    fill: str
    margin: float
    cameras: tuple[_CameraBlur, ...]


def blur_files(
    source: str | Path,
    output: str | Path,
    *,
    boxes: Sequence[ImageBox] = (),
    labels: Iterable[str] = (),
    fill: str = "blur",
    margin: float = 0.1,
    hold: float = 0.0,
    drop_colours: bool = False,
    reading: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
    **writing: Any,
) -> BlurReport:
    """Hide boxes in the images of a drive, and write it.

    Videos are encoded again, FFV1 as FFV1 and others as H.264, which the loss report lists; the images keep their
    times, and nothing else of the videos goes over. Of images in files of their own only touched ones are encoded
    anew; all lose what their files state besides the image.

    Args:
        source: a file or folder of any format.
        output: a file or a folder, by its suffix in any format that can be written.
        boxes: what to hide, from `read_image_boxes` or a detector.
        labels: those of the drive's own boxes and outlines in images that are to be hidden.
        fill, margin: see `editing.redact.hide_in_images`.
        hold: what a track or an annotation is hidden longer before its first and after its last image [s].
        drop_colours: whether points lose the colours that cameras gave them.
        progress: reported after each sweep and radar cycle that is written.
        writing: further options of the output's format.

    Raises:
        OptionError: a camera or label is not there, there is nothing to hide, or a value cannot be followed.
        OutputError: the output exists, or cannot be written.
        SceneloomError: the source is wrong.
    """
    chosen = tuple(labels)
    if not boxes and not chosen:
        raise OptionError(
            "nothing to hide; expected boxes in a CSV or JSON file (`--boxes FILE`) "
            "or labels of annotations (`--label NAME`)"
        )
    check_scene_output(Path(output), overwrite=overwrite)
    reported: list[_CameraBlur] = []
    losses: list[Loss] = []
    with TemporaryDirectory(dir=Path(output).parent, prefix=".sceneloom-blur-") as folder:

        def change(scenes: Sequence[Scene], _: Any) -> Scene:
            scene = scenes[0]
            hidings = find_hidings(scene, boxes=tuple(boxes), labels=chosen, hold=hold)
            regions = regions_of(scene, hidings, margin=margin)
            bare = hide_in_images(scene, hidings, fill=fill, margin=margin, drop_colours=drop_colours)
            hidden = _with_hidden_files(scene, bare, {key: found.pixels for key, found in regions.items()})
            changed, encoded = _with_videos(scene, hidden, Path(folder), losses)
            counts = {key_of(camera.id): len(camera.images) for camera in scene.cameras}
            for hiding in hidings:
                key = key_of(hiding.camera_id)
                found = regions[key]
                reported.append(
                    _CameraBlur(
                        camera=hiding.camera_id,
                        boxes=hiding.given,
                        hidden=sum(map(len, found.pixels.values())),
                        images=len(found.pixels),
                        of_images=counts[key],
                        without_image=hiding.unmatched,
                        outside=found.outside,
                        cut=found.cut,
                        encoded=counts[key] if key in encoded else None,
                    )
                )
            return changed

        report = edit_files(
            "blur", [source], output, change, reading=reading, progress=progress, overwrite=overwrite, **writing
        )
    report = msgspec.structs.replace(report, losses=LossReport.of([*report.losses, *losses]))
    return BlurReport(edit=report, fill=fill, margin=margin, cameras=tuple(reported))


def _with_videos(scene: Scene, hidden: Scene, folder: Path, losses: list[Loss]) -> tuple[Scene, frozenset[Key]]:
    """Encode the images of videos again; of odd sizes, which H.264 cannot hold, they stay single images."""
    codecs = {key_of(camera.id): camera.video.codec for camera in scene.cameras if camera.video is not None}
    sensors: list[Sensor] = []
    encoded = set[Key]()
    for sensor in hidden.sensors:
        key = key_of(sensor.id)
        if not isinstance(sensor, CameraSensor) or key not in codecs or not len(sensor.images):
            sensors.append(sensor)
            continue
        codec = "ffv1" if codecs[key] == "ffv1" else "h264"
        size = sensor.images[0].camera
        if codec == "h264" and (size.width % 2 or size.height % 2):
            what = "its odd size is not that of an H.264 video: the images go one by one"
            losses.append(Loss(field=f"sensors[{sensor.id}].video", what=what, support=Support.CONVERTED))
            sensors.append(sensor)
            continue
        target, count = folder / f"video{len(encoded)}{'.mkv' if codec == 'ffv1' else '.mp4'}", len(sensor.images)
        seconds = (sensor.images.timestamps_ns - sensor.images.timestamps_ns[0]) * 1e-9
        fps = (count - 1) / seconds[-1] if seconds[-1] > 0 else _DEFAULT_FPS
        with VideoWriter(target, size.width, size.height, fps, codec=codec, images=count) as writer:
            for image, time in zip(sensor.images, seconds.tolist(), strict=True):
                writer.add(image.rgb, time)
        if codec == "h264":
            what, support = "the video is encoded again, as H.264 of quality 18", Support.APPROXIMATED
            losses.append(Loss(field=f"sensors[{sensor.id}].video", what=what, count=count, support=support))
        sensors.append(replace(sensor, video=VideoContent(partial(open_file, target), codec)))
        encoded.add(key)
    return replace(hidden, sensors=tuple(sensors)), frozenset(encoded)


_ALIASES: Mapping[str, str] = MappingProxyType(
    {
        alias: name
        for name, aliases in {
            "camera": "camera_id sensor sensor_id",
            "number": "frame picture image",
            "x1": "xmin left",
            "y1": "ymin top",
            "x2": "xmax right",
            "y2": "ymax bottom",
            "track": "id track_id",
            "label": "class type",
            "width": "w",
            "height": "h",
        }.items()
        for alias in aliases.split()
    }
)  # other words for the columns
_COLUMNS = "camera, number or time or timestamp_ns, x1, y1, x2, y2 (or left, top, width, height), track, label"
_MOST_SECONDS = 9_000_000_000
_MOST_DIGITS = 40  # what has more is no number or time of an image, and 1e99999999 would take hours to write out


def read_image_boxes(path: str | Path) -> tuple[ImageBox, ...]:
    """Read a list of boxes.

    A row names the camera's id (not needed where there is one camera), the image by its `number` from 0, its `time`
    [s] or its `timestamp_ns` on the scene's clock, and two corners [px], the image's own corner being (0, 0). Rows
    of one `track` are one object. JSON holds such rows as objects in a list, or in a list named `boxes`.

    Raises:
        DataError: the file is neither, or a row of it cannot be followed.
    """
    location = Path(path)
    if not location.is_file():
        raise DataError(location, "", "no such file; expected a list of boxes as CSV or JSON")
    try:
        text = read_bytes(location).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(location, f"byte {error.start}", "is no UTF-8; expected CSV or JSON") from error
    is_json = text.lstrip()[:1] in {"[", "{"}
    rows = _json_rows(location, text) if is_json else _csv_rows(location, text)
    return tuple(_Row(location, where, row).box() for where, row in rows)


def _json_rows(path: Path, text: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError(path, "", f"is no JSON: {error}") from error
    rows = found.get("boxes") if isinstance(found, dict) else found
    if not isinstance(rows, list):
        raise DataError(path, "", "expected a list of boxes, or an object with such a list as `boxes`")
    for k, row in enumerate(rows):
        if not isinstance(row, dict):
            raise DataError(path, f"boxes[{k}]", f"{row!r:.40}; expected an object with {_COLUMNS}")
        yield f"boxes[{k}]", _named(row)


def _csv_rows(path: Path, text: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    reader = csv.DictReader(text.splitlines(), skipinitialspace=True)
    try:
        columns = _named(dict.fromkeys(reader.fieldnames or ()))
        if not _says_corners(columns):
            raise DataError(path, "line 1", f"columns {', '.join(columns) or 'none'}; expected {_COLUMNS}")
        for row in reader:
            if None in row or None in row.values():
                raise DataError(path, f"line {reader.line_num}", "has more or fewer values than there are columns")
            yield f"line {reader.line_num}", _named(row)
    except csv.Error as error:
        raise DataError(path, f"line {reader.line_num}", f"is no CSV: {error}") from error


def _named(row: Mapping[str, Any]) -> dict[str, Any]:
    words = {str(name).strip().lower(): value for name, value in row.items()}
    return {_ALIASES.get(name, name): value for name, value in words.items()}


def _says_corners(row: Mapping[str, Any]) -> bool:
    return {"x1", "y1"} <= row.keys() and ({"x2", "y2"} <= row.keys() or {"width", "height"} <= row.keys())


@dataclass(frozen=True, slots=True)
class _Row:
    """A row of a list of boxes, and where it stands."""

    path: Path
    where: str
    values: Mapping[str, Any]

    def box(self) -> ImageBox:
        """The box."""
        values = self.values
        corners = values.get("box")
        if isinstance(corners, Sequence) and len(corners) == 4 and not isinstance(corners, str):
            named = dict(zip(("x1", "y1", "x2", "y2"), corners, strict=True))
            return replace(self, values={**{k: v for k, v in values.items() if k != "box"}, **named}).box()
        if not _says_corners(values):
            raise self._fault(f"has {', '.join(values)}; expected {_COLUMNS}")
        left, top = self._pixels("x1"), self._pixels("y1")
        if self._has("x2"):
            right, bottom = self._pixels("x2"), self._pixels("y2")
        else:
            right, bottom = left + self._pixels("width"), top + self._pixels("height")
        if not (left <= right and top <= bottom):
            raise self._fault(f"corners {left}, {top} and {right}, {bottom}; expected x1 <= x2 and y1 <= y2")
        number, timestamp_ns = self._moment()
        return ImageBox(
            (left, top, right, bottom),
            camera=self._text("camera"),
            number=number,
            timestamp_ns=timestamp_ns,
            track=self._text("track"),
            label=self._text("label"),
        )

    def _fault(self, problem: str) -> DataError:
        return DataError(self.path, self.where, problem)

    def _has(self, name: str) -> bool:
        return self.values.get(name) not in (None, "")  # a cell of JSON may be a list, which no set can have

    def _text(self, name: str) -> str | None:
        return str(self.values[name]).strip() if self._has(name) else None

    def _decimal(self, name: str) -> Decimal:
        stated = self.values.get(name)
        try:
            value = Decimal(str(stated).strip())
        except InvalidOperation as error:
            raise self._fault(f"{name}: {stated!r}; expected a number") from error
        if isinstance(stated, bool) or not value.is_finite() or value.adjusted() > _MOST_DIGITS:
            raise self._fault(f"{name}: {stated!r}; expected a finite number")
        return value

    def _pixels(self, name: str) -> float:
        value = self._decimal(name)
        if abs(value) > _MOST_SECONDS:
            raise self._fault(f"{name}: {self.values[name]!r}; expected pixels")
        return float(value)

    def _moment(self) -> tuple[int | None, int | None]:
        """The image's number, or else its time [ns]."""
        name = next((name for name in ("number", "time", "timestamp_ns") if self._has(name)), None)
        if name is None:
            raise self._fault("does not state which image; expected number, time or timestamp_ns")
        value, stated = self._decimal(name), self.values[name]
        if name == "time":
            if abs(value) > _MOST_SECONDS:
                raise self._fault(f"time: {stated!r}; expected seconds on the scene's clock")
            return None, int((value * 1_000_000_000).to_integral_value())
        if value != int(value):
            raise self._fault(f"{name}: {stated!r}; expected a whole number")
        if abs(value) > _MOST_SECONDS * 1_000_000_000:
            raise self._fault(f"{name}: {stated!r}; expected one that an image of the scene can have")
        return (int(value), None) if name == "number" else (None, int(value))
