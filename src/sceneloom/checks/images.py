"""Rules about images: of the size that the camera model is for, and showing something new."""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import UInt8Array
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.findings import Severity
from sceneloom.scene.types import Identifier, key_of

_STEP_PX = 8
"""Every eighth row and column reports whether an image is of one colour."""

_DARK = 10
_PLAIN = 4


@dataclass(slots=True)
class CameraFacts:
    """The images of one camera so far.

    Attributes:
        path: of the camera.
        count: of the images that could be decoded.
        other_sizes: numbers and sizes of images that the camera model is not for.
        digest: of the latest image.
        repeated: numbers of images that are equal to the one before.
        plain: numbers of images of one colour, with that colour.
    """

    path: str
    count: int = 0
    other_sizes: list[tuple[int, int, int]] = field(default_factory=list)
    digest: int | None = None
    repeated: list[int] = field(default_factory=list)
    plain: list[tuple[int, str]] = field(default_factory=list)


def _facts(subject: Subject) -> dict[tuple[type, Identifier], CameraFacts]:
    return subject.table("facts of cameras", lambda _: {})


def _look(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Take an image in once for all rules; what all show is stated at the end."""
    yield from ()
    latest = subject.table("the image in hand", lambda _: {"path": ""})
    if latest["path"] == frame.path or not isinstance(frame.sensor, CameraSensor):
        return
    latest["path"] = frame.path
    key = key_of(frame.sensor.id)
    facts = _facts(subject).setdefault(key, CameraFacts(frame.sensor_path))
    if isinstance(frame.frame, CameraImage):
        _take(facts, frame.sensor, frame.number, frame.frame)
    else:
        facts.digest = None


def _take(facts: CameraFacts, sensor: CameraSensor, number: int, image: CameraImage) -> None:
    rgb = image.rgb
    facts.count += 1
    height, width = rgb.shape[:2]
    camera_model = sensor.camera
    if (width, height) != (camera_model.width, camera_model.height) and image.camera == camera_model.resized(
        width, height
    ):
        facts.other_sizes.append((number, width, height))
    digest = zlib.crc32(np.ascontiguousarray(rgb).data)
    if digest == facts.digest:
        facts.repeated.append(number)
    facts.digest = digest
    colour = _one_colour(rgb)
    if colour is not None:
        facts.plain.append((number, colour))


def _one_colour(rgb: UInt8Array) -> str | None:
    some = rgb[::_STEP_PX, ::_STEP_PX].reshape(-1, 3)
    if len(some) == 0:
        return None
    lowest, highest = some.min(axis=0), some.max(axis=0)
    if highest.max() < _DARK:
        return "black"
    return f"of one colour, {some[0].tolist()}" if (highest - lowest).max() < _PLAIN else None


def _sizes(subject: Subject) -> Iterator[Hit]:
    for facts in _facts(subject).values():
        if facts.other_sizes:
            number, width, height = facts.other_sizes[0]
            message = f"{width} x {height} px; `intrinsics` are for another size, and were scaled to this one"
            yield Hit(f"{facts.path}.images[{number}]", message, count=len(facts.other_sizes))


def _repeated(subject: Subject) -> Iterator[Hit]:
    for facts in _facts(subject).values():
        if facts.repeated:
            message = f"{len(facts.repeated)} of {facts.count} images are equal to the one before"
            yield Hit(f"{facts.path}.images[{facts.repeated[0]}]", message, count=len(facts.repeated))


def _plain(subject: Subject) -> Iterator[Hit]:
    for facts in _facts(subject).values():
        if facts.plain:
            number, colour = facts.plain[0]
            more = f", as are {len(facts.plain) - 1} more" if len(facts.plain) > 1 else ""
            yield Hit(f"{facts.path}.images[{number}]", f"{colour}{more}", count=len(facts.plain))


RULES: tuple[Rule, ...] = (
    Rule(
        "image-size",
        Severity.WARNING,
        "Images have the width and height that the camera's intrinsics are for.",
        "Write the intrinsics for the images as they are stored.",
        look=_look,
        conclude=_sizes,
    ),
    Rule(
        "image-repeated",
        Severity.HINT,
        "No image is equal to the one before it.",
        "Look whether the camera hung, or images were filled in.",
        look=_look,
        conclude=_repeated,
    ),
    Rule(
        "image-plain",
        Severity.HINT,
        "Images show more than one colour.",
        "Look whether the camera was covered or not exposed.",
        look=_look,
        conclude=_plain,
    ),
)
