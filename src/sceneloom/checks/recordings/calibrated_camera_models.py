"""Rules about the camera models of a calibration: focal lengths and principal points that belong to no camera."""

from collections.abc import Iterator
from dataclasses import dataclass

from sceneloom.checks.reading import as_read, warnings_of_code
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.formats.recording.camera_models import CameraParameters
from sceneloom.scene.findings import Severity

SHORTEST, LONGEST = 0.2, 5.0
"""Focal lengths outside these parts of the image's width are rare: they see 136° and more, or 11° and less."""
MOST_UNEQUAL = 1.1
"""Focal lengths of square pixels differ by less."""
OFF_CENTRE = 0.2
"""The principal point lies within this part of the image's width and height around its centre."""
_PARTS, _MILLIMETRES = 2.0, 50.0
"""A focal length up to the first number is none in pixels but in widths of the image, up to the second in mm."""
_HALVES = (2.0, 4.0, 0.5, 0.25)
"""A principal point at so many times the centre comes from images that were made smaller or larger."""
_NEAR = 0.05
"""Lengths in pixels are alike within this share."""


@dataclass(frozen=True, slots=True)
class _CameraModel:
    """Numbers of a camera model, for images of a size [px].

    Attributes:
        location: where they stand.
        fx, fy, cx, cy: as the file has them.
        width, height: of the images that they are for.
    """

    location: str
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


def _camera_models(subject: Subject) -> Iterator[_CameraModel]:
    """The camera models of the calibration that are complete, each with the image size that it is for."""
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
            yield _CameraModel(camera.location.removeprefix(folder).lstrip("/"), fx, fy, cx, cy, *size)


def _size(parameters: CameraParameters) -> tuple[int, int] | None:
    width, height = parameters.imageWidth, parameters.imageHeight
    if width is None or height is None or min(width, height) < 1:
        return None
    return int(width), int(height)


def _focal_lengths(subject: Subject) -> Iterator[Hit]:
    for camera_model in _camera_models(subject):
        larger, smaller = max(camera_model.fx, camera_model.fy), min(camera_model.fx, camera_model.fy)
        if smaller <= 0:
            yield Hit(
                f"{camera_model.location}.focalLengthX",
                f"{camera_model.fx:g}, focalLengthY {camera_model.fy:g}; expected positive numbers",
            )
        elif not SHORTEST * camera_model.width <= larger <= LONGEST * camera_model.width:
            reported = (
                f"{camera_model.fx:g} px for images {camera_model.width} px wide; "
                f"expected {SHORTEST * camera_model.width:g} to {LONGEST * camera_model.width:g}"
            )
            yield Hit(f"{camera_model.location}.focalLengthX", f"{reported}{_unit(larger)}")
        elif larger > MOST_UNEQUAL * smaller:
            reported = f"{camera_model.fx:g}, focalLengthY {camera_model.fy:g}; expected nearly equal ones, as of square pixels"
            yield Hit(f"{camera_model.location}.focalLengthX", reported)


def _unit(focal_length: float) -> str:
    if focal_length <= _PARTS:
        return ": probably in parts of the image's width"
    return ": probably in millimetres" if focal_length <= _MILLIMETRES else ""


def _principal_points(subject: Subject) -> Iterator[Hit]:
    for camera_model in _camera_models(subject):
        off_x = abs(camera_model.cx - (camera_model.width - 1) / 2) / camera_model.width
        off_y = abs(camera_model.cy - (camera_model.height - 1) / 2) / camera_model.height
        if max(off_x, off_y) > OFF_CENTRE:
            reported = (
                f"{camera_model.cx:g}, principalPointY {camera_model.cy:g} in images of "
                f"{camera_model.width}x{camera_model.height}; expected a point "
                f"near {(camera_model.width - 1) / 2:g}, {(camera_model.height - 1) / 2:g}"
            )
            yield Hit(f"{camera_model.location}.principalPointX", f"{reported}{_meant(camera_model)}")


def _meant(camera_model: _CameraModel) -> str:
    if abs(camera_model.cx) <= 1 and abs(camera_model.cy) <= 1:
        return ": probably in parts of the image"
    if _is_near(camera_model.cy, camera_model.width / 2) and _is_near(
        camera_model.cx, camera_model.height / 2
    ):
        return ": probably x and y are exchanged"
    for times in _HALVES:
        if _is_near(camera_model.cx, times * camera_model.width / 2) and _is_near(
            camera_model.cy, times * camera_model.height / 2
        ):
            return f": probably for images {times:g} times as wide and high"
    return ""


def _is_near(value: float, wanted: float) -> bool:
    return abs(value - wanted) <= _NEAR * wanted


RULES: tuple[Rule, ...] = (
    Rule(
        "calibration-focal-length",
        Severity.WARNING,
        f"Focal lengths of a calibration are {SHORTEST:g} to {LONGEST:g} image widths, and differ by less than "
        f"{MOST_UNEQUAL - 1:.0%}.",
        "Write pixels of the images that imageWidth and imageHeight report.",
        find=_focal_lengths,
    ),
    Rule(
        "calibration-principal-point",
        Severity.WARNING,
        f"Principal points of a calibration lie within {OFF_CENTRE:.0%} of the image's size around its centre.",
        "See whether the camera model was calibrated for another size, or the image cut without moving the point.",
        find=_principal_points,
    ),
    Rule(
        "calibration-size",
        Severity.WARNING,
        "Images have the `imageWidth` and `imageHeight` that their camera model is calibrated for.",
        "Write the numbers for the images as they are; `--fix` scales them, which is wrong for cut images.",
        find=warnings_of_code("camera-model-scaled"),
        fix=as_read,
    ),
)
