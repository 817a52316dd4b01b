"""Rules about the lenses of a calibration: focal lengths and principal points that belong to no camera."""

from collections.abc import Iterator
from dataclasses import dataclass

from sceneloom.checks.reading import as_read, notices_of_code
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.formats.recording.lenses import CameraParameters
from sceneloom.scene.findings import Severity

SHORTEST, LONGEST = 0.2, 5.0
"""Focal lengths outside these parts of the picture's width are rare: they see 136° and more, or 11° and less."""
MOST_UNEQUAL = 1.1
"""Focal lengths of square pixels differ by less."""
OFF_CENTRE = 0.2
"""The principal point lies within this part of the picture's width and height around its centre."""
_PARTS, _MILLIMETRES = 2.0, 50.0
"""A focal length up to the first number is none in pixels but in widths of the picture, up to the second in mm."""
_HALVES = (2.0, 4.0, 0.5, 0.25)
"""A principal point at so many times the centre comes from pictures that were made smaller or larger."""
_NEAR = 0.05
"""Lengths in pixels are alike within this share."""


@dataclass(frozen=True, slots=True)
class _Lens:
    """Numbers of a lens, for pictures of a size [px].

    Attributes:
        place: where they stand.
        fx, fy, cx, cy: as the file has them.
        width, height: of the pictures that they are for.
    """

    place: str
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


def _lenses(subject: Subject) -> Iterator[_Lens]:
    """The lenses of the calibration that are complete, each with the picture size that it is for."""
    if subject.recording is None:
        return
    folder = str(subject.recording.folder)
    sizes = {str(c.id): (c.camera.width, c.camera.height) for c in subject.scene.cameras}
    for index, camera in sorted(subject.recording.calibration.cameras.items()):
        size = _size(camera.parameters) or sizes.get(f"camera{index}")
        p = camera.parameters
        numbers = (p.focalLengthX, p.focalLengthY, p.principalPointX, p.principalPointY)
        fx, fy, cx, cy = (float("nan") if number is None else float(number) for number in numbers)
        if size is not None and None not in numbers:
            yield _Lens(camera.place.removeprefix(folder).lstrip("/"), fx, fy, cx, cy, *size)


def _size(parameters: CameraParameters) -> tuple[int, int] | None:
    width, height = parameters.imageWidth, parameters.imageHeight
    if width is None or height is None or min(width, height) < 1:
        return None
    return int(width), int(height)


def _focal_lengths(subject: Subject) -> Iterator[Hit]:
    for lens in _lenses(subject):
        larger, smaller = max(lens.fx, lens.fy), min(lens.fx, lens.fy)
        if smaller <= 0:
            yield Hit(
                f"{lens.place}.focalLengthX",
                f"{lens.fx:g}, focalLengthY {lens.fy:g}; expected positive numbers",
            )
        elif not SHORTEST * lens.width <= larger <= LONGEST * lens.width:
            told = (
                f"{lens.fx:g} px for pictures {lens.width} px wide; "
                f"expected {SHORTEST * lens.width:g} to {LONGEST * lens.width:g}"
            )
            yield Hit(f"{lens.place}.focalLengthX", f"{told}{_unit(larger)}")
        elif larger > MOST_UNEQUAL * smaller:
            told = f"{lens.fx:g}, focalLengthY {lens.fy:g}; expected nearly equal ones, as of square pixels"
            yield Hit(f"{lens.place}.focalLengthX", told)


def _unit(focal_length: float) -> str:
    if focal_length <= _PARTS:
        return ": probably in parts of the picture's width"
    return ": probably in millimetres" if focal_length <= _MILLIMETRES else ""


def _principal_points(subject: Subject) -> Iterator[Hit]:
    for lens in _lenses(subject):
        off_x = abs(lens.cx - (lens.width - 1) / 2) / lens.width
        off_y = abs(lens.cy - (lens.height - 1) / 2) / lens.height
        if max(off_x, off_y) > OFF_CENTRE:
            told = (
                f"{lens.cx:g}, principalPointY {lens.cy:g} in pictures of {lens.width}x{lens.height}; expected a point "
                f"near {(lens.width - 1) / 2:g}, {(lens.height - 1) / 2:g}"
            )
            yield Hit(f"{lens.place}.principalPointX", f"{told}{_meant(lens)}")


def _meant(lens: _Lens) -> str:
    if abs(lens.cx) <= 1 and abs(lens.cy) <= 1:
        return ": probably in parts of the picture"
    if _is_near(lens.cy, lens.width / 2) and _is_near(lens.cx, lens.height / 2):
        return ": probably x and y are exchanged"
    for times in _HALVES:
        if _is_near(lens.cx, times * lens.width / 2) and _is_near(lens.cy, times * lens.height / 2):
            return f": probably for pictures {times:g} times as wide and high"
    return ""


def _is_near(value: float, wanted: float) -> bool:
    return abs(value - wanted) <= _NEAR * wanted


RULES: tuple[Rule, ...] = (
    Rule(
        "calibration-focal-length",
        Severity.WARNING,
        f"Focal lengths of a calibration are {SHORTEST:g} to {LONGEST:g} picture widths, and differ by less than "
        f"{MOST_UNEQUAL - 1:.0%}.",
        "Write pixels of the pictures that imageWidth and imageHeight tell.",
        find=_focal_lengths,
    ),
    Rule(
        "calibration-principal-point",
        Severity.WARNING,
        f"Principal points of a calibration lie within {OFF_CENTRE:.0%} of the picture's size around its centre.",
        "See whether the lens was calibrated for another size, or the picture cut without moving the point.",
        find=_principal_points,
    ),
    Rule(
        "calibration-size",
        Severity.WARNING,
        "Pictures have the `imageWidth` and `imageHeight` that their lens is calibrated for.",
        "Write the numbers for the pictures as they are; `--fix` scales them, which is wrong for cut pictures.",
        find=notices_of_code("lens-scaled"),
        fix=as_read,
    ),
)
