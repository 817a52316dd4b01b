"""Images as another camera model would have taken them from the same location, such as one without distortion."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, UInt8Array, check_array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project_unbounded, unproject
from sceneloom.errors import CalibrationError, OptionError

WIDEST = math.radians(75.0)
"""How far off its axis an image without distortion is made to look at most: there it magnifies 15 times already."""

_BORDER_STEPS = 65
_BISECTIONS = 40
_ROWS_AT_ONCE = 128


@dataclass(frozen=True, eq=False)
class Undistortion:
    """Where each pixel of a new camera model is found in the images of an old one; computed once, used for each image.

    Attributes:
        source: the camera model that took the images.
        target: the camera model of the new images.
        locations: (h, w, 2) float32 [px], column and row in the old image of each new pixel; NaN where the old camera
            model has none or the new one looks nowhere.
    """

    source: Camera
    target: Camera
    locations: Float32Array

    @classmethod
    def between(cls, source: Camera, target: Camera | None = None) -> Self:
        """Compute the locations; the new camera model is `undistorted_camera(source)` unless it is given.

        Raises:
            CalibrationError: a model is unknown, or the old camera model does not see the middle of its image.
        """
        new = undistorted_camera(source) if target is None else target
        locations = np.empty((new.height, new.width, 2), np.float32)
        for start in range(0, new.height, _ROWS_AT_ONCE):
            rows = np.arange(start, min(start + _ROWS_AT_ONCE, new.height), dtype=np.float64)
            pixels = np.stack(np.meshgrid(np.arange(new.width, dtype=np.float64), rows), axis=-1)
            found = project_unbounded(source, unproject(new, pixels.reshape(-1, 2)))
            locations[start : start + len(rows)] = found.reshape(pixels.shape)
        return cls(source, new, read_only(locations))

    @cached_property
    def seen(self) -> BoolArray:
        """(h, w) bool: which new pixels lie in the old image."""
        size = np.array([self.source.width, self.source.height], np.float32)
        inside: BoolArray = np.all((self.locations >= -0.5) & (self.locations < size - 0.5), axis=-1)
        return read_only(inside)

    def apply(self, rgb: UInt8Array, *, fill: int = 0) -> UInt8Array:
        """Resample one image, blending the four pixels around each location.

        Args:
            rgb: (H, W, C) uint8, an image of the old camera model.
            fill: the value of pixels that are not `seen`.

        Returns:
            (h, w, C) uint8.

        Raises:
            ArrayError: the image is not of the old camera model's size, or not of that dtype.
        """
        from sceneloom.kernels.images import resample_bilinear

        check_array("rgb", rgb, (self.source.height, self.source.width, None), np.uint8)
        out = np.full((*self.locations.shape[:2], rgb.shape[2]), fill, np.uint8)
        filled = np.empty(self.locations.shape[:2], np.bool_)
        resample_bilinear(np.ascontiguousarray(rgb), self.locations, out, filled)
        return out


def undistort(
    camera: Camera, rgb: UInt8Array, *, to: Camera | None = None, keep: float = 0.0, fill: int = 0
) -> tuple[UInt8Array, BoolArray]:
    """Resample one image from a camera model to another; for many images, keep an `Undistortion`.

    Args:
        camera: the camera model that took the image.
        rgb: (H, W, C) uint8.
        to: the new camera model; None for `undistorted_camera(camera, keep=keep)`.
        keep: see there.
        fill: the value of new pixels that the old image does not show.

    Returns:
        image: (h, w, C) uint8.
        seen: (h, w) bool, which of its pixels the old image shows.

    Raises:
        ArrayError: the image is not of the camera model's size, or not of that dtype.
        CalibrationError: a model is unknown, or the camera model does not see the middle of its image.
        OptionError: `keep` is not between 0 and 1.
    """
    maps = Undistortion.between(camera, undistorted_camera(camera, keep=keep) if to is None else to)
    return maps.apply(rgb, fill=fill), maps.seen


def undistorted_camera(
    camera: Camera, *, keep: float = 0.0, width: int | None = None, height: int | None = None
) -> Camera:
    """Choose the pinhole whose image shows what a camera model shows.

    Its axis and the ratio of its focal lengths are those of the camera model, and it looks no further than `WIDEST` off
    the axis.

    Args:
        camera: the camera model.
        keep: 0 for an image all of whose pixels the old one shows; 1 for one that shows all that the old one
            does; between, focal lengths and centre go evenly from one to the other.
        width: of the new image [px]; None for the old one's.
        height: likewise.

    Raises:
        CalibrationError: the model is unknown, or the camera model does not see the middle of its image.
        OptionError: `keep` is not between 0 and 1.
    """
    if not 0.0 <= keep <= 1.0:
        raise OptionError(f"keep {keep}; expected a number from 0 (valid pixels only) to 1 (all that is seen)")
    size = np.array([width or camera.width, height or camera.height], np.float64)
    valid, whole = _rectangles(_border_on_plane(camera))
    ratio = np.array([1.0, camera.fy / camera.fx])
    fits = [np.maximum(size - 1.0, 1.0) / (area[1] - area[0]) / ratio for area in (valid, whole)]
    focal = np.array([fits[0].max(), fits[1].min()])[:, None] * ratio
    centers = [
        0.5 * (size - 1.0) - length * area.mean(axis=0) for length, area in zip(focal, (valid, whole), strict=True)
    ]
    fx, fy = (1.0 - keep) * focal[0] + keep * focal[1]
    cx, cy = (1.0 - keep) * centers[0] + keep * centers[1]
    return Camera("pinhole", int(size[0]), int(size[1]), float(fx), float(fy), float(cx), float(cy))


def _border_on_plane(camera: Camera) -> tuple[Float64Array, ...]:
    """Where the image's left, upper, right and lower border are on the plane z = 1, each (M, 2)."""
    # a border pixel that looks nowhere or too far off the axis gives way to the last one inwards that does not
    middle = 0.5 * np.array([camera.width - 1.0, camera.height - 1.0])
    if not _sees(camera, middle[None])[0]:
        raise CalibrationError(
            f"{camera.model} camera model: the middle of its image looks nowhere, or more than "
            f"{math.degrees(WIDEST):.0f} degrees off the axis; expected a camera model that a pinhole can stand for"
        )
    along = np.linspace(-1.0, 1.0, _BORDER_STEPS)
    ones = np.ones(_BORDER_STEPS)
    sides = ((-ones, along), (along, -ones), (ones, along), (along, ones))
    return tuple(_last_seen(camera, middle, np.stack(side, axis=1) * middle) for side in sides)


def _last_seen(camera: Camera, middle: Float64Array, outwards: Float64Array) -> Float64Array:
    near, far = np.zeros(len(outwards)), np.ones(len(outwards))
    near[_sees(camera, middle + outwards)] = 1.0
    for _ in range(_BISECTIONS):
        half = 0.5 * (near + far)
        sees = _sees(camera, middle + half[:, None] * outwards)
        near, far = np.where(sees, half, near), np.where(sees, far, half)
    rays = unproject(camera, middle + near[:, None] * outwards)
    return rays[:, :2] / rays[:, 2:]


def _sees(camera: Camera, pixels: Float64Array) -> BoolArray:
    """Whether pixels look along a ray within `WIDEST` of the axis; those that look nowhere do not."""
    with np.errstate(invalid="ignore"):
        sees: BoolArray = unproject(camera, pixels)[:, 2] >= math.cos(WIDEST)
    return sees


def _rectangles(border: tuple[Float64Array, ...]) -> tuple[Float64Array, Float64Array]:
    """The rectangle inside all borders, and that around them: each (2, 2), least and greatest x and y."""
    # Source: the inner and outer rectangle of OpenCV's getOptimalNewCameraMatrix
    left, upper, right, lower = border
    points = np.concatenate(border)
    inner = np.array([[left[:, 0].max(), upper[:, 1].max()], [right[:, 0].min(), lower[:, 1].min()]])
    return inner, np.array([points.min(axis=0), points.max(axis=0)])
