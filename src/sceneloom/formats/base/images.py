"""JPEG and PNG files: sizes, decoding on demand, removal of metadata, and depth images as 16-bit PNG or NPZ."""

import io
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, cast

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Int64Array, UInt8Array, UInt16Array, check_array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError, DataError
from sceneloom.formats.base.files import check_pixels, check_regular, read_bytes
from sceneloom.formats.base.losses import Losses
from sceneloom.formats.base.output import replacing
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.scene import Scene

if TYPE_CHECKING:
    from PIL import Image

_PNG_HEAD = struct.Struct(">8s4x4sIIBB")
PNG_START = b"\x89PNG\r\n\x1a\n"
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
        width, height = self.stated_size()
        if (width, height) != (self.width, self.height):
            problem = f"an image of {width}x{height}; expected {self.width}x{self.height}"
            raise DataError(self.owner, self.location, problem)
        try:
            return _decoded(self.content, self.form)
        except _FAULTS as error:
            problem = f"cannot be decoded as {self.form}: {error}"
            raise DataError(self.owner, self.location, problem) from error

    def stated_size(self) -> tuple[int, int]:
        """Width and height that its head has [px].

        Raises:
            DataError: it is no such file, of more than 8 bits, or has more pixels than `check_pixels` lets pass.
        """
        try:
            width, height = _size_of(self.content, self.form)
        except _FAULTS as error:
            raise DataError(self.owner, self.location, f"is no {self.form} file: {error}") from error
        check_pixels(self.owner, self.location, width, height)
        return width, height

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


_STEPS_PER_METRE = 256
_LARGEST = 65535
_COMPRESSION = 3


def write_depth_image(
    depth_image: Float32Array, path: Path, *, confidence: Float32Array | None = None, overwrite: bool = False
) -> int:
    """Write a depth image: losslessly as `.npz`, else as PNG with 16 bits a pixel, rounded to 1/256 m.

    Args:
        depth_image: (H, W) float32 [m], 0 for none: the array `depth` of an NPZ file, which is compressed. In a PNG a
            depth too small for the first step is written as one step.
        confidence: (H, W) float32, 0 to 1: the array `confidence` of an NPZ file.
        overwrite: replace a file that is there.

    Returns:
        How many depths lie beyond what 16 bits hold (255.99 m); they are written as 0.

    Raises:
        ArrayError: the image is empty, or holds NaN or a negative depth, or the confidence is of another size.
        OutputError: the file exists or cannot be written.
    """
    _check(depth_image)
    if path.suffix == ".npz":
        check_array("confidence", confidence, depth_image.shape, np.float32, optional=True)
        arrays = {"depth": depth_image} | ({} if confidence is None else {"confidence": confidence})
        with replacing(path, overwrite=overwrite) as draft, draft.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # its flags are keywords, too
        return 0
    steps = np.rint(depth_image.astype(np.float64) * _STEPS_PER_METRE)
    beyond = steps > _LARGEST
    steps[(depth_image > 0) & (steps == 0)] = 1
    steps[beyond] = 0
    write_grey_png(steps.astype(np.uint16), path, overwrite=overwrite)
    return int(beyond.sum())


def write_grey_png(values: AnyArray, path: Path, *, overwrite: bool = False) -> None:
    """Write (H, W) uint8 or uint16 as PNG, one number a pixel.

    Raises:
        OutputError: the file exists or cannot be written.
    """
    from PIL import Image

    with replacing(path, overwrite=overwrite) as draft:
        Image.fromarray(values).save(draft, "PNG", compress_level=_COMPRESSION)


def decode_grey_png(content: bytes, owner: str, location: str) -> UInt16Array:
    """Decode a PNG file of 16-bit grey, as depths are kept in.

    Args:
        content: the file.
        owner: what it belongs to, for messages.
        location: the field that holds it, for messages.

    Returns:
        (height, width) uint16.

    Raises:
        DataError: it is no such file, damaged, of another kind of pixels, or has more than `check_pixels` lets pass.
    """
    from PIL import Image

    grey_png_size(content, owner, location)
    try:
        with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
            return np.array(image).astype(np.uint16)
    except (*_FAULTS, Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise DataError(owner, location, f"cannot be decoded as png: {error}") from error


def grey_png_size(content: bytes, owner: str, location: str) -> tuple[int, int]:
    """Width and height of a PNG file of 16-bit grey [px], from its head; errors as of `decode_grey_png`."""
    try:
        mark, chunk, width, height, bits, colours = _PNG_HEAD.unpack_from(content)
    except struct.error as error:
        raise DataError(owner, location, f"is no png file: {error}") from error
    if (mark, chunk, bits, colours) != (PNG_START, b"IHDR", 16, 0):
        problem = f"no PNG file of 16-bit grey, but begins with {content[:8].hex(' ')}"
        raise DataError(owner, location, problem)
    check_pixels(owner, location, width, height)
    return width, height


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


def with_pinholes(scene: Scene, losses: Losses, *, keep: Iterable[str] = ("pinhole",)) -> Scene:
    """Resample the images of cameras whose models a target does not have, and report it.

    Args:
        keep: the models that the target has.

    Raises:
        CalibrationError: a camera model cannot be computed with.
    """
    from sceneloom.editing.cameras import undistort_scene

    others = [camera for camera in scene.cameras if camera.camera.model not in keep and len(camera.images)]
    for camera in others:
        model = camera.camera.model
        what = f"{camera.id!r}: a {model} camera model replaced by a pinhole, and its images resampled for it"
        for name in ("camera", "images.rgb", "images.encoded"):
            losses.approximated(f"sensors.camera.{name}", what)
    return undistort_scene(scene, cameras=[camera.id for camera in others]) if others else scene


def write_image(stem: Path, image: CameraImage, losses: Losses, *, png: bool = False) -> Path:
    """Write an image beside a name: a JPEG or PNG file as it is, else encoded anew, which is reported.

    Args:
        stem: the path without its ending.
        png: write what is no PNG file as one, without loss, instead of as JPEG.

    Returns:
        The path with its ending.
    """
    source = image.decode
    is_png = isinstance(source, ImageFile) and source.path.suffix.lower() == ".png"
    if is_png or png:
        path = stem.with_name(f"{stem.name}.png")
        path.write_bytes(source.encoded() if isinstance(source, ImageFile) and is_png else encode_png(image.rgb))
        return path
    path = stem.with_name(f"{stem.name}.jpg")
    if image.encoded is not None:
        path.write_bytes(image.encoded())
        return path
    path.write_bytes(encode_jpeg(image.rgb))
    losses.approximated("sensors.camera.images.rgb", f"encoded as JPEG of quality {JPEG_QUALITY}")
    return path
