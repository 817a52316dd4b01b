"""Label images: PNG files whose pixels are class numbers, and folders with one for each camera image."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from sceneloom.arrays import Int64Array, UInt16Array, check_array
from sceneloom.errors import DataError
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.base.images import open_image
from sceneloom.formats.base.output import file_stems, replacing
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.types import Identifier

_NUMBERS = {"1", "L", "P", "I", "I;16", "I;16B", "I;16L"}
_LARGEST = 65535
_LARGEST_BYTE = 255
_COMPRESSION = 3


def _read_label_png(path: Path) -> UInt16Array:
    """Read the numbers of the classes, (H, W); of a palette its indices, whatever their colours are."""
    from PIL import Image, UnidentifiedImageError

    try:
        with open_image(path, ("PNG",)) as image:
            mode = image.mode
            values = np.asarray(image) if mode in _NUMBERS else None
    except UnidentifiedImageError as error:
        raise DataError(path, "", "is no PNG file; expected a label image") from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise DataError(path, "", f"cannot be read: {error}; expected a label image") from error
    if values is None or values.ndim != 2:
        problem = f"pixels are colours ({mode}); expected one number each: grey of 8 or 16 bits, or a palette"
        raise DataError(path, "", problem)
    if values.size and not (int(values.min()) >= 0 and int(values.max()) <= _LARGEST):
        raise DataError(path, "", f"numbers from {values.min()} to {values.max()}; expected 0 to {_LARGEST}")
    return values.astype(np.uint16)


def write_label_png(labels: UInt16Array, path: Path, *, overwrite: bool = False) -> None:
    """Write numbers of classes (H, W) as grey of 8 bits, or of 16 where one needs them.

    Raises:
        OutputError: the file exists or cannot be written.
    """
    from PIL import Image

    check_array("labels", labels, (None, None), np.uint16)
    small = int(labels.max(initial=0)) <= _LARGEST_BYTE
    with replacing(path, overwrite=overwrite) as draft:
        Image.fromarray(labels.astype(np.uint8) if small else labels).save(draft, "PNG", compress_level=_COMPRESSION)


NAMES_FILE = "labels.json"
"""Beside the images: what each number means, as `{"7": "road"}`."""

_NEAR_NS = 1_000  # times in names may be rounded to microseconds

_WHOLE, _SECONDS = re.compile(r"\d{1,19}"), re.compile(r"\d{1,10}\.\d{1,9}")


@dataclass(slots=True)
class LabelFolder:
    """Label images of a scene's cameras.

    Attributes:
        folder: where they are.
        names: what each number means, as far as it is stated.
        used: how many images were read.
        missing: how many images had none.
    """

    folder: Path
    names: Mapping[int, str]
    used: int = 0
    missing: int = 0
    _files: dict[tuple[Identifier, int], Path] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path, cameras: Sequence[CameraSensor]) -> "LabelFolder":
        """Find the images: in a folder for each camera, by its id; of a single camera also in the folder itself.

        Raises:
            DataError: there is no image for any image, or a name is neither the number nor the time of an image.
        """
        if not folder.is_dir():
            raise DataError(folder, "", "no such folder; expected one of label images")
        found = cls(folder, _names(folder / NAMES_FILE))
        stems = file_stems([camera.id for camera in cameras])
        for camera, stem in zip(cameras, stems, strict=True):
            location = folder / stem
            if not location.is_dir() and len(cameras) == 1:
                location = folder
            images = sorted(location.glob("*.png")) if location.is_dir() else []
            found._files.update(_matched(images, camera))
        if not found._files:
            expected = ", ".join(f"{stem}/<number or time>.png" for stem in stems)
            raise DataError(folder, "", f"no label image in it; expected {expected or 'a scene with cameras'}")
        return found

    def image(self, camera: CameraSensor, number: int, size_px: tuple[int, int]) -> UInt16Array | None:
        """Read the image of an image, (H, W) uint16; None where there is none, which is counted.

        Args:
            camera: of the image.
            number: of the image.
            size_px: width and height that it must have.

        Raises:
            DataError: it cannot be read, or has another size.
        """
        path = self._files.get((camera.id, number))
        if path is None:
            self.missing += 1
            return None
        labels = _read_label_png(path)
        if labels.shape != (size_px[1], size_px[0]):
            problem = f"{labels.shape[1]}x{labels.shape[0]} pixels; expected {size_px[0]}x{size_px[1]}, the image's"
            raise DataError(path, "", problem)
        self.used += 1
        return labels


def _names(path: Path) -> dict[int, str]:
    if not path.is_file():
        return {}
    try:
        return msgspec.json.decode(read_bytes(path), type=dict[int, str])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, OSError) as error:
        raise DataError(path, "", f'{error}; expected numbers and names, {{"7": "road"}}') from error


def _matched(images: Sequence[Path], camera: CameraSensor) -> dict[tuple[Identifier, int], Path]:
    """The images of a camera by the numbers of its images; all names are numbers, or all are times."""
    timestamps_ns = camera.images.timestamps_ns
    whole = {path for path in images if _WHOLE.fullmatch(path.stem)}
    numbered = all(int(path.stem) < len(timestamps_ns) for path in whole)
    found: dict[tuple[Identifier, int], Path] = {}
    for path in images:
        number = int(path.stem) if numbered and path in whole else _by_time(path, timestamps_ns)
        if (camera.id, number) in found:
            other = found[camera.id, number].name
            raise DataError(path, "", f"is for image {number}, as {other} is; expected one image for each")
        found[camera.id, number] = path
    return found


def _by_time(path: Path, timestamps_ns: Int64Array) -> int:
    """The number of the image whose time a name says: nanoseconds or microseconds, or seconds with a point."""
    if _SECONDS.fullmatch(path.stem):
        whole, _, part = path.stem.partition(".")
        reported = [int(whole) * 1_000_000_000 + int(part.ljust(9, "0"))]
    elif _WHOLE.fullmatch(path.stem):
        reported = [int(path.stem), int(path.stem) * 1_000]
    else:
        reported = []
    for time_ns in reported:
        if len(timestamps_ns) and time_ns < 2**62:
            number = int(np.argmin(np.abs(timestamps_ns - time_ns)))
            if abs(int(timestamps_ns[number]) - time_ns) <= _NEAR_NS:
                return number
    span = f"{timestamps_ns.min()} to {timestamps_ns.max()} ns" if len(timestamps_ns) else "none"
    problem = f"named for no image; expected a number from 0 to {len(timestamps_ns) - 1}, or a time of one ({span})"
    raise DataError(path, "", problem)
