"""Cameras of a file: the sensor, and its camera model."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError
from sceneloom.formats.sfs.camera_model_readings import in_opencvs_sense
from sceneloom.formats.sfs.container import format_keys
from sceneloom.formats.sfs.distortion import COEFFICIENT_COUNTS
from sceneloom.formats.sfs.image_notes import ImageNotes, camera_model_of, camera_of, exposure_ns, numbers_of
from sceneloom.formats.sfs.poses import times_of
from sceneloom.formats.sfs.read_clouds import Record, read_moving, rest_of
from sceneloom.formats.sfs.read_images import ImageContent, image_content, no_content, video_content
from sceneloom.formats.sfs.records import Faults, FieldError, Location
from sceneloom.formats.sfs.source import Source
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.warnings import WarningKind


def read_camera(source: Source, values: Record, location: Location, faults: Faults) -> CameraSensor | None:
    """Make a camera of its record."""
    note = source.note(values["id"])
    intrinsics = values.pop("intrinsics")
    inner = Faults()
    try:
        camera_model = read_camera_model(source, intrinsics, note, (*location, "intrinsics"))
    except (FieldError, CalibrationError) as error:
        faults.add(("intrinsics",), str(error))
        return None
    content = _content(source, values, camera_model, location)
    moving = read_moving(source, values, location, inner, frame_count=len(content.starts_ns))
    try:
        own = ImageNotes.of(note.get("images") or {}, camera_model, len(content.starts_ns))
    except (FieldError, CalibrationError) as error:
        inner.add(("images",), f"our note: {error}")
    faults.extend(inner)
    if inner.unmended:
        return None
    extras = {**rest_of(values), **further_of_intrinsics(intrinsics), **content.further}
    images = _images(source, content, own, exposure_ns(extras, 0), location)
    return CameraSensor(
        values["id"],
        camera_model,
        images,
        video=content.video,
        fps=_fps(content, note),
        **moving,
        extras=extras,
    )


def _images(
    source: Source, content: ImageContent, own: ImageNotes, usual: int, location: Location
) -> LazyFrames[CameraImage]:
    """Join images, their own camera models and mountings, and the times of their middles."""
    own_fields = content.own_fields or tuple(own.extras(k) for k in range(len(content.starts_ns)))
    exposures = np.array([exposure_ns(extra, usual) for extra in own_fields], np.int64)
    middles_ns = content.starts_ns + exposures // 2

    def read(index: int) -> CameraImage:
        image = content.read(index, own.camera(index))
        extras = {**image.extras, **own.extras(index)}
        return replace(image, timestamp_ns=int(middles_ns[index]), mount=own.mount(index), extras=extras)

    return LazyFrames(middles_ns, source.parts.keep(format_keys((*location, "images")), read))


def _fps(content: ImageContent, note: Mapping[str, Any]) -> float | None:
    """The rate that the video says, or our note of a camera with single images."""
    noted = note.get("fps")
    return float(noted) if content.fps is None and isinstance(noted, int | float) else content.fps


def _content(source: Source, values: Record, camera_model: Camera, location: Location) -> ImageContent:
    """Choose between `video` and `images`; what is not chosen stays among the further fields."""
    video, images = values.get("video"), values.get("images")
    if video is not None:
        values.pop("video")
        if images is None:
            values.pop("images", None)
        else:
            message = "both video and images; the video is taken, the images are carried along"
            source.warning(WarningKind.ASSUMED, "video-and-images", location, message)
        timestamps_ns = times_of(video["timestamps"])
        return video_content(source, video, timestamps_ns, (*location, "video"))
    values.pop("video", None)
    values.pop("images", None)
    if images is not None:
        return image_content(source, images, (*location, "images"))
    source.warning(
        WarningKind.SKIPPED,
        "no-images",
        location,
        f"neither video nor images; {camera_model.model} camera model only",
    )
    return no_content()


def read_camera_model(
    source: Source, intrinsics: Record, note: Mapping[str, Any], location: Location
) -> Camera:
    """Make a camera model of an `intrinsics` record.

    Or of our note where the record stands in for the camera model noted there.

    A record that was changed since it was written counts, not the note. Files of before the fit have no camera model as
    written in the note: there the focal lengths and the centre report.

    Raises:
        FieldError: the distortion is not what its model has.
        CalibrationError: the numbers are those of no camera model.
    """
    distortion = intrinsics.get("distortion") or {}
    model = distortion.get("model") or "pinhole"
    written = camera_model_of(
        intrinsics, model, _coefficients(source, model, distortion.get("params"), location)
    )
    if note.get("camera") is None:
        return in_opencvs_sense(written, source)
    exact = camera_of(note["camera"])
    if note.get("written_camera") is not None:
        same = camera_of(note["written_camera"]) == written
    else:
        same = (exact.fx, exact.fy, exact.cx, exact.cy) == (written.fx, written.fy, written.cx, written.cy)
    return exact if same else in_opencvs_sense(written, source)


def _coefficients(source: Source, model: str, params: Any, location: Location) -> tuple[float, ...]:
    coefficients = numbers_of([] if params is None else params)
    if model == "pinhole":
        if any(coefficients):
            raise FieldError(f"distortion.params: {list(coefficients)} without a model")
        return ()
    expected = COEFFICIENT_COUNTS.get(model)
    if expected is None:
        message = (
            f"distortion model {model!r} is none of the format's; it is kept, but cannot be computed with"
        )
        source.warning(WarningKind.SKIPPED, "unknown-distortion", (*location, "distortion"), message)
    elif len(coefficients) > expected:
        raise FieldError(f"distortion.params: {len(coefficients)} numbers; {model} has {expected}")
    elif len(coefficients) < expected:
        message = f"{len(coefficients)} of the {expected} numbers of {model}; the others are taken as 0"
        source.warning(WarningKind.REPAIRED, "short-distortion", (*location, "distortion"), message)
    return coefficients


def further_of_intrinsics(intrinsics: Record) -> Record:
    """Unknown fields of `intrinsics` and `distortion`, which the model has no object for."""
    known = {"fx", "fy", "cx", "cy", "width", "height", "distortion"}
    unknown = {name: value for name, value in intrinsics.items() if name not in known}
    distortion = intrinsics.get("distortion") or {}
    of_distortion = {name: value for name, value in distortion.items() if name not in {"model", "params"}}
    if of_distortion:
        unknown["distortion"] = of_distortion
    return {"intrinsics": unknown} if unknown else {}
