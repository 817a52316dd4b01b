"""Rules about cameras: their lenses and their videos."""

from collections.abc import Callable, Iterator
from typing import BinaryIO

from sceneloom.cameras.table import MODELS
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.sensor_times import stamps_of
from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.errors import DataError
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.findings import Severity
from sceneloom.scene.scene import Scene

_SHORTEST, _LONGEST = 0.05, 30.0
"""Focal lengths outside these parts of the picture's longer side [1] belong to no lens: 30 sees two degrees."""

_MOST_UNEQUAL = 1.5
"""Pixels are square, or nearly so."""

_OWN_FOCAL_MEANING = frozenset({"ftheta", "cylindrical", "equirectangular"})
"""Models whose two focal lengths need not be alike, or stand for something else."""


def _cameras(subject: Subject) -> Iterator[tuple[str, CameraSensor | DepthCameraSensor]]:
    for path, sensor in subject.sensors():
        if isinstance(sensor, CameraSensor | DepthCameraSensor):
            yield path, sensor


def _notices(code: str) -> Callable[[Subject], Iterator[Hit]]:
    """Tell what the reader remarked under a code."""

    def find(subject: Subject) -> Iterator[Hit]:
        return (Hit(n.place, n.message, n.count) for n in subject.remarks if n.code == code)

    return find


def _unknown_models(subject: Subject) -> Iterator[Hit]:
    for path, sensor in _cameras(subject):
        if sensor.camera.model not in MODELS:
            problem = f"{sensor.camera.model!r}; expected one of {', '.join(MODELS)}"
            yield Hit(f"{path}.intrinsics.distortion.model", problem)


def _centre_outside(subject: Subject) -> Iterator[Hit]:
    for path, sensor in _cameras(subject):
        lens = sensor.camera
        for name, centre, length in (("cx", lens.cx, lens.width), ("cy", lens.cy, lens.height)):
            if not -0.5 <= centre <= length - 0.5:
                problem = f"{centre:g}; expected a pixel of the picture, which has {length}"
                yield Hit(f"{path}.intrinsics.{name}", problem)


def _odd_focal_lengths(subject: Subject) -> Iterator[Hit]:
    for path, sensor in _cameras(subject):
        lens = sensor.camera
        if lens.model in _OWN_FOCAL_MEANING:
            continue
        larger, smaller = max(lens.fx, lens.fy), min(lens.fx, lens.fy)
        size = max(lens.width, lens.height)
        if larger > _MOST_UNEQUAL * smaller:
            yield Hit(f"{path}.intrinsics", f"fx {lens.fx:g}, fy {lens.fy:g}; expected nearly equal ones")
        elif not _SHORTEST * size <= larger <= _LONGEST * size:
            problem = f"focal length {larger:g} px for pictures of {lens.width}x{lens.height}"
            yield Hit(f"{path}.intrinsics", problem)


def _video_counts(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Compare the pictures of a video with its stamps, once for each video."""
    del subject
    sensor = frame.sensor
    if not isinstance(sensor, CameraSensor | DepthCameraSensor) or sensor.video is None or frame.number:
        return
    named = sensor.video.frame_indices
    try:
        count = _pictures_in(sensor.video.open)
    except DataError as error:
        yield Hit(f"{frame.sensor_path}.video.content", error.problem)
        return
    expected = len(stamps_of(sensor))
    fits = count == expected if named is None else max(named, default=-1) < count
    if not fits:
        problem = f"{expected} time stamps; the video has {count} pictures"
        yield Hit(f"{frame.sensor_path}.video.timestamps", problem)


def _pictures_in(open_video: Callable[[], BinaryIO]) -> int:
    """Count the pictures of a video by its packets, without decoding them.

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
        find=_notices("video-and-images"),
    ),
    Rule(
        "lens-model-known",
        Severity.WARNING,
        "The lens follows a distortion model that can be computed with.",
        "Use one of the known models; a lens can be fitted to another model.",
        find=_unknown_models,
    ),
    Rule(
        "distortion-length",
        Severity.HINT,
        "The distortion has as many numbers as its model.",
        "Write zeros for those that are missing, which is how they are read.",
        find=_notices("short-distortion"),
        fix=_as_read,
    ),
    Rule(
        "principal-point",
        Severity.WARNING,
        "The principal point lies inside the picture.",
        "See whether the lens was calibrated for another size, or the picture cut without moving cx and cy.",
        find=_centre_outside,
    ),
    Rule(
        "focal-length",
        Severity.WARNING,
        "Focal lengths are nearly equal, and those of a lens that there is.",
        "Give focal lengths in pixels of these pictures, not in millimetres or of another size.",
        find=_odd_focal_lengths,
    ),
    Rule(
        "video-count",
        Severity.ERROR,
        "A video has as many pictures as time stamps.",
        "Find out which pictures were lost, and give the others their own stamps.",
        look=_video_counts,
    ),
)
