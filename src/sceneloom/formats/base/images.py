"""JPEG and PNG files: sizes, decoding on demand, removal of metadata, and depth images as 16-bit PNG or NPZ."""

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, cast

import numpy as np

from sceneloom.arrays import Float32Array, Int64Array, UInt8Array, check_array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError, DataError
from sceneloom.formats.base.files import check_pixels, check_regular, read_bytes
from sceneloom.formats.base.output import replacing
from sceneloom.scene.cameras import CameraImage

if TYPE_CHECKING:
    from PIL import Image

_PNG_HEAD = struct.Struct(">8s4x4sIIBB")
_JPEG_START, PNG_START = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
_SCAN_MARK = b"\xff\xda"

_MOST_SCANS = 100  # of a progressive image; encoders make some ten

_FAULTS = (OSError, ValueError, SyntaxError, EOFError, MemoryError, RuntimeError, struct.error)
"""What Pillow and the decoder of JPEG raise for files that are damaged."""


@dataclass(frozen=True, slots=True)
class EncodedImage:
    """A JPEG or PNG file in memory; called, it gives the image.

    Attributes:
        content: the file.
        form: "jpeg" or "png".
        width, height: the size that it has to have [px].
        owner: what it belongs to, for messages.
        location: the field that holds it, for messages.
    """

    content: bytes
    form: str
    width: int
    height: int
    owner: str = "image"
    location: str = ""

    def __call__(self) -> UInt8Array:
        """Decode the image.

        Returns:
            (height, width, 3) uint8, red green blue; grey is repeated, transparency dropped.

        Raises:
            DataError: it is no such file, damaged, of another size, or of more than 8 bits.
        """
        width, height = image_size(self.content, self.form, owner=self.owner, location=self.location)
        if (width, height) != (self.width, self.height):
            problem = f"an image of {width}x{height}; expected {self.width}x{self.height}"
            raise DataError(self.owner, self.location, problem)
        try:
            return _decoded(self.content, self.form)
        except _FAULTS as error:
            problem = f"cannot be decoded as {self.form}: {error}"
            raise DataError(self.owner, self.location, problem) from error

    def encoded(self) -> bytes:
        """The file."""
        return self.content


def open_image(path: Path, formats: tuple[str, ...]) -> "Image.Image":
    """Open the file of an image and read its head; Pillow decodes it when its pixels are asked for.

    Args:
        path: the file.
        formats: what it may be, by Pillow's names.

    Raises:
        DataError: it has more pixels than `check_pixels` lets pass.
        OSError: it is no regular file, or none of such a format.
        ValueError, SyntaxError: Pillow cannot read its head.
    """
    from PIL import Image

    check_regular(path)
    try:
        image = Image.open(path, formats=formats)
    except Image.DecompressionBombError as error:
        raise ValueError(str(error)) from error
    try:
        check_pixels(path, "", *image.size)
    except DataError:
        image.close()
        raise
    return image


def image_size(content: bytes, form: str, *, owner: str = "image", location: str = "") -> tuple[int, int]:
    """Width and height of a file in memory [px], from its head.

    Args:
        form: "jpeg" or "png".
        owner: what it belongs to, for messages.
        location: the field that holds it, for messages.

    Raises:
        DataError: it is no such file, of more than 8 bits, or has more pixels than `check_pixels` lets pass.
    """
    try:
        width, height = _size_of(content, form)
    except _FAULTS as error:
        raise DataError(owner, location, f"is no {form} file: {error}") from error
    check_pixels(owner, location, width, height)
    return width, height


def encode_png(rgb: UInt8Array) -> bytes:
    """Encode (height, width, 3) uint8, red green blue, without loss."""
    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(rgb)).save(content, "PNG", compress_level=1)
    return content.getvalue()


def _size_of(content: bytes, form: str) -> tuple[int, int]:
    if form == "jpeg":
        from simplejpeg import decode_jpeg_header

        height, width = decode_jpeg_header(content)[:2]
        return int(width), int(height)
    mark, chunk, width, height, bits, _ = _PNG_HEAD.unpack_from(content)
    if (mark, chunk) != (PNG_START, b"IHDR"):
        raise ValueError("it begins otherwise")
    if bits > 8:
        raise ValueError(f"it has {bits} bits a value; expected 8 or less")
    return width, height


def _decoded(content: bytes, form: str) -> UInt8Array:
    if form == "jpeg":
        from simplejpeg import decode_jpeg

        scans = content.count(_SCAN_MARK)
        if scans > _MOST_SCANS:
            expected = f"expected at most {_MOST_SCANS}"
            raise ValueError(f"it has {scans} scans, each of which may paint the whole image; {expected}")
        return cast("UInt8Array", decode_jpeg(content, "RGB"))
    from PIL import Image

    try:
        with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
            return np.array(image.convert("RGB"), np.uint8)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise ValueError(str(error)) from error


IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Endings of files that hold images."""

_EIGHT_BIT_MODES = {"1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "YCbCr", "CMYK"}


def is_jpeg(path: Path) -> bool:
    """Whether a file's name says that it is a JPEG."""
    return path.suffix.lower() in {".jpg", ".jpeg"}


def _open_image_file(path: Path) -> "Image.Image":
    """Read the head of an image."""
    from PIL import UnidentifiedImageError

    try:
        return open_image(path, ("PNG", "JPEG"))
    except UnidentifiedImageError as error:
        raise DataError(path, "", "is no PNG and no JPEG image") from error
    except _FAULTS as error:
        raise DataError(path, "", f"cannot be read: {error}") from error


def images_image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image [px], from its head."""
    with _open_image_file(path) as image:
        width, height = image.size
    return width, height


@dataclass(frozen=True, slots=True)
class ImageFile:
    """One file; called, it gives the image.

    Attributes:
        path: the file.
        width, height: the size that it has to have [px].
    """

    path: Path
    width: int
    height: int

    def __call__(self) -> UInt8Array:
        """Decode the image.

        Returns:
            (height, width, 3) uint8, red green blue; grey is repeated, transparency dropped. A rotation that the file
            asks viewers for is not applied: calibrations are made for the sensor's pixels.

        Raises:
            DataError: it is damaged, of another size, or of more than 8 bits.
        """
        rgb = self._decode_jpeg() if is_jpeg(self.path) else None
        if rgb is None:
            rgb = self._decode()
        self._check_size(rgb.shape[1], rgb.shape[0])
        return rgb

    def encoded(self) -> bytes:
        """The bytes of the file."""
        return read_bytes(self.path)

    def _decode_jpeg(self) -> UInt8Array | None:
        """Decode a JPEG the quick way; None where that decoder cannot, so that the other one says why."""
        from simplejpeg import decode_jpeg
        from simplejpeg import is_jpeg as begins_as_jpeg

        content = read_bytes(self.path)
        try:
            # a head of any size is claimed quickly: Pillow checks it before anything is made
            if not begins_as_jpeg(content):
                return None
            images_image_size(self.path)
            return cast("UInt8Array", decode_jpeg(content, "RGB"))
        except (ValueError, RuntimeError, MemoryError):
            return None

    def _decode(self) -> UInt8Array:
        with _open_image_file(self.path) as image:
            self._check_size(*image.size)
            # the type of the pixels in the file: Pillow makes 8 bits of colours of 16 in silence
            stored = [str(arguments) for _, _, _, arguments in getattr(image, "tile", [])]
            kind = next((kind.rstrip("BLN") for kind in stored if ";16" in kind), image.mode)
            if kind not in _EIGHT_BIT_MODES:
                raise DataError(self.path, "", f"has pixels of type {kind!r}; expected 8-bit grey or colour")
            try:
                return np.array(image.convert("RGB"), np.uint8)
            except _FAULTS as error:
                raise DataError(self.path, "", f"cannot be decoded: {error}") from error

    def _check_size(self, width: int, height: int) -> None:
        if (width, height) != (self.width, self.height):
            problem = f"is {width}x{height}; expected {self.width}x{self.height} as the camera's first image"
            raise DataError(self.path, "", problem)


@dataclass(frozen=True, slots=True, eq=False)
class ImageReader:
    """Makes the images of one camera from files.

    Attributes:
        files: of each image.
        names: of the files, seen from their root.
        timestamps_ns: (N,) int64 [ns].
        camera: the camera model of all.
    """

    files: tuple[Path, ...]
    names: tuple[str, ...]
    timestamps_ns: Int64Array
    camera: Camera

    def __call__(self, k: int) -> CameraImage:
        """Make image `k` without decoding it."""
        file = ImageFile(self.files[k], self.camera.width, self.camera.height)
        encoded = file.encoded if is_jpeg(file.path) else None
        extras = MappingProxyType({"file": self.names[k]})
        return CameraImage(int(self.timestamps_ns[k]), self.camera, file, extras=extras, encoded=encoded)


_KEPT_CHUNKS = frozenset(
    {b"IHDR", b"PLTE", b"IDAT", b"IEND", b"tRNS", b"gAMA", b"cHRM", b"sRGB", b"iCCP", b"sBIT", b"bKGD", b"cICP"}
)
"""What a PNG file needs to show its image in its colours. Source: PNG, 3rd edition, 11.2 and 11.3."""

_APPLICATIONS, _COMMENT = range(0xE0, 0xF0), 0xFE
_SCAN, _STOP, _RESTARTS = 0xDA, 0xD9, range(0xD0, 0xD8)
_ADOBE, _PROFILE = 0xEE, 0xE2


def without_metadata(content: bytes, *, name: str = "image") -> tuple[bytes, tuple[str, ...]]:
    """Give an image's file without anything that its pixels do not need; they stay bit by bit.

    Args:
        content: a JPEG or PNG file.
        name: what messages call it.

    Returns:
        The file, and what was left out of it: "APP1", "COM", "eXIf", "after the end", …

    Raises:
        DataError: it is neither, or its parts do not follow one another as they must.

    Source: ITU-T T.81, annex B; PNG, 3rd edition, 5.3.
    """
    if content.startswith(PNG_START):
        parts = _png_parts(content, name)
    elif content.startswith(_JPEG_START):
        parts = _jpeg_parts(content, name)
    else:
        raise DataError(name, "", "is neither JPEG nor PNG, so what it says of itself cannot be left out")
    kept, left_out = [], []
    for part, called in parts:
        if called:
            left_out.append(called)
        else:
            kept.append(part)
    return b"".join(kept), tuple(left_out)


def _png_parts(content: bytes, name: str) -> Iterator[tuple[bytes, str]]:
    """The parts of a file, each with its name if it is to be left out."""
    yield PNG_START, ""
    position = len(PNG_START)
    while position < len(content):
        length = int.from_bytes(content[position : position + 4])
        kind = content[position + 4 : position + 8]
        stop = position + 12 + length
        if stop > len(content) or len(kind) < 4:
            raise DataError(name, f"byte {position}", "the file ends within a part of it")
        yield content[position:stop], "" if kind in _KEPT_CHUNKS else kind.decode("latin-1")
        position = stop
        if kind == b"IEND":
            break
    else:
        raise DataError(name, "", "the file has no end")
    if position < len(content):
        yield content[position:], "after the end"


def _jpeg_parts(content: bytes, name: str) -> Iterator[tuple[bytes, str]]:
    """The segments of a file, each with its name if it is to be left out."""
    yield content[:2], ""
    position = 2
    while True:
        while content[position : position + 2] == b"\xff\xff":
            position += 1
        if position + 2 > len(content):
            # broken off after the image's data: decoders show it
            return
        if content[position] != 0xFF:
            raise DataError(name, f"byte {position}", f"{content[position]:#04x}; expected a marker")
        marker = content[position + 1]
        if marker == _STOP:
            yield content[position : position + 2], ""
            break
        stop = position + 2 + int.from_bytes(content[position + 2 : position + 4])
        if stop > len(content) or stop < position + 4:
            raise DataError(name, f"byte {position}", "the file ends within a segment")
        yield content[position:stop], _segment_name(marker, content[position + 4 : stop])
        position = stop
        if marker == _SCAN:
            stop = _scan_end(content, position)
            yield content[position:stop], ""
            position = stop
    if position + 2 < len(content):
        yield content[position + 2 :], "after the end"


def _segment_name(marker: int, payload: bytes) -> str:
    """What a segment is called that an image's colours do not need; nothing for one that they do."""
    if marker == _COMMENT:
        return "COM"
    if marker not in _APPLICATIONS:
        return ""
    needed = (marker == _ADOBE and payload.startswith(b"Adobe")) or (
        marker == _PROFILE and payload.startswith(b"ICC_PROFILE")
    )
    # the plain head says the shape of pixels; with a small image in it, it is left out
    plain = marker == _APPLICATIONS[0] and payload.startswith(b"JFIF") and len(payload) == 14
    return "" if needed or plain else f"APP{marker - _APPLICATIONS[0]}"


def _scan_end(content: bytes, position: int) -> int:
    """Where the data of a scan end: at the next marker that is none of its own."""
    while True:
        position = content.find(b"\xff", position)
        if position < 0 or position + 1 >= len(content):
            return len(content)
        marker = content[position + 1]
        if marker != 0 and marker not in _RESTARTS and marker != 0xFF:
            return position
        position += 1 if marker == 0xFF else 2


_STEPS_PER_METRE = 256
_LARGEST = 65535
_COMPRESSION = 3


def write_depth_png(depth_image: Float32Array, path: Path, *, overwrite: bool = False) -> int:
    """Write a depth image as PNG with 16 bits a pixel, rounded to 1/256 m.

    Args:
        depth_image: (H, W) float32 [m], 0 for none. A depth too small for the first step is written as one step.
        overwrite: replace a file that is there.

    Returns:
        How many depths lie beyond what 16 bits hold (255.99 m); they are written as 0.

    Raises:
        ArrayError: the image is empty, or holds NaN or a negative depth.
        OutputError: the file exists or cannot be written.
    """
    from PIL import Image

    _check(depth_image)
    steps = np.rint(depth_image.astype(np.float64) * _STEPS_PER_METRE)
    beyond = steps > _LARGEST
    steps[(depth_image > 0) & (steps == 0)] = 1
    steps[beyond] = 0
    with replacing(path, overwrite=overwrite) as draft:
        Image.fromarray(steps.astype(np.uint16)).save(draft, "PNG", compress_level=_COMPRESSION)
    return int(beyond.sum())


def read_depth_png(path: Path) -> Float32Array:
    """Read a depth image with 16 bits a pixel, in steps of 1/256 m.

    Returns:
        (H, W) float32 [m], 0 for none.

    Raises:
        DataError: it is no such image.
    """
    try:
        with open_image(path, ("PNG",)) as image:
            if not image.mode.startswith("I"):
                raise DataError(path, "", f"an image of mode {image.mode}; expected depths of 16 bits a pixel")
            return np.asarray(image, np.float32) / np.float32(_STEPS_PER_METRE)
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(path, "", f"cannot be read as a depth image: {error}") from error


def write_depth_npz(
    depth_image: Float32Array, path: Path, *, confidence: Float32Array | None = None, overwrite: bool = False
) -> None:
    """Write a depth image losslessly, as array `depth` of a compressed NPZ file.

    Args:
        depth_image: (H, W) float32 [m], 0 for none.
        confidence: (H, W) float32, 0 to 1: goes into the array `confidence` of the file.
        overwrite: replace a file that is there.

    Raises:
        ArrayError: the image is empty, or holds NaN or a negative depth, or the confidence is of another size.
        OutputError: the file exists or cannot be written.
    """
    _check(depth_image)
    check_array("confidence", confidence, depth_image.shape, np.float32, optional=True)
    arrays = {"depth": depth_image} | ({} if confidence is None else {"confidence": confidence})
    with replacing(path, overwrite=overwrite) as draft, draft.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # its flags are keywords, too


def write_confidence_png(confidence: Float32Array, path: Path, *, overwrite: bool = False) -> None:
    """Write confidences as PNG with 8 bits a pixel: 255 for 1.

    Args:
        confidence: (H, W) float32, 0 to 1.
        overwrite: replace a file that is there.

    Raises:
        ArrayError: the image is empty, or holds a number outside 0 to 1.
        OutputError: the file exists or cannot be written.
    """
    from PIL import Image

    check_array("confidence", confidence, (None, None), np.float32)
    if confidence.size == 0 or not (confidence >= 0).all() or not (confidence <= 1).all():
        raise ArrayError(f"confidence: {confidence.shape}; expected at least one pixel, and numbers from 0 to 1")
    with replacing(path, overwrite=overwrite) as draft:
        Image.fromarray(np.rint(confidence * 255).astype(np.uint8)).save(draft, "PNG", compress_level=_COMPRESSION)


def _check(depth_image: Float32Array) -> None:
    check_array("depth_image", depth_image, (None, None), np.float32)
    if depth_image.size == 0:
        raise ArrayError(f"depth_image: {depth_image.shape}; expected at least one pixel")
    wrong = np.argwhere(~(depth_image >= 0))
    if len(wrong):
        row, column = (int(number) for number in wrong[0])
        raise ArrayError(
            f"depth_image[{row}, {column}]: {depth_image[row, column]}; expected metres, 0 where there is no depth"
        )


JPEG_QUALITY = 95
"""Images of scenes shrink little more with more effort, at many times the time."""


def encode_jpeg(rgb: UInt8Array, *, quality: int = JPEG_QUALITY, subsampling: str = "444") -> bytes:
    """Encode an image (H, W, 3) uint8; unless it is stated otherwise, with full colour resolution.

    Args:
        rgb: the image.
        quality: 1 to 100.
        subsampling: "444" for full colour resolution, "420" for half of it.
    """
    from simplejpeg import encode_jpeg as encode

    content: bytes = encode(np.ascontiguousarray(rgb), quality, "RGB", subsampling)
    return content
