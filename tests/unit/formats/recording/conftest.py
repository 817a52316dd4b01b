"""Small recordings, written by hand: plain json, struct, PyAV and Pillow."""

import json
import struct
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import av
import numpy as np
import pytest
from PIL import Image

from sceneloom.formats.recording.spec import FORMAT
from sceneloom.scene import Scene

IDENTITY_ROWS = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def greys(images: int | Sequence[np.ndarray], size: tuple[int, int]) -> Sequence[np.ndarray]:
    return [np.full((*size[::-1], 3), 10 * k, np.uint8) for k in range(images)] if isinstance(images, int) else images


class RecordingFolder:
    """A folder that is filled file by file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.mkdir()

    def lines(self, lines: Iterable[Mapping[str, Any] | str]) -> Self:
        """Write `data.jsonl`; text goes in as it is."""
        texts = [line if isinstance(line, str) else json.dumps(line) for line in lines]
        (self.path / "data.jsonl").write_text("".join(text + "\n" for text in texts))
        return self

    def calibration(self, cameras: Sequence[Mapping[str, Any]] = (), **further: Any) -> Self:
        """Write `calibration.json`."""
        (self.path / "calibration.json").write_text(json.dumps({"cameras": list(cameras), **further}))
        return self

    def video(self, name: str, images: int | Sequence[np.ndarray], *, size: tuple[int, int] = (32, 16)) -> Self:
        """Write a lossless video: so many images, of which image k is grey 10 k, or these, (H, W) uint16 steps."""
        kinds = ("rgb24", "bgr0") if isinstance(images, int) else ("gray16le", "gray16le")
        with av.open(str(self.path / name), "w") as container:
            stream = container.add_stream("ffv1", rate=10, options={"threads": "1"})
            stream.width, stream.height, stream.pix_fmt = *size, kinds[1]
            for image in greys(images, size):
                frame = av.VideoFrame.from_ndarray(image, format=kinds[0]).reformat(format=kinds[1])
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        return self

    def pngs(self, name: str, images: int | Sequence[np.ndarray]) -> Self:
        """Write a folder of such images as PNG images."""
        (self.path / name).mkdir()
        for k, image in enumerate(greys(images, (32, 16))):
            Image.fromarray(image).save(self.path / name / f"{k:08d}.png")
        return self

    def points(self, name: str, points: Iterable[tuple[float, ...]], *, extra: bytes = b"") -> Self:
        """Write a lidar file of (x, y, z, intensity, ring, timestamp) records."""
        file = self.path / name
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(b"".join(struct.pack("<fffBHd", *point) for point in points) + extra)
        return self

    def open(self, **options: Any) -> Scene:
        """The recording as a scene."""
        return FORMAT.open(self.path, **options)


@pytest.fixture
def recording(tmp_path: Path) -> RecordingFolder:
    """An empty recording."""
    return RecordingFolder(tmp_path / "drive")


@pytest.fixture
def pinhole() -> dict[str, Any]:
    """The calibration of a camera of 32x16 pixels."""
    return {
        "model": "pinhole",
        "distortionCoefficients": [],
        "focalLengthX": 20.0,
        "focalLengthY": 21.0,
        "principalPointX": 15.5,
        "principalPointY": 7.5,
        "imageWidth": 32,
        "imageHeight": 16,
        "imuToCamera": IDENTITY_ROWS,
    }
