"""Pictures and depth images as `foxglove.RawImage` and `CompressedImage`."""

from typing import Any

from sceneloom.errors import OptionError
from sceneloom.fusion.messages.array_bytes import bytes_of
from sceneloom.fusion.messages.encodings import ENCODINGS
from sceneloom.fusion.messages.foreign_pictures import image_of_rows
from sceneloom.fusion.messages.foreign_values import ForeignMessage
from sceneloom.fusion.messages.foxglove_form.message import FoxgloveMessage, time_content
from sceneloom.fusion.messages.sensor_data import ImageData
from sceneloom.fusion.messages.timestamps import Timestamp

_RAW_NAMES = {1: "mono8", 3: "rgb8", 4: "rgba8"}
_READ_NAMES = {"8UC1": "mono8", "8UC3": "bgr8"}


def write_image(record: ImageData, frame_id: str, image_frame_id: str) -> dict[str, FoxgloveMessage]:
    """Show a picture."""
    del frame_id
    size_hwc = record.height, record.width, record.channel
    return {
        "image": image_message(
            record.timestamp, image_frame_id, record.encoding, size_hwc, bytes_of(record.data)
        )
    }


def image_message(
    timestamp: Timestamp, frame_id: str, encoding: str, size_hwc: tuple[int, int, int], data: bytes
) -> FoxgloveMessage:
    """Make the message of pixels, or of a whole file."""
    content: dict[str, Any] = {"timestamp": time_content(timestamp), "frame_id": frame_id, "data": data}
    if ENCODINGS[encoding].is_file:
        return FoxgloveMessage("foxglove.CompressedImage", {**content, "format": encoding})
    height, width, channel = size_hwc
    if encoding == "raw":
        if channel not in _RAW_NAMES:
            raise OptionError(f"raw pixels of {channel} values; expected 1, 3 or 4, to be shown")
        encoding = _RAW_NAMES[channel]
    content |= {"height": height, "width": width, "encoding": encoding, "step": width * channel}
    return FoxgloveMessage("foxglove.RawImage", content)


def read_image(message: ForeignMessage, common: dict[str, Any]) -> ImageData:
    """Read a picture of pixels."""
    named = message.text("encoding")
    encoding = _READ_NAMES.get(named, named)
    known = ENCODINGS.get(encoding)
    if known is None or known.order is None:
        names = (*(name for name in ENCODINGS if ENCODINGS[name].order), *_READ_NAMES)
        raise message.fault("encoding", f"{named!r}; expected one of {', '.join(names)}")
    return image_of_rows(message, encoding, min(known.channels), common)
