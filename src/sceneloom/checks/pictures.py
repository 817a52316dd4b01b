"""Rules about pictures: of the size that the lens is for, and showing something new."""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import UInt8Array
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.scene.cameras import CameraSensor, Picture
from sceneloom.scene.findings import Severity
from sceneloom.scene.types import Identifier, key_of

_STEP_PX = 8
"""Every eighth row and column tells whether a picture is of one colour."""

_DARK = 10
_PLAIN = 4


@dataclass(slots=True)
class CameraFacts:
    """The pictures of one camera so far.

    Attributes:
        path: of the camera.
        count: of the pictures that could be decoded.
        other_sizes: numbers and sizes of pictures that the lens is not for.
        digest: of the latest picture.
        repeated: numbers of pictures that are equal to the one before.
        plain: numbers of pictures of one colour, with that colour.
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
    """Take a picture in once for all rules; what all show is said at the end."""
    yield from ()
    latest = subject.table("the picture in hand", lambda _: {"path": ""})
    if latest["path"] == frame.path or not isinstance(frame.sensor, CameraSensor):
        return
    latest["path"] = frame.path
    key = key_of(frame.sensor.id)
    facts = _facts(subject).setdefault(key, CameraFacts(frame.sensor_path))
    if isinstance(frame.frame, Picture):
        _take(facts, frame.sensor, frame.number, frame.frame)
    else:
        facts.digest = None


def _take(facts: CameraFacts, sensor: CameraSensor, number: int, picture: Picture) -> None:
    rgb = picture.rgb
    facts.count += 1
    height, width = rgb.shape[:2]
    lens = sensor.camera
    if (width, height) != (lens.width, lens.height) and picture.camera == lens.resized(width, height):
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
            yield Hit(f"{facts.path}.pictures[{number}]", message, count=len(facts.other_sizes))


def _repeated(subject: Subject) -> Iterator[Hit]:
    for facts in _facts(subject).values():
        if facts.repeated:
            message = f"{len(facts.repeated)} of {facts.count} pictures are equal to the one before"
            yield Hit(f"{facts.path}.pictures[{facts.repeated[0]}]", message, count=len(facts.repeated))


def _plain(subject: Subject) -> Iterator[Hit]:
    for facts in _facts(subject).values():
        if facts.plain:
            number, colour = facts.plain[0]
            more = f", as are {len(facts.plain) - 1} more" if len(facts.plain) > 1 else ""
            yield Hit(f"{facts.path}.pictures[{number}]", f"{colour}{more}", count=len(facts.plain))


RULES: tuple[Rule, ...] = (
    Rule(
        "picture-size",
        Severity.WARNING,
        "Pictures have the width and height that the camera's intrinsics are for.",
        "Write the intrinsics for the pictures as they are stored.",
        look=_look,
        conclude=_sizes,
    ),
    Rule(
        "picture-repeated",
        Severity.HINT,
        "No picture is equal to the one before it.",
        "Look whether the camera hung, or pictures were filled in.",
        look=_look,
        conclude=_repeated,
    ),
    Rule(
        "picture-plain",
        Severity.HINT,
        "Pictures show more than one colour.",
        "Look whether the camera was covered or not exposed.",
        look=_look,
        conclude=_plain,
    ),
)
