"""A rule about the images of a stereo pair: what is near lies where the mountings of both cameras state.

Every point in front of both cameras shifts between the images along its epipolar line, in the one direction that
the mountings report. Where videos or entries are exchanged, or matrices inverted, most of what can be matched shifts
the other way.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import project, unproject
from sceneloom.checks.recordings.camera_pairs import CameraPair, stereo_pairs
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.findings import Severity

_WIDTH = 192
"""Images are compared at this width [px], or at their own where that is less."""
_LOOKED_AT = 4
_WIDEST_SHIFT, _CLEAR_SHIFT = 16, 1.5
"""Shifts are looked for up to the first, and reported from none at the second [px]."""
_PATCH = 12
_TEXTURE = 6.0
"""A patch needs so much contrast (standard deviation, of 255) to be matched."""
_CLEARLY = 0.7
"""And has to fit so much better on one side than on the other."""
_MATCHED = 0.5
"""What is left of the difference where a patch is matched, as part of its contrast."""
_FEWEST_PATCHES = 20
_MOST_WRONG = 0.5


@dataclass(slots=True)
class _Views:
    """Some small grey images of each camera by their times [ns], kept until the second camera of a pair comes."""

    images: dict[int, dict[int, Float64Array]] = field(default_factory=dict)
    camera_models: dict[int, Camera] = field(default_factory=dict)


def _views(subject: Subject) -> _Views:
    return subject.table("images of stereo pairs", lambda _: _Views())


def _look(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Keep some images of cameras that are one of a pair; what they show is stated at the end."""
    yield from ()
    camera, image = frame.sensor, frame.frame
    if not isinstance(camera, CameraSensor) or not isinstance(image, CameraImage):
        return
    index = _index(camera)
    if not any(index in {pair.first, pair.second} for pair in stereo_pairs(subject)):
        return
    wanted = np.linspace(0, len(camera.images) - 1, _LOOKED_AT).astype(int)
    if frame.number in wanted:
        camera_model = _small(camera.camera)
        _views(subject).camera_models[index] = camera_model
        small = _grey(image.rgb, camera_model)
        _views(subject).images.setdefault(index, {})[image.timestamp_ns] = small


def _index(camera: CameraSensor) -> int:
    name = str(camera.id).removeprefix("camera")
    return int(name) if name.isdigit() else -1


def _small(camera_model: Camera) -> Camera:
    width = min(_WIDTH, camera_model.width)
    return camera_model.resized(width, max(1, round(camera_model.height * width / camera_model.width)))


def _grey(rgb: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], camera_model: Camera) -> Float64Array:
    """Mean brightness over the pixels of a smaller image, (height, width) float64."""
    rows = np.linspace(0, rgb.shape[0], camera_model.height + 1).astype(int)
    columns = np.linspace(0, rgb.shape[1], camera_model.width + 1).astype(int)
    sums = np.add.reduceat(np.add.reduceat(rgb.mean(axis=2), rows[:-1], axis=0), columns[:-1], axis=1)
    grey: Float64Array = sums / np.outer(np.diff(rows), np.diff(columns))
    return grey


def _wrong_side(subject: Subject) -> Iterator[Hit]:
    views = _views(subject)
    for pair in stereo_pairs(subject):
        if not pair.baseline.any():
            continue
        first, second = views.images.get(pair.first, {}), views.images.get(pair.second, {})
        right = wrong = 0
        for time in first.keys() & second.keys():
            camera_models = views.camera_models[pair.first], views.camera_models[pair.second]
            there, back = _sides(pair, camera_models, first[time], second[time])
            right, wrong = right + there, wrong + back
        if right + wrong >= _FEWEST_PATCHES and wrong > _MOST_WRONG * (right + wrong):
            reported = (
                f"{wrong} of {right + wrong} patches that show near things shift between the images of cameras "
                f"{pair.first} and {pair.second} against the side on which their mountings put them: probably "
                "videos or entries are exchanged, or the matrices inverted"
            )
            yield Hit(f"calibration.json: cameras[{pair.second}].imuToCamera", reported)


def _sides(
    pair: CameraPair, camera_models: tuple[Camera, Camera], first: Float64Array, second: Float64Array
) -> tuple[int, int]:
    """How many patches of the first image shift as the mountings state, and how many the other way."""
    shifts = np.arange(-_WIDEST_SHIFT, _WIDEST_SHIFT + 1)
    costs = np.stack([_cost(pair, camera_models, first, second, float(shift)) for shift in shifts])
    contrast = np.sqrt(np.maximum(_patches(first * first) - _patches(first) ** 2, 0.0))
    matched = np.isfinite(costs).all(axis=0) & (costs.min(axis=0) < _MATCHED * contrast)
    costs = costs[:, matched & (contrast > _TEXTURE)]
    if costs.shape[1] == 0:
        return 0, 0
    best, least = shifts[costs.argmin(axis=0)], costs.min(axis=0)
    ahead, behind = costs[shifts > 0].min(axis=0), costs[shifts < 0].min(axis=0)
    right = (best >= _CLEAR_SHIFT) & (least < _CLEARLY * behind)
    wrong = (best <= -_CLEAR_SHIFT) & (least < _CLEARLY * ahead)
    return int(right.sum()), int(wrong.sum())


def _cost(
    pair: CameraPair,
    camera_models: tuple[Camera, Camera],
    first: Float64Array,
    second: Float64Array,
    shift: float,
) -> Float64Array:
    """Mean difference over each patch if all of it shifts by so many pixels; NaN where the second has no pixel."""
    height, width = first.shape
    v, u = np.mgrid[0:height, 0:width]
    rays = unproject(camera_models[0], np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    rays = rays / rays[:, 2:]
    second_from_first = pair.first_from_second.inverse()
    away = (
        second_from_first.translation * shift / (camera_models[0].fx * float(np.linalg.norm(pair.baseline)))
    )
    pixels, visible = project(camera_models[1], second_from_first.rotate(rays) + away)
    columns = np.clip(np.rint(np.nan_to_num(pixels[:, 0])), 0, second.shape[1] - 1).astype(int)
    rows = np.clip(np.rint(np.nan_to_num(pixels[:, 1])), 0, second.shape[0] - 1).astype(int)
    differences = np.where(visible, np.abs(second[rows, columns] - first.ravel()), np.nan)
    return _patches(differences.reshape(height, width))


def _patches(values: Float64Array) -> Float64Array:
    """Means over squares of pixels."""
    height, width = (length // _PATCH for length in values.shape)
    cut = values[: height * _PATCH, : width * _PATCH]
    means: Float64Array = cut.reshape(height, _PATCH, width, _PATCH).mean(axis=(1, 3))
    return means


RULES: tuple[Rule, ...] = (
    Rule(
        "stereo-images",
        Severity.WARNING,
        "Near things shift between the images of a stereo pair to the side that the mountings report.",
        "See whether videos or entries of the cameras are exchanged, or their matrices inverted.",
        look=_look,
        conclude=_wrong_side,
    ),
)
