"""Lenses as the format can say them, and how many pixels are lost where it cannot."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError
from sceneloom.formats.sfs.distortion import COEFFICIENT_COUNTS
from sceneloom.formats.sfs.drafts import with_further

_GRID = 33


def written_lens(camera: Camera, *, any_model: bool) -> Camera:
    """Give the lens that an `intrinsics` record can hold: the same, or one without what the format cannot say.

    Args:
        camera: the exact lens.
        any_model: whether a model that the format does not list may stand there by its own name.
    """
    count = COEFFICIENT_COUNTS.get(camera.model)
    if count is not None:
        padded = (*camera.coefficients, *(0.0,) * count)[:count]
        return _with(camera, camera.model, padded)
    if any_model and camera.model != "pinhole":
        return camera
    return _with(camera, "pinhole", ())


def same_lens(a: Camera, b: Camera) -> bool:
    """Whether two lenses of one size and focal length are equal but for coefficients that are zero."""
    length = max(len(a.coefficients), len(b.coefficients))
    padded = [(*lens.coefficients, *(0.0,) * (length - len(lens.coefficients))) for lens in (a, b)]
    plain = {"pinhole", "brown_conrady"}
    models_agree = a.model == b.model or ({a.model, b.model} <= plain and not any(padded[0] + padded[1]))
    return models_agree and padded[0] == padded[1]


def intrinsics_record(camera: Camera) -> dict[str, Any]:
    """Make the `intrinsics` record of a lens that the format can hold."""
    record: dict[str, Any] = {
        name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")
    }
    if camera.model != "pinhole":
        record["distortion"] = {"model": camera.model, "params": list(camera.coefficients)}
    return record


def merged_intrinsics(record: dict[str, Any], further: Any) -> dict[str, Any]:
    """Add unknown fields of an `intrinsics` record and of its `distortion`; known ones win."""
    if not isinstance(further, Mapping):
        return record
    of_distortion = further.get("distortion")
    if isinstance(of_distortion, Mapping):
        record["distortion"] = with_further(record.get("distortion") or {}, of_distortion)
    return with_further(record, further)


def difference_px(exact: Camera, written: Camera) -> float | None:
    """How far apart two lenses put what the picture shows, at most, over a grid of pixels [px].

    Returns:
        None where one of the models cannot be computed with.
    """
    from sceneloom.cameras import project_unbounded, unproject

    columns = np.linspace(-0.5, exact.width - 0.5, _GRID)
    rows = np.linspace(-0.5, exact.height - 0.5, _GRID)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    try:
        rays = unproject(exact, pixels)
        seen = project_unbounded(written, rays)
    except CalibrationError:
        return None
    distances = np.hypot(*(seen - pixels).T)
    return None if np.isnan(distances).all() else float(np.nanmax(distances))


def _with(camera: Camera, model: str, coefficients: tuple[float, ...]) -> Camera:
    return Camera(
        model, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, coefficients
    )
