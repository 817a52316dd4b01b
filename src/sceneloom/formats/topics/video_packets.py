"""Packets of a video as messages hold them, one image each in Annex B form, and back into an mp4 file.

Source: schema CompressedVideo of Foxglove; ISO/IEC 14496-10, Annex B.
"""

import io
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Any, BinaryIO, cast

import av
import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.topics.file_views import FileView
from sceneloom.formats.video.index import VideoIndex, read_index
from sceneloom.formats.video.packet_copy import PacketTimes, copy_packets, iter_image_packets
from sceneloom.formats.video.remux import can_be_cut
from sceneloom.formats.video.source import OpenVideo, decoder_faults
from sceneloom.scene.cameras import VideoContent

_FILTERS = {"h264": "h264_mp4toannexb", "hevc": "hevc_mp4toannexb"}
"""FFmpeg's filters that put packets into Annex B form, with the parameters before each key image."""

_START_CODE = b"\x00\x00\x01"
_PARAMETERS = {"h264": lambda byte: byte & 0x1F == 7, "hevc": lambda byte: (byte >> 1) & 0x3F == 33}
"""Whether a unit with this first byte holds the parameters of a sequence, without which nothing is decoded."""


def starts_video(packet: bytes | memoryview, codec: str) -> bool:
    """Whether decoding can begin with a packet in Annex B form: whether it holds the sequence's parameters."""
    content, location = bytes(packet), 0
    while (location := content.find(_START_CODE, location)) >= 0 and location + 3 < len(content):
        if _PARAMETERS[codec](content[location + 3]):
            return True
        location += 3
    return False


def annex_b_to_mp4(raw: BinaryIO, target: BinaryIO, timestamps_ns: Int64Array, name: str) -> None:
    """Put a stream in Annex B form into an mp4 file.

    Args:
        raw: the packets one after another.
        target: a seekable binary file.
        timestamps_ns: (N,) int64 [ns], when each image is shown, in the order of decoding.
        name: what messages call the video.

    Raises:
        DataError: the packets cannot be read, or are more or fewer than their times.
    """
    order = np.argsort(timestamps_ns, kind="stable").astype(np.int64)
    micros = (timestamps_ns[order] - timestamps_ns[order[:1]]) // 1000
    # images of one microsecond keep their order
    steps = np.arange(len(micros))
    ticks = np.maximum.accumulate(micros - steps) + steps
    zeros = np.zeros(len(order), np.int64)
    index = VideoIndex(Fraction(1, 1_000_000), ticks, order, zeros, timed=True, hidden=0)
    times = PacketTimes.of(index, (ticks * 1e-6).astype(np.float64))
    copy_packets(lambda: cast("BinaryIO", io.BufferedReader(FileView(raw))), target, "mp4", times, name)


class AnnexBPackets:
    """The packets of a camera's video, one by one.

    Attributes:
        codec: "h264" or "hevc".
        reordered: whether images are decoded in another order than they are shown in.
        order: (N,) int64, which image of the camera each packet is, in the order of decoding.
    """

    def __init__(self, video: VideoContent, count: int, name: str) -> None:
        """List the packets.

        Args:
            video: that they are of.
            count: images of the camera.
            name: what messages call the video.

        Raises:
            DataError: the video is damaged, or has another number of images.
        """
        self.codec, self._video, self._name = video.codec, video, name
        index = read_index(video.open, name)
        indices = video.frame_indices
        chosen = np.arange(len(index)) if indices is None else np.asarray(indices, np.int64)
        if len(chosen) != count:
            raise DataError(name, "", f"{len(chosen)} images; expected {count} as the camera has")
        self.obstacle = _obstacle(video.codec, index, chosen)
        positions = index.positions[chosen] if self.obstacle is None else np.zeros(0, np.int64)
        self.order = np.argsort(positions).astype(np.int64)
        self.reordered = bool((np.diff(self.order) < 0).any())
        self._wanted = frozenset(positions.tolist())

    def __iter__(self) -> Iterator[bytes]:
        opened = OpenVideo(self._video.open, self._name)
        try:
            with decoder_faults(self._name, ""):
                filtered: Any = av.BitStreamFilterContext(_FILTERS[self.codec], in_stream=opened.stream)
            for position, packet in enumerate(iter_image_packets(opened, self._name)):
                with decoder_faults(self._name, f"packet {position}"):
                    content = b"".join(bytes(part) for part in filtered.filter(packet))
                if position in self._wanted:
                    yield content
        finally:
            opened.close()


def _obstacle(codec: str, index: VideoIndex, chosen: Sequence[int] | Int64Array) -> str | None:
    """Why the packets cannot be handed on; None where they can."""
    if codec not in _FILTERS:
        return f"messages hold H.264 and HEVC, the video is {codec}"
    if index.hidden:
        return "the video holds images that are not to be shown"
    if not can_be_cut(index, np.asarray(chosen, np.int64)):
        return "images that are taken need others that are not"
    return None
