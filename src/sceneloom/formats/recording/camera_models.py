"""Camera parameters of a recording as camera models: names of the models, and what their coefficients mean here."""

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import NamedTuple

from msgspec import Struct, structs

from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError

Coefficients = tuple[float, ...]


class CameraParameters(Struct, frozen=True):
    """The camera model of an entry in `calibration.json` or of a `cameraParameters`; None for what is not stated.

    Source: "Calibration format" of the recording format's description; `distortionModel` is the word of its lines.
    """

    model: str | None = None
    distortionModel: str | None = None  # noqa: N815 - the format's own word
    distortionCoefficients: list[float] | None = None  # noqa: N815 - the format's own word
    focalLengthX: float | None = None  # noqa: N815 - the format's own word
    focalLengthY: float | None = None  # noqa: N815 - the format's own word
    focalLength: float | None = None  # noqa: N815 - the word of old recordings, for both
    principalPointX: float | None = None  # noqa: N815 - the format's own word
    principalPointY: float | None = None  # noqa: N815 - the format's own word
    imageWidth: int | float | None = None  # noqa: N815 - the format's own word
    imageHeight: int | float | None = None  # noqa: N815 - the format's own word

    @property
    def has_size(self) -> bool:
        """Whether the image size is stated."""
        return self.imageWidth is not None and self.imageHeight is not None

    @property
    def camera_model_model(self) -> str | None:
        """The model under either of its keys."""
        return self.distortionModel if self.model is None else self.model

    def with_both_focal_lengths(self) -> "CameraParameters":
        """The same camera model, one focal length for both axes reported as two."""
        if self.focalLength is None or (self.focalLengthX, self.focalLengthY) != (None, None):
            return self
        both = self.focalLength
        return structs.replace(self, focalLength=None, focalLengthX=both, focalLengthY=both)

    def over(self, base: "CameraParameters") -> "CameraParameters":
        """These parameters, and those of `base` where they state nothing.

        The coefficients of the base hold for a camera model of its own model only, and its image size for focal lengths
        and a principal point of its own only: whole parameters without a size are those of the images as they are.
        """
        own = (self.focalLengthX, self.focalLengthY, self.principalPointX, self.principalPointY)
        if all(value is not None for value in own):
            base = structs.replace(base, imageWidth=None, imageHeight=None)
        stated = {name: value for name, value in structs.asdict(self).items() if value is not None}
        if self.camera_model_model is not None:
            same = base.camera_model_model is not None and _plain(base.camera_model_model) == _plain(
                self.camera_model_model
            )
            kept = base.distortionCoefficients if same else None
            base = structs.replace(base, model=None, distortionModel=None, distortionCoefficients=kept)
        return structs.replace(base, **stated)


def _no_distortion(_: Coefficients) -> Coefficients:
    return ()


def _as_given(coefficients: Coefficients) -> Coefficients:
    return coefficients


def _radial(coefficients: Coefficients) -> Coefficients:
    """k1 k2 k3 become k1 k2 p1 p2 k3."""
    return (*coefficients[:2], 0.0, 0.0, *coefficients[2:])


def _with_prism_and_tilt(coefficients: Coefficients) -> Coefficients:
    """After the eight of the rational model come lx ly of ours, which the format does not have."""
    return (*coefficients[:8], 0.0, 0.0, *coefficients[8:])


class _Reading(NamedTuple):
    model: str
    coefficients: Callable[[Coefficients], Coefficients]


CAMERA_MODEL_READINGS: Mapping[str, Mapping[int, _Reading]] = {
    "pinhole": {0: _Reading("pinhole", _no_distortion), 3: _Reading("brown_conrady", _radial)},
    "brown-conrady": {
        5: _Reading("brown_conrady", _as_given),
        8: _Reading("brown_conrady", _as_given),
        14: _Reading("brown_conrady", _with_prism_and_tilt),
    },
    "kannala-brandt4": {0: _Reading("fisheye", _as_given), 4: _Reading("fisheye", _as_given)},
    "kannala-brandt18": {
        0: _Reading("kannala_brandt18", _as_given),
        4: _Reading("kannala_brandt18", _as_given),
        18: _Reading("kannala_brandt18", _as_given),
    },
    "omnidir": {6: _Reading("omnidir", _as_given)},
}
"""By the format's name of a model and its number of coefficients: our model, and our order of them. The orders of
`kannala_brandt18` (k0-k3 l1-l3 i1-i4 m1-m3 j1-j4) and `omnidir` (k1 k2 s xi p1 p2) are the format's own.

Source: the models that the vendor's software knows, as docs/CONVENTIONS.md lists them.
"""


@lru_cache(maxsize=64)
def _plain(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())


_SPELLINGS = {_plain(name): name for name in CAMERA_MODEL_READINGS}


def camera_model(parameters: CameraParameters, image_size: tuple[int, int] | None, location: str) -> Camera:
    """Build the camera model, for the calibrated image size.

    Args:
        image_size: width and height of the images [px], which stand in where the calibration names none.
        location: file and path of the parameters, for messages.

    Raises:
        CalibrationError: a number is missing or impossible, or the model is unknown.
    """
    reading, coefficients = _reading(parameters, location)
    width, height = _calibrated_size(parameters, location) or image_size or (0, 0)
    if width == 0:
        raise CalibrationError(
            f"{location}: no imageWidth and imageHeight, and no image that would report them"
        )
    fx, fy = _required(parameters, "focalLengthX", location), _required(parameters, "focalLengthY", location)
    cx, cy = (
        _required(parameters, "principalPointX", location),
        _required(parameters, "principalPointY", location),
    )
    try:
        return Camera(reading.model, width, height, fx, fy, cx, cy, reading.coefficients(coefficients))
    except CalibrationError as error:
        raise CalibrationError(f"{location}: {error}") from error


def _reading(parameters: CameraParameters, location: str) -> tuple[_Reading, Coefficients]:
    name = parameters.camera_model_model
    if name is None:
        raise CalibrationError(
            f"{location}.model: missing; expected one of: {', '.join(CAMERA_MODEL_READINGS)}"
        )
    known = _SPELLINGS.get(_plain(name))
    if known is None:
        raise CalibrationError(
            f"{location}.model: {name!r}; expected one of: {', '.join(CAMERA_MODEL_READINGS)}"
        )
    readings = CAMERA_MODEL_READINGS[known]
    coefficients = tuple(map(float, parameters.distortionCoefficients or ()))
    if len(coefficients) not in readings:
        counts = " or ".join(map(str, readings))
        raise CalibrationError(
            f"{location}.distortionCoefficients: {len(coefficients)} numbers; expected {counts} for {name!r}"
        )
    return readings[len(coefficients)], coefficients


def _calibrated_size(parameters: CameraParameters, location: str) -> tuple[int, int] | None:
    if parameters.imageWidth is None or parameters.imageHeight is None:
        return None
    size = (parameters.imageWidth, parameters.imageHeight)
    if any(number != int(number) or number <= 0 for number in size):
        raise CalibrationError(
            f"{location}: imageWidth, imageHeight {size}; expected positive whole numbers of pixels"
        )
    return int(size[0]), int(size[1])


def _required(parameters: CameraParameters, name: str, location: str) -> float:
    value = getattr(parameters, name)
    if value is None:
        raise CalibrationError(f"{location}.{name}: missing; expected a number of pixels")
    return float(value)
