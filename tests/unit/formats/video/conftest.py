"""Videos made with FFmpeg's encoders directly, whose images bear their number in black and white bars."""

import io
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import cv2
import numpy as np
import pytest

WIDTH, HEIGHT, BITS = 96, 64, 8


def numbered_image(number: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """An image that moves from number to number; its upper half is the number in binary, white for 1."""
    columns = np.arange(width)
    rgb = np.empty((height, width, 3), np.uint8)
    rgb[:] = ((columns * 2 + 5 * number) % 256)[None, :, None]
    rgb[height // 2 :, :, 1] = np.linspace(30, 220, height - height // 2, dtype=np.uint8)[:, None]
    bits = [(number >> bit) & 1 for bit in range(BITS)]
    rgb[: height // 2] = np.repeat(np.array(bits, np.uint8) * 215 + 20, -(-width // BITS))[None, :width, None]
    return rgb


def read_number(rgb: np.ndarray) -> int:
    """What number an image bears, however badly it was coded."""
    height, width = rgb.shape[:2]
    band = -(-width // BITS)
    centres = [int(band * (bit + 0.5)) for bit in range(BITS)]
    return sum(int(rgb[height // 4, centre].mean() > 128) << bit for bit, centre in enumerate(centres))


@dataclass(frozen=True)
class Recipe:
    """How a test video is made.

    Attributes:
        container, codec: FFmpeg's names.
        options: of the encoder.
        pixel_format: what the encoder is fed with.
        count: how many images, numbered from 0.
        ticks: presentation times in thirtieths of a second; None for 0, 1, 2 ….
        flags: FFmpeg's movflags of the container.
    """

    container: str = "matroska"
    codec: str = "libx264"
    options: dict[str, str] = field(default_factory=lambda: {"g": "12", "bf": "3", "preset": "veryfast"})
    pixel_format: str = "yuv420p"
    count: int = 40
    ticks: Sequence[int] | None = None
    size: tuple[int, int] = (WIDTH, HEIGHT)
    flags: str = ""


def make_video(recipe: Recipe) -> bytes:
    muxing = {"movflags": recipe.flags} if recipe.flags else {}
    # a file, since FFmpeg reads it again to move the tables to the front
    with tempfile.NamedTemporaryFile() as file:
        with av.open(file.name, "w", format=recipe.container, container_options=muxing) as output:
            stream = output.add_stream(recipe.codec, rate=30, options=dict(recipe.options))
            stream.width, stream.height = recipe.size
            stream.pix_fmt = recipe.pixel_format
            stream.codec_context.time_base = Fraction(1, 30)
            for number in range(recipe.count):
                frame = av.VideoFrame.from_ndarray(numbered_image(number, *recipe.size), format="rgb24")
                frame.pts = number if recipe.ticks is None else recipe.ticks[number]
                frame.time_base = Fraction(1, 30)
                output.mux(stream.encode(frame))
            output.mux(stream.encode(None))
        return Path(file.name).read_bytes()


@pytest.fixture(scope="session")
def videos() -> SimpleNamespace:
    """The makers of this module, since tests cannot import one another."""
    return SimpleNamespace(
        Recipe=Recipe,
        make=lambda **recipe: make_video(Recipe(**recipe)),
        image=numbered_image,
        number=read_number,
        decode=decode_all,
        opencv=read_with_opencv,
    )


@pytest.fixture(scope="session")
def mkv_bytes() -> bytes:
    """40 images of H.264 in Matroska: B-frames, a key frame every 12 images, the first decoding times missing."""
    return make_video(Recipe())


def decode_all(content: bytes) -> list[np.ndarray]:
    """The planes of all images of a video as FFmpeg decodes them, one after the other, without any seeking."""
    with av.open(io.BytesIO(content)) as container:
        frames = list(container.decode(video=0))
    return [np.concatenate([np.frombuffer(plane, np.uint8) for plane in frame.planes]) for frame in frames]


def read_with_opencv(path: Path) -> list[np.ndarray]:
    capture, images = cv2.VideoCapture(str(path)), []
    while (found := capture.read())[0]:
        images.append(found[1][:, :, ::-1])
    return images


class FullDisk(io.BytesIO):
    """A file with room for 2000 bytes."""

    def write(self, data: bytes) -> int:
        if self.tell() + len(data) > 2000:
            raise OSError(28, "No space left on device")
        return super().write(data)


@pytest.fixture
def full_disk() -> FullDisk:
    return FullDisk()


@pytest.fixture
def decoded_packets(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Sizes of the packets that the reader has given to the decoder so far."""
    from sceneloom.formats.video.reader import Cursor

    sizes: list[int] = []
    decode: Callable = Cursor._decode

    def noting(self: Cursor, packet: av.Packet, wanted: int) -> list:
        if packet.size:
            sizes.append(packet.size)
        return decode(self, packet, wanted)

    monkeypatch.setattr(Cursor, "_decode", noting)
    return sizes
