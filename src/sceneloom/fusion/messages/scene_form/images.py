"""Images of records and of the scene model."""

from dataclasses import dataclass
from types import MappingProxyType
from typing import cast

import numpy as np

from sceneloom.arrays import UInt8Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.encoded_images import EncodedImage
from sceneloom.fusion.messages.array_bytes import bytes_of
from sceneloom.fusion.messages.encodings import ENCODINGS
from sceneloom.fusion.messages.fused import SensorFusionData
from sceneloom.fusion.messages.sensor_data import ImageData, RawData
from sceneloom.fusion.messages.tables import IMAGE, RAW, SENSOR_FUSION
from sceneloom.fusion.messages.timestamps import Timestamp
from sceneloom.scene.cameras import CameraImage

_RAW_NAMES = {1: "mono8", 3: "rgb8", 4: "rgba8"}
"""What pixels of the encoding raw are taken for, by their number of values."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pixels:
    """Gives the image that pixels in an encoding make."""

    pixels: UInt8Array
    encoding: str

    def __call__(self) -> UInt8Array:
        return rgb_of_pixels(self.pixels, self.encoding)


def image_of(record: ImageData, camera: Camera) -> CameraImage:
    """Give the image of an image record; a file is decoded when the image is asked for.

    Pixels of the encoding `raw` are taken for grey, red green blue, or red green blue and transparency by their number
    of values. The image's extras hold sensor_id, seq and encoding of the record.

    Raises:
        DataError: the record's size is not that of the camera, or raw pixels have 2 or more than 4 values.
    """
    for name in ("width", "height"):
        if getattr(record, name) != getattr(camera, name):
            problem = f"{getattr(record, name)}; expected {getattr(camera, name)} as in the calibration"
            raise IMAGE.fault(name, problem)
    extras = MappingProxyType({"sensor_id": record.sensor_id, "seq": record.seq, "encoding": record.encoding})
    timestamp_ns = record.timestamp.nanoseconds
    if record.pixels is not None:
        check_shown(record.encoding, record.channel)
        return CameraImage(timestamp_ns, camera, _Pixels(record.pixels, record.encoding), extras=extras)
    file = EncodedImage(
        bytes_of(record.data), record.encoding, record.width, record.height, IMAGE.owner, "data"
    )
    encoded = file.encoded if record.encoding == "jpeg" else None
    return CameraImage(timestamp_ns, camera, file, extras=extras, encoded=encoded)


def pixels_of_raw(record: RawData, camera: Camera, encoding: str) -> CameraImage:
    """Give the image of raw data; see `image_of_raw`."""
    return image_of(image_of_raw(record, camera, encoding), camera)


def image_of_raw(record: RawData, camera: Camera, encoding: str) -> ImageData:
    """Give the image record of raw data.

    Args:
        encoding: what the bytes are: jpeg, png, or pixels of the camera's size in another one of `ENCODINGS`.

    Raises:
        DataError: there are more or fewer bytes than pixels need.
        OptionError: the encoding is not known, or does not state how many values a pixel has.
    """
    known = ENCODINGS.get(encoding)
    if known is None or encoding == "raw":
        names = ", ".join(name for name in ENCODINGS if name != "raw")
        raise OptionError(f"encoding {encoding!r}; expected one of {names}")
    channel = 3 if known.is_file else min(known.channels)
    length = camera.height * camera.width * channel
    if not known.is_file and record.length != length:
        expected = f"{length}, as {camera.width}x{camera.height} pixels of {encoding} have"
        raise RAW.fault("length", f"{record.length}; expected {expected}")
    if record.length == 0:
        raise RAW.fault("length", f"0; expected a file of {encoding}")
    return ImageData(
        sensor_id=record.sensor_id,
        timestamp=record.timestamp,
        seq=record.seq,
        height=camera.height,
        width=camera.width,
        encoding=encoding,
        channel=channel,
        data=np.frombuffer(record.data, np.uint8),
    )


def image_of_result(record: SensorFusionData, camera: Camera) -> CameraImage:
    """Give the image of a result of sensor-data fusion.

    Raises:
        DataError: the result's size is not that of the camera, or it cannot be decoded.
    """
    timestamp = record.timestamp if record.image_timestamp is None else record.image_timestamp
    image = ImageData(
        sensor_id=record.camera_id,
        timestamp=timestamp,
        seq=record.image_seq,
        height=record.height,
        width=record.width,
        encoding=record.encoding,
        channel=record.image_channel,
        data=record.image_data,
    )
    try:
        return image_of(image, camera)
    except DataError as error:
        location = {"data": "image_data", "channel": "image_channel"}.get(error.location, error.location)
        raise DataError(SENSOR_FUSION.owner, location, error.problem) from error


def image_data_of(image: CameraImage, *, sensor_id: int, seq: int, encoding: str = "rgb8") -> ImageData:
    """Give the record of an image.

    Args:
        encoding: rgb8, bgr8, rgba8, bgra8; mono8, which gives the mean of red, green and blue; jpeg where the image
            comes from such a file, which is then given as it is.

    Raises:
        DataError: the image cannot be decoded.
        OptionError: the encoding cannot be made of the image.
    """
    if encoding == "jpeg" and image.encoded is not None:
        data, channel = np.frombuffer(image.encoded(), np.uint8), 3
    else:
        pixels = pixels_of_rgb(image.rgb, encoding)
        data, channel = pixels, pixels.shape[2]
    return ImageData(
        sensor_id=sensor_id,
        timestamp=Timestamp.of(image.timestamp_ns),
        seq=seq,
        height=image.camera.height,
        width=image.camera.width,
        encoding=encoding,
        channel=channel,
        data=data,
    )


def check_shown(encoding: str, channel: int) -> None:
    """Check that it is known how pixels look.

    Raises:
        DataError: they are raw ones of 2 or more than 4 values.
    """
    if encoding == "raw" and channel not in _RAW_NAMES:
        raise IMAGE.fault("channel", f"{channel} of raw; expected 1, 3 or 4, to be shown")


def rgb_of_pixels(pixels: UInt8Array, encoding: str) -> UInt8Array:
    """Give red, green and blue of pixels.

    Args:
        pixels: (H, W, C) uint8 in the order of the encoding.
        encoding: one of `ENCODINGS` that is no file.

    Returns:
        (H, W, 3) uint8, read-only; a view where they are in this order already.
    """
    name = _RAW_NAMES[pixels.shape[2]] if encoding == "raw" else encoding
    order = ENCODINGS[name].order
    if name == "rgb8" or order is None:
        return cast("UInt8Array", read_only(pixels))
    rgb = np.empty((*pixels.shape[:2], 3), np.uint8)
    for k, channel in enumerate(order):  # a seventh of the time of numbers of channels as an index
        rgb[:, :, k] = pixels[:, :, channel]
    return cast("UInt8Array", read_only(rgb))


def pixels_of_rgb(rgb: UInt8Array, encoding: str) -> UInt8Array:
    """Give pixels in an encoding.

    Args:
        rgb: (H, W, 3) uint8.
        encoding: rgb8, bgr8, rgba8, bgra8, or mono8 for the mean of the three.

    Raises:
        OptionError: pixels cannot be made in it.
    """
    if encoding == "mono8":
        total = rgb.astype(np.uint16).sum(axis=2, dtype=np.uint16)
        grey: UInt8Array = ((total + 1) // 3).astype(np.uint8)[:, :, None]
        return grey
    known = ENCODINGS.get(encoding)
    if known is None or known.order is None:
        raise OptionError(f"encoding {encoding!r}; expected rgb8, bgr8, rgba8, bgra8 or mono8")
    if encoding == "rgb8":
        return rgb
    pixels = np.full((*rgb.shape[:2], min(known.channels)), 255, np.uint8)
    for k, channel in enumerate(known.order):
        pixels[:, :, channel] = rgb[:, :, k]
    return pixels
