"""A video as the images of a camera: opened when it is first needed, by each process for itself."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO

import numpy as np

from sceneloom.arrays import Int64Array, UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError
from sceneloom.formats.files import open_file
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.video.reader import VideoReader, open_video
from sceneloom.scene.cameras import CameraImage, VideoContent


class VideoFile:
    """A video by its path. In another process it opens again, if it is still the file that was opened here.

    Attributes:
        path: the file.
        cut_off: whether only what is left of a damaged video is read.
    """

    def __init__(self, path: Path) -> None:
        """Open nothing yet."""
        self.path = path
        self.cut_off = False
        self._closed = False
        self._reader: VideoReader | None = None
        self._lock = Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "cut_off": self.cut_off, "_closed": self._closed, "_reader": self._reader}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock = Lock()

    def reader(self) -> VideoReader:
        """The open video.

        Raises:
            DataError: it cannot be read as one, or was closed.
        """
        with self._lock:
            if self._closed:
                raise DataError(self.path, "", "is closed")
            if self._reader is None:
                self._reader = open_video(self.path, cut_off=self.cut_off)
            return self._reader

    def whole_or_left(self, ledger: Ledger) -> VideoReader:
        """The open video with its list of images; a lenient reading takes what is left of one that breaks off.

        Raises:
            DataError: it cannot be read, or no image of it is left.
        """
        reader = self.reader()
        try:
            reader.index  # noqa: B018 - the walk through the packets finds out whether it is whole
        except DataError as error:
            if not ledger.lenient:
                raise
            reader.close()
            self._reader, self.cut_off = None, True
            try:
                count = self.reader().count
            except DataError:
                count = 0
            if count == 0:
                raise error from None
            problem = f"{error.problem}; its first {count} images are read"
            ledger.fault("unreadable-videos", DataError(error.file, error.location, problem))
        return self.reader()

    def rgb(self, index: int) -> UInt8Array:
        """Decode one image."""
        return self.reader().rgb(index)

    def container_ns(self) -> Int64Array:
        """The times that the video has itself, (N,) int64 [ns], rounded from its ticks once each.

        Raises:
            DataError: it has none.
        """
        index = self.reader().index
        if not index.timed:
            raise DataError(self.path, "", "has no times of its own; give them with csv, lines or rate_hz")
        ticks, base = index.pts.tolist(), index.time_base * 10**9
        return np.array([round(tick * base) for tick in ticks], np.int64)

    def open_binary(self) -> BinaryIO:
        """Open the video's bytes."""
        return open_file(self.path)

    def content(self, chosen: Int64Array) -> VideoContent | None:
        """The video for those who copy it, with the images that are used of it; None for what is left of one."""
        if self.cut_off:
            return None
        reader = self.reader()
        whole = np.array_equal(chosen, np.arange(reader.count))
        return VideoContent(self.open_binary, reader.codec, None if whole else tuple(chosen.tolist()))

    def close(self) -> None:
        """Release the file; no image can be read afterwards."""
        with self._lock:
            self._closed = True
            if self._reader is not None:
                self._reader.close()
            self._reader = None


@dataclass(frozen=True, slots=True, eq=False)
class VideoImages:
    """Makes the images of one camera from a video.

    Attributes:
        video: the file.
        chosen: (N,) int64, number of each image in the video.
        timestamps_ns: (N,) int64 [ns].
        camera: the camera model of all.
    """

    video: VideoFile
    chosen: Int64Array
    timestamps_ns: Int64Array
    camera: Camera

    def __call__(self, k: int) -> CameraImage:
        """Make image `k` without decoding it."""
        return CameraImage(
            int(self.timestamps_ns[k]), self.camera, partial(self.video.rgb, int(self.chosen[k]))
        )
