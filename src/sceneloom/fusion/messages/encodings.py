"""How the pixels of an image can be written in a record."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from sceneloom.fusion.messages.basic_types import shown
from sceneloom.fusion.messages.tables import Table


@dataclass(frozen=True, slots=True)
class Encoding:
    """One way of writing pixels.

    Attributes:
        channels: how many values a pixel may have.
        is_file: the data are a whole file, of any length, not pixel after pixel.
        order: which values make red, green and blue; None where that is not known.
    """

    channels: frozenset[int]
    is_file: bool = False
    order: tuple[int, int, int] | None = None


_ANY = frozenset(range(1, 256))

ENCODINGS: Mapping[str, Encoding] = MappingProxyType(
    {
        "rgb8": Encoding(frozenset({3}), order=(0, 1, 2)),
        "bgr8": Encoding(frozenset({3}), order=(2, 1, 0)),
        "mono8": Encoding(frozenset({1}), order=(0, 0, 0)),
        "rgba8": Encoding(frozenset({4}), order=(0, 1, 2)),
        "bgra8": Encoding(frozenset({4}), order=(2, 1, 0)),
        "raw": Encoding(_ANY),
        "jpeg": Encoding(frozenset({1, 3, 4}), is_file=True),
        "png": Encoding(frozenset({1, 2, 3, 4}), is_file=True),
    }
)
"""By the names of table 5; those with 8 are the names that ROS gave them."""


def check_pixels(
    table: Table,
    encoding: str,
    *,
    size_hwc: tuple[int, int, int],
    length: int,
    channel_name: str,
    data_name: str,
) -> None:
    """Check that encoding, size and number of values of an image belong together.

    Args:
        table: of the record.
        size_hwc: height, width and channels.
        length: how many values there are.
        channel_name, data_name: how the table calls the two.

    Raises:
        DataError: they do not.
    """
    known = ENCODINGS.get(encoding)
    if known is None:
        raise table.fault("encoding", f"{shown(encoding)}; expected one of {', '.join(ENCODINGS)}")
    height, width, channels = size_hwc
    if channels not in known.channels:
        expected = " or ".join(str(count) for count in sorted(known.channels))
        raise table.fault(channel_name, f"{channels} of {encoding}; expected {expected}")
    if known.is_file:
        if length == 0:
            raise table.fault(data_name, f"empty; expected a file of {encoding}")
    elif length != height * width * channels:
        expected = f"{height * width * channels} (width * height * {channel_name})"
        raise table.fault(data_name, f"{length} values; expected {expected}")
