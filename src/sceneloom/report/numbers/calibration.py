"""Whether cameras lie to the lidar as the drive says, as far as some images can report that quickly."""

from collections.abc import Sequence

import msgspec

from sceneloom.calibrate.health.check import check_calibration
from sceneloom.calibrate.health.verdicts import Item, Verdict
from sceneloom.errors import SceneloomError
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier

FRAMES = 6
"""Images of each camera that are looked at; `sceneloom calibrate --check` takes more."""
MOST_CAMERAS = 6
"""Cameras that are checked: each takes seconds."""


class CalibrationCheck(msgspec.Struct, frozen=True, kw_only=True):
    """What a quick check of one camera against the first lidar gave.

    Attributes:
        camera, lidar: whose calibration.
        verdict: "good", "drifting", "wrong" or "cannot determine".
        reason: why, where that is known in one line.
        items: by part: rotation, translation, …
        frames: images that were looked at.
        distinctness, stated_distinctness: how far the best calibration, and the stated one, stand above chance, in
            chance's own deviations.
    """

    camera: Identifier
    lidar: Identifier
    verdict: str
    reason: str = ""
    items: tuple[Item, ...] = ()
    frames: int = 0
    distinctness: float = 0.0
    stated_distinctness: float = 0.0


def check_cameras(scene: Scene, *, frames: int = FRAMES) -> tuple[CalibrationCheck, ...]:
    """Check the first cameras of a scene against its first lidar; nothing where it has no lidar."""
    lidars = [lidar for lidar in scene.lidars if len(lidar.frames)]
    cameras = [camera for camera in scene.cameras if len(camera.images)]
    if not lidars or not cameras:
        return ()
    return tuple(_check(scene, camera.id, lidars[0].id, frames) for camera in cameras[:MOST_CAMERAS])


def _check(scene: Scene, camera_id: Identifier, lidar_id: Identifier, frames: int) -> CalibrationCheck:
    known = CalibrationCheck(camera=camera_id, lidar=lidar_id, verdict=Verdict.UNDETERMINED.value)
    try:
        health = check_calibration(scene, camera_id, lidar_id, most=frames)
    except SceneloomError as error:
        return msgspec.structs.replace(known, reason=str(error))
    return msgspec.structs.replace(
        known,
        verdict=health.verdict.value,
        reason=_reason(health.items, health.verdict),
        items=health.items,
        frames=health.frames,
        distinctness=health.distinctness,
        stated_distinctness=health.stated_distinctness,
    )


def _reason(items: Sequence[Item], verdict: Verdict) -> str:
    return next((item.reason for item in items if item.verdict is verdict and item.reason), "")
