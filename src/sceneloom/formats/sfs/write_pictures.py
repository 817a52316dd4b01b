"""Pictures on their way into a file: videos are copied, other pictures become JPEG files."""

from collections.abc import Mapping
from dataclasses import dataclass
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import UInt8Array
from sceneloom.errors import ArrayError, DataError, OptionError
from sceneloom.formats.files import open_file
from sceneloom.formats.loss import Fate
from sceneloom.formats.sfs.drafts import Losses, SensorDraft, with_further
from sceneloom.formats.sfs.mp4 import declared_length, is_mp4
from sceneloom.formats.sfs.picture_notes import PictureNotesWriter, exposure_ns
from sceneloom.formats.sfs.spool import Blob, Spool
from sceneloom.scene.cameras import CameraSensor, Picture, VideoContent

JPEG_QUALITY = 95
_JPEG_START = b"\xff\xd8\xff"
_USUAL_FPS = 10.0
_PIECE = 1 << 20
_KEPT = "metadata.sceneloom.sensor_notes[].pictures"


@dataclass(slots=True)
class CameraDraft:
    """What a camera needs while its pictures come in.

    Attributes:
        draft: its record.
        notes: what single pictures have of their own.
    """

    draft: SensorDraft
    notes: PictureNotesWriter


@dataclass(slots=True)
class PictureWriter:
    """Spools videos and pictures.

    Attributes:
        spool: takes them.
        folder: for files that are needed on the way.
        losses: collects what cannot be held.
        verbatim: the pictures come from a file of this format and are copied, whatever they are.
    """

    spool: Spool
    folder: Path
    losses: Losses
    verbatim: bool

    def add_sensor(self, camera: CameraDraft, sensor: CameraSensor) -> None:
        """Write all pictures that a camera has: its video, else each as a JPEG."""
        count = len(sensor.pictures)
        content = (
            None if sensor.video is None or count == 0 else self._video(camera.draft, sensor, sensor.video)
        )
        if content is None:
            if sensor.fps is not None:
                camera.draft.note["fps"] = sensor.fps
                kept = "metadata.sceneloom.sensor_notes[].fps"
                self.losses.add(f"{camera.draft.place}.fps", "only videos have a rate", kept=kept)
            for picture in sensor.pictures:
                self.add_picture(camera, picture)
            return
        starts = []
        for picture in sensor.pictures:
            starts.append(picture.timestamp_ns - self._half_exposure_ns(camera, picture))
            camera.notes.add(picture, picture.extras)
        further = sensor.extras.get("video")
        video = {"timestamps": starts, "content": content, "fps": _fps(sensor.fps, starts)}
        camera.draft.fields["video"] = with_further(video, further if isinstance(further, Mapping) else {})
        camera.draft.streamed = False

    def add_picture(self, camera: CameraDraft, picture: Picture) -> None:
        """Write one picture as a JPEG, copied where it is one already."""
        encoded = None if picture.encoded is None else picture.encoded()
        if encoded is None or not (self.verbatim or encoded.startswith(_JPEG_START)):
            what = f"encoded as JPEG of quality {JPEG_QUALITY}"
            self.losses.add(f"{camera.draft.place}.images[].content", what, fate=Fate.APPROXIMATED)
            encoded = encode_jpeg(picture.rgb)
        start_ns = picture.timestamp_ns - self._half_exposure_ns(camera, picture)
        content = self.spool.add(np.frombuffer(encoded, np.uint8))
        images = camera.draft.fields.setdefault("images", [])
        images.append(with_further({"timestamp": start_ns, "content": content}, picture.extras))
        camera.notes.add(picture, {})

    def _half_exposure_ns(self, camera: CameraDraft, picture: Picture) -> int:
        usual = exposure_ns(camera.draft.fields, 0)
        return exposure_ns(picture.extras, usual) // 2

    def _video(self, draft: SensorDraft, sensor: CameraSensor, video: VideoContent) -> Blob | None:
        """Spool a camera's video as mp4; None where its pictures have to go one by one."""
        draft_file = self.folder / "video.mp4"
        if video.frame_indices is None and _copy_mp4(video, draft_file):
            _check_whole(draft_file, f"{draft.place}.video")
            return self._spooled(draft_file)
        return self._remuxed(draft, sensor, video, draft_file)

    def _remuxed(
        self, draft: SensorDraft, sensor: CameraSensor, video: VideoContent, draft_file: Path
    ) -> Blob | None:
        from sceneloom.formats.video.remux import remux_to_mp4

        times_ns = sensor.pictures.timestamps_ns
        increasing = bool((np.diff(times_ns) > 0).all())
        try:
            with draft_file.open("w+b") as target:
                result = remux_to_mp4(
                    video.open,
                    target,
                    timestamps_seconds=(times_ns - times_ns[0]) / 1e9 if increasing else None,
                    frame_indices=video.frame_indices,
                    name=f"{draft.place}.video",
                )
        except OptionError:
            # an odd size cannot be encoded as H.264: the pictures become JPEGs
            draft_file.unlink()
            return None
        except ArrayError as error:
            raise DataError(f"{draft.place}.video", "", f"does not fit its time stamps: {error}") from error
        if result.pictures != len(times_ns):
            problem = f"{result.pictures} pictures; expected {len(times_ns)} as its time stamps"
            raise DataError(f"{draft.place}.video", "", problem)
        if not result.copied:
            what = f"encoded as {result.codec}: {result.reason}"
            self.losses.add(f"{draft.place}.video.content", what, fate=Fate.APPROXIMATED)
        return self._spooled(draft_file)

    def _spooled(self, file: Path) -> Blob:
        blob = self.spool.add_file(file)
        file.unlink()
        return blob


def encode_jpeg(rgb: UInt8Array, *, quality: int = JPEG_QUALITY, subsampling: str = "444") -> bytes:
    """Encode a picture (H, W, 3) uint8; unless it is said otherwise, with full colour resolution.

    Args:
        rgb: the picture.
        quality: 1 to 100.
        subsampling: "444" for full colour resolution, "420" for half of it.
    """
    from simplejpeg import encode_jpeg as encode

    content: bytes = encode(np.ascontiguousarray(rgb), quality, "RGB", subsampling)
    return content


def _copy_mp4(video: VideoContent, target: Path) -> bool:
    """Copy a video that is mp4 already; say whether it was."""
    with video.open() as source:
        start = source.read(_PIECE)
        if not is_mp4(memoryview(start)):
            return False
        with target.open("wb") as file:
            while start:
                file.write(start)
                start = source.read(_PIECE)
    return True


def _check_whole(file: Path, place: str) -> None:
    """Refuse a copy of a video that ends before its last picture.

    Raises:
        DataError: it does.
    """
    with open_file(file) as opened, mmap(opened.fileno(), 0, access=ACCESS_READ) as content:
        length = declared_length(content)
        if length > len(content):
            problem = f"{len(content)} bytes; its boxes say {length}: the video was cut"
            raise DataError(place, "", problem)


def _fps(nominal: float | None, starts_ns: list[int]) -> float:
    if nominal is not None:
        return nominal
    span_ns = starts_ns[-1] - starts_ns[0]
    return (len(starts_ns) - 1) / (span_ns / 1e9) if span_ns > 0 else _USUAL_FPS


def note_losses(camera: CameraDraft, losses: Losses) -> dict[str, Any] | None:
    """Make the note about single pictures, and say what stands only there."""
    own = camera.notes.own_cameras
    losses.add(f"{camera.draft.place}.pictures[].camera", "one lens per camera", count=own, kept=_KEPT)
    return camera.notes.record()
