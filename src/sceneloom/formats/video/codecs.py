"""Which codecs the video library brings."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

_WANTED: Mapping[str, tuple[str, Literal["r", "w"]]] = MappingProxyType(
    {
        "H.264, read": ("h264", "r"),
        "H.264, written": ("libx264", "w"),
        "FFV1, read": ("ffv1", "r"),
        "FFV1, written": ("ffv1", "w"),
        "HEVC, read": ("hevc", "r"),
        "AV1, read": ("libdav1d", "r"),
        "VP9, read": ("vp9", "r"),
        "MJPEG, read": ("mjpeg", "r"),
    }
)

NEEDED_CODECS = ("H.264, read", "H.264, written", "FFV1, read", "FFV1, written")
"""Without these, recordings cannot be read or written."""


_LOSSY, _LOSSLESS = 1 << 1, 1 << 2
"""Source: AV_CODEC_PROP_LOSSY and AV_CODEC_PROP_LOSSLESS of libavcodec/codec_desc.h."""


def is_lossless(codec: str) -> bool:
    """Whether videos of a codec, as FFmpeg calls it, never lose anything."""
    from av.codec import Codec
    from av.codec.codec import UnknownCodecError

    try:
        properties = int(Codec(codec, "r").properties)
    except (UnknownCodecError, ValueError):
        return False
    return bool(properties & _LOSSLESS) and not properties & _LOSSY


def available_codecs() -> dict[str, bool]:
    """Report of each codec that drives come in whether it is there."""
    from av.codec import Codec
    from av.codec.codec import UnknownCodecError

    found = {}
    for words, (name, mode) in _WANTED.items():
        try:
            found[words] = Codec(name, mode) is not None
        except (UnknownCodecError, ValueError):
            found[words] = False
    return found
