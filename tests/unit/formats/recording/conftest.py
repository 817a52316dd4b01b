"""Small recordings, written by hand: plain json, struct, PyAV and Pillow."""

import json
import struct
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from sceneloom.formats.recording.spec import FORMAT
from sceneloom.scene import Scene

IDENTITY_ROWS = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


class RecordingFolder:
    """A folder that is filled file by file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.mkdir()

    def lines(self, lines: Iterable[Mapping[str, Any] | str]) -> "RecordingFolder":
        """Write `data.jsonl`; text goes in as it is."""
        texts = [line if isinstance(line, str) else json.dumps(line) for line in lines]
        (self.path / "data.jsonl").write_text("".join(text + "\n" for text in texts))
        return self

    def calibration(self, cameras: Sequence[Mapping[str, Any]] = (), **further: Any) -> "RecordingFolder":
        """Write `calibration.json`."""
        (self.path / "calibration.json").write_text(json.dumps({"cameras": list(cameras), **further}))
        return self

    def video(self, name: str, count: int, *, width: int = 32, height: int = 16) -> "RecordingFolder":
        """Write a lossless video whose image k is grey 10 k."""
        with av.open(str(self.path / name), "w") as container:
            stream = container.add_stream("ffv1", rate=10, options={"threads": "1"})
            stream.width, stream.height, stream.pix_fmt = width, height, "bgr0"
            for k in range(count):
                pixels = np.full((height, width, 3), 10 * k, np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format="bgr0")))
            container.mux(stream.encode())
        return self

    def pngs(self, name: str, count: int, *, width: int = 32, height: int = 16) -> "RecordingFolder":
        """Write a folder of PNG images whose image k is grey 10 k."""
        (self.path / name).mkdir()
        for k in range(count):
            Image.new("RGB", (width, height), (10 * k,) * 3).save(self.path / name / f"{k:08d}.png")
        return self

    def depth_video(self, name: str, images: Sequence[np.ndarray]) -> "RecordingFolder":
        """Write images of 16-bit steps, (H, W) uint16, as FFV1."""
        with av.open(str(self.path / name), "w") as container:
            stream = container.add_stream("ffv1", rate=10, options={"threads": "1"})
            stream.height, stream.width = images[0].shape
            stream.pix_fmt = "gray16le"
            for image in images:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray16le")))
            container.mux(stream.encode())
        return self

    def depth_pngs(self, name: str, images: Sequence[np.ndarray]) -> "RecordingFolder":
        """Write images of 16-bit steps as PNG images."""
        (self.path / name).mkdir()
        for k, image in enumerate(images):
            Image.fromarray(image).save(self.path / name / f"{k:08d}.png")
        return self

    def points(self, name: str, points: Iterable[tuple[float, ...]], *, extra: bytes = b"") -> "RecordingFolder":
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
