"""Changing some pictures of a video: what does not lean on them is copied, the rest encoded anew."""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol, cast

import av
import numpy as np
from av.codec.context import CodecContext
from av.container import OutputContainer
from av.packet import Packet
from av.video.codeccontext import VideoCodecContext
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from sceneloom.arrays import BoolArray, Int64Array, UInt8Array
from sceneloom.errors import DataError
from sceneloom.formats.video.groups import Groups, separate_groups
from sceneloom.formats.video.h264 import (
    ParameterSets,
    packet_of,
    parameter_sets_of,
    units_of,
    without_user_data,
)
from sceneloom.formats.video.h264_sequence import colour_place
from sceneloom.formats.video.index import VideoIndex
from sceneloom.formats.video.packet_copy import PacketTimes, iter_picture_packets, same_stream, set_times
from sceneloom.formats.video.reader import VideoReader
from sceneloom.formats.video.source import OpenVideo, VideoSource, decoder_faults, source_name
from sceneloom.formats.video.writer import VideoWriter, abandon, open_container, target_name, writing_faults

AnyPacket = Any
"""`av.packet.Packet` of a video, which bears a type in the stubs only."""

_GLOBAL_HEADER = 1 << 22
"""Source: AV_CODEC_FLAG_GLOBAL_HEADER of libavcodec/avcodec.h."""

_CRF = "18"
_LIMITED_BLACK, _GREY = 16, 128


class PictureChange(Protocol):
    """Changes a picture of a video."""

    def __call__(self, number: int, image: UInt8Array, *, halved: bool, black: int) -> UInt8Array:
        """Give picture `number` changed.

        Args:
            number: in the order of showing.
            image: (height, width, 3) red green blue, or one plane of it: brightness or a colour.
            halved: whether the plane has half the picture's width and height.
            black: the value that a black picture has in it.
        """
        ...


@dataclass(frozen=True, slots=True)
class ReplacedPictures:
    """What was written.

    Attributes:
        pictures: how many.
        encoded: how many of them were encoded anew; the others are copied.
        codec: what they are encoded as.
        reason: why all were encoded anew; None where they were not, or all were to be changed.
        messages: how many units of anybody's content were left out of copied pictures.
    """

    pictures: int
    encoded: int
    codec: str
    reason: str | None = None
    messages: int = 0


def replace_pictures(
    source: VideoSource,
    target: Path,
    change: PictureChange,
    touched: BoolArray,
    *,
    taken: Int64Array | None = None,
    name: str | None = None,
) -> ReplacedPictures:
    """Write a video with some pictures changed; only its pictures go over, no sound, text or name.

    Groups of pictures none of which is touched are copied where the codec is H.264 and its groups stand for
    themselves. Else all pictures are encoded anew: FFV1 as FFV1, others as H.264.

    Args:
        source: the video; read several times.
        target: an .mkv or .mp4 file.
        change: makes the new pictures.
        touched: (N,) bool, which pictures of the video to change, in the order of showing.
        taken: (M,) the only pictures of the video to write, ascending; None for all.
        name: what messages call the source.

    Raises:
        DataError: the source is damaged.
        OptionError: the pictures must be encoded, and have an odd size that the codec cannot hold.
        OutputError: the target cannot be written.
    """
    called = source_name(source, name)
    with VideoReader(source, name=called) as reader:
        if len(touched) != reader.count:
            problem = f"{reader.count} pictures; expected {len(touched)}"
            raise DataError(called, "", problem)
        groups = (
            separate_groups(reader, source) if taken is None else "not all pictures of the video are taken"
        )
        if isinstance(groups, str):
            return _encoded_whole(reader, target, change, touched, taken, groups)
        index = reader.index
    return _Exchange(source, called, groups, index, change, touched).write(target)


def _encoded_whole(
    reader: VideoReader,
    target: Path,
    change: PictureChange,
    touched: BoolArray,
    taken: Int64Array | None,
    reason: str,
) -> ReplacedPictures:
    codec = "ffv1" if reader.codec == "ffv1" else "h264"
    numbers = range(reader.count) if taken is None else taken.tolist()
    times = reader.timestamps
    with VideoWriter(target, reader.width, reader.height, reader.fps or 25.0, codec=codec) as writer:
        for number in numbers:
            rgb = reader.rgb(number)
            new = change(number, rgb, halved=False, black=0) if touched[number] else rgb
            writer.add(new, float(times[number]))
    return ReplacedPictures(len(numbers), len(numbers), codec, reason)


@dataclass(slots=True, eq=False)
class _Exchange:
    """Writes groups of pictures, those copied that are not touched."""

    source: VideoSource
    name: str
    groups: Groups
    index: VideoIndex
    change: PictureChange
    touched: BoolArray
    messages: int = 0

    def write(self, target: Path) -> ReplacedPictures:
        opened = OpenVideo(self.source, self.name)
        container = "matroska" if target.suffix == ".mkv" else "mp4"
        try:
            output = open_container(target, container, pictures=len(self.index), header_bytes=4096)
            try:
                self._write(opened, output, target_name(target))
            except BaseException:
                abandon(output)
                raise
            with writing_faults(target_name(target)):
                output.close()
        finally:
            opened.close()
        encoded = int(self.groups.touched(self.touched)[self.groups.of_packets].sum())
        return ReplacedPictures(len(self.index), encoded, "h264", None, self.messages)

    def _write(self, opened: OpenVideo, output: OutputContainer, called: str) -> None:
        times = PacketTimes.of(self._new_index(), None)
        encoder_sets = parameter_sets_of(bytes(self._encoder(opened.stream).extradata or b""))
        old = self.groups.sets
        both = ParameterSets(
            (*old.sequence, *encoder_sets.sequence), (*old.picture, *encoder_sets.picture), old.length_size
        )
        with writing_faults(called):
            stream = same_stream(output, opened.stream, times.tick)
            if self.touched.any():
                stream.codec_context.extradata = both.record()
        for position, packet in enumerate(self._packets(opened)):
            set_times(packet, times, position, self.name)
            packet.stream = stream
            with writing_faults(called):
                output.mux_one(packet)

    def _new_index(self) -> VideoIndex:
        """The list of pictures with those of touched groups stored in the order in which they are shown."""
        positions, numbers = self.index.positions.copy(), self.groups.of_pictures
        for group in np.flatnonzero(self.groups.touched(self.touched)):
            mine = numbers == group
            positions[mine] = np.sort(positions[mine])
        return VideoIndex(self.index.time_base, self.index.pts, positions, self.index.entries, True, 0)  # noqa: FBT003

    def _packets(self, opened: OpenVideo) -> Iterator[AnyPacket]:
        touched = self.groups.touched(self.touched)
        waiting: list[AnyPacket] = []
        for position, packet in enumerate(iter_picture_packets(opened, self.name)):
            group = int(self.groups.of_packets[min(position, len(self.index) - 1)])
            if not touched[group]:
                yield self._copied(packet)
                continue
            waiting.append(packet)
            last = position + 1 == len(self.index) or self.groups.of_packets[position + 1] != group
            if last:
                yield from self._encoded(
                    opened.stream, waiting, np.flatnonzero(self.groups.of_pictures == group)
                )
                waiting = []

    def _copied(self, packet: AnyPacket) -> AnyPacket:
        length_size = self.groups.sets.length_size
        units = units_of(bytes(packet), length_size) or []
        content, left_out = without_user_data(units, length_size)
        if not left_out:
            return packet
        self.messages += left_out
        copy: AnyPacket = Packet(content)
        copy.is_keyframe = packet.is_keyframe
        return copy

    def _encoded(
        self, stream: VideoStream, packets: list[AnyPacket], numbers: Int64Array
    ) -> Iterator[AnyPacket]:
        """Decode a group, change its pictures, encode them."""
        encoder = self._encoder(stream)
        frames = zip(numbers.tolist(), self._decoded(stream, packets, len(numbers)), strict=True)
        for made, (number, frame) in enumerate(frames):
            changed = self._changed(frame, number) if self.touched[number] else frame
            changed.pts, changed.time_base = made, encoder.time_base
            changed.pict_type = 0
            for packet in encoder.encode(changed):
                yield self._as_in_file(packet)
        for packet in encoder.encode(None):
            yield self._as_in_file(packet)

    def _decoded(self, stream: VideoStream, packets: list[AnyPacket], count: int) -> Iterator[VideoFrame]:
        decoder = cast("VideoCodecContext", CodecContext.create(stream.codec_context.codec.name, "r"))
        decoder.extradata = stream.codec_context.extradata
        found = 0
        for packet in [*packets, None]:
            place = f"pictures of packet {found}"
            with decoder_faults(self.name, place):
                frames = decoder.decode(packet)
            for frame in frames:
                if frame.is_corrupt:
                    raise DataError(self.name, f"picture {found}", "cannot be decoded: it is damaged")
                found += 1
                yield frame
        if found != count:
            raise DataError(self.name, "", f"{found} pictures of a group of {count} can be decoded")

    def _changed(self, frame: VideoFrame, number: int) -> VideoFrame:
        height, width = frame.height, frame.width
        planes = np.asarray(frame.to_ndarray(), np.uint8)
        black = 0 if frame.color_range == av.video.reformatter.ColorRange.JPEG else _LIMITED_BLACK
        changed = np.empty_like(planes)
        changed[:height] = self.change(number, planes[:height], halved=False, black=black)
        colours = planes[height:].reshape(2, height // 2, width // 2)
        changed[height:] = np.stack(
            [self.change(number, plane, halved=True, black=_GREY) for plane in colours]
        ).reshape(-1, width)
        new = VideoFrame.from_ndarray(changed, format=frame.format.name)
        new.colorspace, new.color_range = frame.colorspace, frame.color_range
        return new

    def _encoder(self, stream: VideoStream) -> VideoCodecContext:
        """An encoder whose stream begins with a picture that leans on nothing, with parameter sets of its own."""
        model = stream.codec_context
        encoder = CodecContext.create("libx264", "w")
        encoder.width, encoder.height, encoder.pix_fmt = model.width, model.height, model.pix_fmt
        encoder.time_base = self.index.time_base
        encoder.framerate = stream.average_rate or Fraction(25)
        encoder.colorspace, encoder.color_range = model.colorspace, model.color_range
        encoder.color_primaries, encoder.color_trc = model.color_primaries, model.color_trc
        if model.sample_aspect_ratio:
            encoder.sample_aspect_ratio = model.sample_aspect_ratio
        encoder.flags |= _GLOBAL_HEADER
        place = colour_place(self.groups.sets.sequence[0])
        settings = (
            f"sps-id={self.groups.free_id}:chromaloc={place}:bframes=0:keyint=infinite:scenecut=0:mbtree=0"
        )
        encoder.options = {"preset": "fast", "crf": _CRF, "threads": "2", "x264-params": settings}
        with writing_faults(self.name):
            encoder.open()
        return encoder

    def _as_in_file(self, packet: AnyPacket) -> AnyPacket:
        made: AnyPacket = Packet(packet_of(bytes(packet), self.groups.sets.length_size))
        made.is_keyframe = packet.is_keyframe
        return made
