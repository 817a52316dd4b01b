"""Scenes whose lenses are told by another model, as near as it comes; the pictures stay as they are."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.fitting import Fit, fit
from sceneloom.cameras.table import MODELS
from sceneloom.editing.chosen_cameras import chosen_cameras, lens_record
from sceneloom.editing.record import assumed, ours_of, skipped, with_notices, with_ours
from sceneloom.errors import CalibrationError, OptionError
from sceneloom.scene.cameras import CameraSensor, Picture
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.notices import Notice
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier

LIMIT_PX = 1.0
"""How far a point may move at most, where the caller says nothing [px]."""


def convert_lenses(
    scene: Scene,
    model: str,
    *,
    cameras: Iterable[Identifier] | None = None,
    limit_px: float = LIMIT_PX,
    share: float = 0.99,
) -> Scene:
    """Give the scene with lenses of another model, each fitted to the one that stood there.

    Corrections are applied first.

    How far the two put what the pictures show apart, at most, stands in a notice for each camera, and with the
    lens that it was in the metadata, as `sceneloom.lenses`.

    Args:
        scene: as it is.
        model: a name out of `cameras.MODELS`.
        cameras: ids of the only cameras to change; None for all.
        limit_px: how many pixels that may be.
        share: which part of what a picture shows the new lens must hold at least.

    Raises:
        OptionError: the model is unknown, a camera is not there, or a limit is none.
        CalibrationError: the model comes no nearer than the limits say.
    """
    if model not in MODELS:
        raise OptionError(f"camera model {model!r}; expected one of {', '.join(MODELS)}")
    if not limit_px >= 0 or not 0 <= share <= 1:
        raise OptionError(f"limit {limit_px} px, share {share}; expected 0 px or more and a share of 0 to 1")
    scene = scene.corrected()
    sensors: list[Any] = list(scene.sensors)
    entries, notices = list(ours_of(scene).get("lenses") or ()), list[Notice]()
    for index, sensor in chosen_cameras(scene, cameras, unless=model):
        lenses = _Lenses(model, f"sensors[{sensor.id}].camera", limit_px, share)
        found = lenses.fit(sensor.camera)
        sensors[index] = _with_lens(sensor, found.camera, lenses)
        notices.append(assumed("lens-fitted", lenses.place, found.message(sensor.camera)))
        entries.append(
            {
                "sensor": sensor.id,
                "largest_px": found.largest_px,
                "rms_px": found.rms_px,
                "share": found.share,
                "camera": lens_record(sensor.camera),
            }
        )
    if not notices:
        message = f"every lens is told as {model} already; none was changed"
        notices.append(skipped("nothing-to-convert", "sensors", message))
    changed = replace(scene, sensors=tuple(sensors))
    return with_notices(with_ours(changed, lenses=entries or None), notices)


def _with_lens(sensor: CameraSensor, camera: Camera, lenses: "_Lenses") -> CameraSensor:
    pictures = LazyFrames(
        sensor.pictures.timestamps_ns, _Relensed(sensor.pictures, lenses, {sensor.camera: camera})
    )
    return replace(sensor, camera=camera, pictures=pictures)


@dataclass(frozen=True, slots=True)
class _Lenses:
    """Fits lenses, and refuses what is too far off."""

    model: str
    place: str
    limit_px: float
    share: float

    def fit(self, camera: Camera) -> Fit:
        found = fit(camera, self.model)
        if not found.largest_px <= self.limit_px or found.share < self.share:
            raise CalibrationError(
                f"{self.place}: {found.message(camera)}; expected at most {self.limit_px:g} px and "
                f"{100 * (1 - self.share):g} %: choose another model or other limits"
            )
        return found


@dataclass(frozen=True, slots=True, eq=False)
class _Relensed:
    """Reads pictures with lenses of the new model; a lens that a picture has of its own is fitted then."""

    pictures: LazyFrames[Picture]
    lenses: _Lenses
    known: dict[Camera, Camera] = field(default_factory=dict)

    def __call__(self, k: int) -> Picture:
        picture = self.pictures[k]
        exact = picture.camera
        if exact not in self.known:
            self.known[exact] = exact if exact.model == self.lenses.model else self.lenses.fit(exact).camera
        return replace(picture, camera=self.known[exact])
