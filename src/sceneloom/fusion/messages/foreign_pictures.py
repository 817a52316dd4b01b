"""Pictures out of messages of other systems."""

from typing import Any

import numpy as np

from sceneloom.formats.encoded_pictures import picture_size
from sceneloom.fusion.messages.foreign_values import ForeignMessage
from sceneloom.fusion.messages.sensor_data import ImageData


def image_of_rows(message: ForeignMessage, encoding: str, channel: int, common: dict[str, Any]) -> ImageData:
    """Give the picture that rows of pixels make, which may be longer than their pixels.

    Args:
        message: with height, width, step and data.
        encoding: as table 5 has it.
        channel: values per pixel.
        common: sensor_id, seq and timestamp.

    Raises:
        DataError: there are more or fewer bytes than rows, or rows are shorter than their pixels.
    """
    height, width, step = (message.whole(name) for name in ("height", "width", "step"))
    data = np.frombuffer(message.content_bytes("data"), np.uint8)
    if step < width * channel or len(data) != step * height:
        expected = f"{height} rows of {step} bytes, each at least {width * channel}"
        raise message.fault("data", f"{len(data)} bytes; expected {expected}")
    if step != width * channel:
        data = data.reshape(height, step)[:, : width * channel].copy()
    return ImageData(height=height, width=width, encoding=encoding, channel=channel, data=data, **common)


def image_of_file(message: ForeignMessage, common: dict[str, Any]) -> ImageData:
    """Give the picture of a JPEG or PNG file.

    Args:
        message: with format, in which one of the two names stands, and data.
        common: sensor_id, seq and timestamp.

    Raises:
        DataError: it is neither, or damaged.
    """
    content, form = message.content_bytes("data"), message.text("format")
    encoding = next((name for word, name in _FORMS if word in form.lower()), None)
    if encoding is None:
        raise message.fault("format", f"{form!r}; expected jpeg or png")
    width, height = picture_size(content, encoding, owner=message.owner, place="data")
    data = np.frombuffer(content, np.uint8)
    return ImageData(height=height, width=width, encoding=encoding, channel=3, data=data, **common)


_FORMS = (("jpeg", "jpeg"), ("jpg", "jpeg"), ("png", "png"))
"""Words in the format of a file, and the encoding that each means."""
