"""Images on their trajectory into a file: videos are copied, other images become JPEG files."""

from collections.abc import Mapping
from dataclasses import dataclass
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import UInt8Array
from sceneloom.errors import ArrayError, DataError, OptionError
from sceneloom.formats.files import open_file
from sceneloom.formats.loss import Support
from sceneloom.formats.sfs.drafts import Losses, SensorDraft, with_further
from sceneloom.formats.sfs.image_notes import ImageNotesWriter, exposure_ns
from sceneloom.formats.sfs.mp4 import declared_length, is_mp4
from sceneloom.formats.sfs.spool import Blob, Spool
from sceneloom.scene.cameras import CameraImage, CameraSensor, VideoContent

JPEG_QUALITY = 95
_JPEG_START = b"\xff\xd8\xff"
_USUAL_FPS = 10.0
_PIECE = 1 << 20
_KEPT = "metadata.sceneloom.sensor_notes[].images"


@dataclass(slots=True)
class CameraDraft:
    """What a camera needs while its images come in.

    Attributes:
        draft: its record.
        notes: what single images have of their own.
    """

    draft: SensorDraft
    notes: ImageNotesWriter


@dataclass(slots=True)
class ImageWriter:
    """Spools videos and images.

    Attributes:
        spool: takes them.
        folder: for files that are needed on the way.
        losses: collects what cannot be held.
        verbatim: the images come from a file of this format and are copied, whatever they are.
    """

    spool: Spool
    folder: Path
    losses: Losses
    verbatim: bool

    def add_sensor(self, camera: CameraDraft, sensor: CameraSensor) -> None:
        """Write all images that a camera has: its video, else each as a JPEG."""
        count = len(sensor.images)
        content = (
            None if sensor.video is None or count == 0 else self._video(camera.draft, sensor, sensor.video)
        )
        if content is None:
            if sensor.fps is not None:
                camera.draft.note["fps"] = sensor.fps
                kept = "metadata.sceneloom.sensor_notes[].fps"
                self.losses.add(f"{camera.draft.location}.fps", "only videos have a rate", kept=kept)
            for image in sensor.images:
                self.add_image(camera, image)
            return
        starts = []
        for image in sensor.images:
            starts.append(image.timestamp_ns - self._half_exposure_ns(camera, image))
            camera.notes.add(image, image.extras)
        further = sensor.extras.get("video")
        video = {"timestamps": starts, "content": content, "fps": _fps(sensor.fps, starts)}
        camera.draft.fields["video"] = with_further(video, further if isinstance(further, Mapping) else {})
        camera.draft.streamed = False

    def add_image(self, camera: CameraDraft, image: CameraImage) -> None:
        """Write one image as a JPEG, copied where it is one already."""
        encoded = None if image.encoded is None else image.encoded()
        if encoded is None or not (self.verbatim or encoded.startswith(_JPEG_START)):
            what = f"encoded as JPEG of quality {JPEG_QUALITY}"
            self.losses.add(f"{camera.draft.location}.images[].content", what, support=Support.APPROXIMATED)
            encoded = encode_jpeg(image.rgb)
        start_ns = image.timestamp_ns - self._half_exposure_ns(camera, image)
        content = self.spool.add(np.frombuffer(encoded, np.uint8))
        images = camera.draft.fields.setdefault("images", [])
        images.append(with_further({"timestamp": start_ns, "content": content}, image.extras))
        camera.notes.add(image, {})

    def _half_exposure_ns(self, camera: CameraDraft, image: CameraImage) -> int:
        usual = exposure_ns(camera.draft.fields, 0)
        return exposure_ns(image.extras, usual) // 2

    def _video(self, draft: SensorDraft, sensor: CameraSensor, video: VideoContent) -> Blob | None:
        """Spool a camera's video as mp4; None where its images have to go one by one."""
        draft_file = self.folder / "video.mp4"
        if video.frame_indices is None and _copy_mp4(video, draft_file):
            _check_whole(draft_file, f"{draft.location}.video")
            return self._spooled(draft_file)
        return self._remuxed(draft, sensor, video, draft_file)

    def _remuxed(
        self, draft: SensorDraft, sensor: CameraSensor, video: VideoContent, draft_file: Path
    ) -> Blob | None:
        from sceneloom.formats.video.remux import remux_to_mp4

        times_ns = sensor.images.timestamps_ns
        increasing = bool((np.diff(times_ns) > 0).all())
        try:
            with draft_file.open("w+b") as target:
                result = remux_to_mp4(
                    video.open,
                    target,
                    timestamps_seconds=(times_ns - times_ns[0]) / 1e9 if increasing else None,
                    frame_indices=video.frame_indices,
                    name=f"{draft.location}.video",
                )
        except OptionError:
            # an odd size cannot be encoded as H.264: the images become JPEGs
            draft_file.unlink()
            return None
        except ArrayError as error:
            raise DataError(f"{draft.location}.video", "", f"does not fit its timestamps: {error}") from error
        if result.images != len(times_ns):
            problem = f"{result.images} images; expected {len(times_ns)} as its timestamps"
            raise DataError(f"{draft.location}.video", "", problem)
        if not result.copied:
            what = f"encoded as {result.codec}: {result.reason}"
            self.losses.add(f"{draft.location}.video.content", what, support=Support.APPROXIMATED)
        return self._spooled(draft_file)

    def _spooled(self, file: Path) -> Blob:
        blob = self.spool.add_file(file)
        file.unlink()
        return blob


def encode_jpeg(rgb: UInt8Array, *, quality: int = JPEG_QUALITY, subsampling: str = "444") -> bytes:
    """Encode an image (H, W, 3) uint8; unless it is stated otherwise, with full colour resolution.

    Args:
        rgb: the image.
        quality: 1 to 100.
        subsampling: "444" for full colour resolution, "420" for half of it.
    """
    from simplejpeg import encode_jpeg as encode

    content: bytes = encode(np.ascontiguousarray(rgb), quality, "RGB", subsampling)
    return content


def _copy_mp4(video: VideoContent, target: Path) -> bool:
    """Copy a video that is mp4 already; report whether it was."""
    with video.open() as source:
        start = source.read(_PIECE)
        if not is_mp4(memoryview(start)):
            return False
        with target.open("wb") as file:
            while start:
                file.write(start)
                start = source.read(_PIECE)
    return True


def _check_whole(file: Path, location: str) -> None:
    """Refuse a copy of a video that ends before its last image.

    Raises:
        DataError: it does.
    """
    with open_file(file) as opened, mmap(opened.fileno(), 0, access=ACCESS_READ) as content:
        length = declared_length(content)
        if length > len(content):
            problem = f"{len(content)} bytes; its boxes state {length}: the video was cut"
            raise DataError(location, "", problem)


def _fps(nominal: float | None, starts_ns: list[int]) -> float:
    if nominal is not None:
        return nominal
    span_ns = starts_ns[-1] - starts_ns[0]
    return (len(starts_ns) - 1) / (span_ns / 1e9) if span_ns > 0 else _USUAL_FPS


def note_losses(camera: CameraDraft, losses: Losses) -> dict[str, Any] | None:
    """Make the note about single images, and state what stands only there."""
    own = camera.notes.own_cameras
    losses.add(
        f"{camera.draft.location}.images[].camera", "one camera model per camera", count=own, kept=_KEPT
    )
    return camera.notes.record()
