"""Rules about cameras: their camera models and their videos."""

from collections.abc import Callable, Iterator
from typing import BinaryIO

from sceneloom.cameras.table import MODELS
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.sensor_times import timestamps_of
from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.errors import DataError
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.findings import Severity
from sceneloom.scene.scene import Scene

_SHORTEST, _LONGEST = 0.05, 30.0
"""Focal lengths outside these parts of the image's longer side [1] belong to no camera model: 30 sees two degrees."""

_MOST_UNEQUAL = 1.5
"""Pixels are square, or nearly so."""

_OWN_FOCAL_MEANING = frozenset({"ftheta", "cylindrical", "equirectangular"})
"""Models whose two focal lengths need not be alike, or stand for something else."""


def _cameras(subject: Subject) -> Iterator[tuple[str, CameraSensor | DepthCameraSensor]]:
    for path, sensor in subject.sensors():
        if isinstance(sensor, CameraSensor | DepthCameraSensor):
            yield path, sensor


def _warnings(code: str) -> Callable[[Subject], Iterator[Hit]]:
    """Report what the reader remarked under a code."""

    def find(subject: Subject) -> Iterator[Hit]:
        return (Hit(n.location, n.message, n.count) for n in subject.notes if n.code == code)

    return find


def _unknown_models(subject: Subject) -> Iterator[Hit]:
    for path, sensor in _cameras(subject):
        if sensor.camera.model not in MODELS:
            problem = f"{sensor.camera.model!r}; expected one of {', '.join(MODELS)}"
            yield Hit(f"{path}.intrinsics.distortion.model", problem)


def _centre_outside(subject: Subject) -> Iterator[Hit]:
    for path, sensor in _cameras(subject):
        camera_model = sensor.camera
        for name, centre, length in (
            ("cx", camera_model.cx, camera_model.width),
            ("cy", camera_model.cy, camera_model.height),
        ):
            if not -0.5 <= centre <= length - 0.5:
                problem = f"{centre:g}; expected a pixel of the image, which has {length}"
                yield Hit(f"{path}.intrinsics.{name}", problem)


def _odd_focal_lengths(subject: Subject) -> Iterator[Hit]:
    for path, sensor in _cameras(subject):
        camera_model = sensor.camera
        if camera_model.model in _OWN_FOCAL_MEANING:
            continue
        larger, smaller = max(camera_model.fx, camera_model.fy), min(camera_model.fx, camera_model.fy)
        size = max(camera_model.width, camera_model.height)
        if larger > _MOST_UNEQUAL * smaller:
            yield Hit(
                f"{path}.intrinsics",
                f"fx {camera_model.fx:g}, fy {camera_model.fy:g}; expected nearly equal ones",
            )
        elif not _SHORTEST * size <= larger <= _LONGEST * size:
            problem = f"focal length {larger:g} px for images of {camera_model.width}x{camera_model.height}"
            yield Hit(f"{path}.intrinsics", problem)


def _video_counts(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Compare the images of a video with its timestamps, once for each video."""
    del subject
    sensor = frame.sensor
    if not isinstance(sensor, CameraSensor | DepthCameraSensor) or sensor.video is None or frame.number:
        return
    named = sensor.video.frame_indices
    try:
        count = _images_in(sensor.video.open)
    except DataError as error:
        yield Hit(f"{frame.sensor_path}.video.content", error.problem)
        return
    expected = len(timestamps_of(sensor))
    fits = count == expected if named is None else max(named, default=-1) < count
    if not fits:
        problem = f"{expected} timestamps; the video has {count} images"
        yield Hit(f"{frame.sensor_path}.video.timestamps", problem)


def _images_in(open_video: Callable[[], BinaryIO]) -> int:
    """Count the images of a video by its packets, without decoding them.

    Raises:
        DataError: it is no video, or broken.
    """
    from sceneloom.formats.video.reader import VideoReader

    with VideoReader(open_video, name="video") as reader:
        return reader.count


def _as_read(scene: Scene) -> Scene:
    """What the reader brought into order needs only to be written."""
    return scene


RULES: tuple[Rule, ...] = (
    Rule(
        "video-or-images",
        Severity.WARNING,
        "A camera has a video or images, not both.",
        "Leave one of them out; the video is taken, the images are carried along.",
        find=_warnings("video-and-images"),
    ),
    Rule(
        "camera-model-model-known",
        Severity.WARNING,
        "The camera model follows a distortion model that can be computed with.",
        "Use one of the known models; a camera model can be fitted to another model.",
        find=_unknown_models,
    ),
    Rule(
        "distortion-length",
        Severity.HINT,
        "The distortion has as many numbers as its model.",
        "Write zeros for those that are missing, which is how they are read.",
        find=_warnings("short-distortion"),
        fix=_as_read,
    ),
    Rule(
        "principal-point",
        Severity.WARNING,
        "The principal point lies inside the image.",
        "See whether the camera model was calibrated for another size, or the image cut without moving cx and cy.",
        find=_centre_outside,
    ),
    Rule(
        "focal-length",
        Severity.WARNING,
        "Focal lengths are nearly equal, and those of a camera model that there is.",
        "Give focal lengths in pixels of these images, not in millimetres or of another size.",
        find=_odd_focal_lengths,
    ),
    Rule(
        "video-count",
        Severity.ERROR,
        "A video has as many images as timestamps.",
        "Find out which images were lost, and give the others their own timestamps.",
        look=_video_counts,
    ),
)
