"""A decoder on its way through a video, which knows which image comes next."""

from collections import deque
from collections.abc import Iterator

import av
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from sceneloom.errors import DataError
from sceneloom.formats.video.index import VideoIndex, codec_reorders, presentation_ticks
from sceneloom.formats.video.source import OpenVideo, decoder_faults


class Cursor:
    """Decodes onward from where a container stands; keeps the image it gave last and nothing else.

    Attributes:
        first: the first image it can give; those before it need another start.
    """

    def __init__(self, opened: OpenVideo, images: VideoIndex, name: str) -> None:
        """Start at the container's next packet, taken to be its first.

        Raises:
            DataError: damage has changed the stream's codec to an unknown one.
        """
        self.first = 0
        self._images, self._name = images, name
        self._works_ahead = opened.works_ahead
        with decoder_faults(name, ""):
            self._reorders = codec_reorders(opened.stream)
            self._packets: Iterator[Packet[VideoStream]] = opened.container.demux(opened.stream)
        self._pending: deque[VideoFrame] = deque()
        self._current: tuple[int, VideoFrame] | None = None
        self._next = 0
        self._entered: Packet[VideoStream] | None = None
        self._broken: int | None = None

    def enter(self, entry: int) -> bool:
        """Go on to the next key frame; report whether it lies early enough for what starts at `entry`."""
        with decoder_faults(self._name, f"image {entry}"):
            for packet in self._packets:
                image = self._images.find(presentation_ticks(packet, reorders=self._reorders))
                if packet.size and packet.is_keyframe and image is not None:
                    self.first, self._next, self._entered = image, image, packet
                    return bool(self._images.positions[image] <= self._images.positions[entry])
        return False

    def reaches(self, index: int) -> bool:
        """Whether decoding on gives this image, and no key frame further on gives it sooner."""
        if self._current is not None and self._current[0] == index:
            return True
        return index >= self._next and int(self._images.entries[index]) <= self._next

    def advance(self, index: int) -> VideoFrame | None:
        """Decode on until this image; None where the decoder passes over it.

        Raises:
            DataError: the image, or one that it leans on, is damaged.
        """
        while self._current is None or self._current[0] != index:
            step = self._decode_next(index)
            if step is None:
                return None
            self._current, self._next = step, step[0] + 1
            if step[0] > index:
                return None
        frame = self._current[1]
        if frame.is_corrupt or self._leans_on_broken(index):
            raise DataError(self._name, f"image {index}", "cannot be decoded: it or one before it is damaged")
        return frame

    def _leans_on_broken(self, index: int) -> bool:
        if self._broken is None:
            return False
        images = self._images
        same_group = images.entries[index] == images.entries[self._broken]
        return bool(same_group and images.positions[index] >= images.positions[self._broken])

    def _decode_next(self, wanted: int) -> tuple[int, VideoFrame] | None:
        while True:
            while not self._pending:
                packet = self._next_packet()
                if packet is None:
                    return None
                self._pending.extend(self._decode(packet, wanted))
            frame = self._pending.popleft()
            image = self._images.find(frame.pts) if self._images.timed else self._next
            if image is not None:
                return image, frame

    def _next_packet(self) -> "Packet[VideoStream] | None":
        if self._entered is not None:
            packet, self._entered = self._entered, None
            return packet
        with decoder_faults(self._name, f"image {self._next}"):
            return next(self._packets, None)

    def _decode(self, packet: "Packet[VideoStream]", wanted: int) -> list[VideoFrame]:
        if self._images.timed and packet.size:
            packet.pts = presentation_ticks(packet, reorders=self._reorders)
        try:
            return packet.decode()
        except (av.FFmpegError, ValueError) as error:
            image = self._images.find(packet.pts) if self._images.timed else None
            if image is not None:
                self._note_broken(image)
            if image is None or image == wanted or self._works_ahead:
                raise DataError(self._name, f"image {wanted}", f"cannot be decoded: {error}") from error
            return []

    def _note_broken(self, image: int) -> None:
        """Remember the first one of a group."""
        entries = self._images.entries
        if self._broken is None or entries[self._broken] != entries[image]:
            self._broken = image
