"""Videos made with FFmpeg's encoders directly, whose images bear their number in black and white bars."""

import io
import tempfile
from fractions import Fraction
from pathlib import Path
from types import MappingProxyType, SimpleNamespace

import av
import cv2
import numpy as np
import pytest

from sceneloom.formats.video.reader import Cursor

WIDTH, HEIGHT, BITS = 96, 64, 8


def numbered_image(number, width=WIDTH, height=HEIGHT):
    """An image that moves from number to number; its upper half is the number in binary, white for 1."""
    rgb = np.empty((height, width, 3), np.uint8)
    rgb[:] = ((np.arange(width) * 2 + 5 * number) % 256)[None, :, None]
    rgb[height // 2 :, :, 1] = np.linspace(30, 220, height - height // 2, dtype=np.uint8)[:, None]
    bits = [(number >> bit) & 1 for bit in range(BITS)]
    rgb[: height // 2] = np.repeat(np.array(bits, np.uint8) * 215 + 20, -(-width // BITS))[None, :width, None]
    return rgb


def read_number(rgb):
    """What number an image bears, however badly it was coded."""
    height, width = rgb.shape[:2]
    centres = [int(-(-width // BITS) * (bit + 0.5)) for bit in range(BITS)]
    return sum(int(rgb[height // 4, centre].mean() > 128) << bit for bit, centre in enumerate(centres))


def make_video(
    *,
    container="matroska",
    codec="libx264",
    options=MappingProxyType({"g": "12", "bf": "3", "preset": "veryfast"}),
    pixel_format="yuv420p",
    count=40,
    ticks=None,
    size=(WIDTH, HEIGHT),
    flags="",
):
    """So many images, numbered from 0.

    Args:
        container, codec: FFmpeg's names.
        options: of the encoder.
        pixel_format: what the encoder is fed with.
        ticks: presentation times in thirtieths of a second; None for 0, 1, 2 ….
        flags: FFmpeg's movflags of the container.
    """
    muxing = {"movflags": flags} if flags else {}
    # a file, since FFmpeg reads it again to move the tables to the front
    with tempfile.NamedTemporaryFile() as file:
        with av.open(file.name, "w", format=container, container_options=muxing) as output:
            stream = output.add_stream(codec, rate=30, options=dict(options))
            (stream.width, stream.height), stream.pix_fmt = size, pixel_format
            stream.codec_context.time_base = Fraction(1, 30)
            for number in range(count):
                frame = av.VideoFrame.from_ndarray(numbered_image(number, *size), format="rgb24")
                frame.pts = number if ticks is None else ticks[number]
                frame.time_base = Fraction(1, 30)
                output.mux(stream.encode(frame))
            output.mux(stream.encode(None))
        return Path(file.name).read_bytes()


def decode_all(content):
    """The planes of all images of a video as FFmpeg decodes them, one after the other, without any seeking."""
    with av.open(io.BytesIO(content)) as container:
        frames = list(container.decode(video=0))
    return [np.concatenate([np.frombuffer(plane, np.uint8) for plane in frame.planes]) for frame in frames]


def read_with_opencv(path):
    capture, images = cv2.VideoCapture(str(path)), []
    while (found := capture.read())[0]:
        images.append(found[1][:, :, ::-1])
    return images


@pytest.fixture(scope="session")
def videos():
    """The makers of this module, since tests cannot import one another."""
    return SimpleNamespace(
        make=make_video, image=numbered_image, number=read_number, decode=decode_all, opencv=read_with_opencv
    )


@pytest.fixture(scope="session")
def mkv_bytes():
    """40 images of H.264 in Matroska: B-frames, a key frame every 12 images, the first decoding times missing."""
    return make_video()


@pytest.fixture
def full_disk():
    """A file with room for 2000 bytes."""

    class FullDisk(io.BytesIO):
        def write(self, data):
            if self.tell() + len(data) > 2000:
                raise OSError(28, "No space left on device")
            return super().write(data)

    return FullDisk()


@pytest.fixture
def decoded_packets(monkeypatch):
    """Sizes of the packets that the reader has given to the decoder so far."""
    sizes, decode = [], Cursor._decode

    def noting(self, packet, wanted):
        sizes.extend([packet.size] * (packet.size > 0))
        return decode(self, packet, wanted)

    monkeypatch.setattr(Cursor, "_decode", noting)
    return sizes
