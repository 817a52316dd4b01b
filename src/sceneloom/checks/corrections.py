"""Rules about corrections of the localisation and of cameras: one of each, and where there is something to correct."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace

from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.scene.annotations.corrections import CameraCalibration, LocalizationAdjustment, effect_of
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.findings import Severity
from sceneloom.scene.span import scene_period_ns, time_span
from sceneloom.scene.types import Identifier, key_of


def _adjustments(subject: Subject) -> list[tuple[str, LocalizationAdjustment]]:
    return [(path, a) for path, a in subject.annotations() if isinstance(a, LocalizationAdjustment)]


def _calibrations(subject: Subject) -> Iterator[tuple[str, CameraCalibration]]:
    for path, annotation in subject.annotations():
        if isinstance(annotation, CameraCalibration):
            yield path, annotation


def _not_applied(subject: Subject) -> Iterator[Hit]:
    pending = {key_of(correction.id): correction for correction in subject.scene.pending_corrections}
    for path, annotation in subject.annotations():
        correction = pending.get(key_of(annotation.id))
        if correction is not None:
            yield Hit(path, f"{correction.type}: {effect_of(correction)}")


def _several_adjustments(subject: Subject) -> Iterator[Hit]:
    found = _adjustments(subject)
    for path, adjustment in found[1:]:
        yield Hit(path, f"{adjustment.id!r} is one of {len(found)}, the first is {found[0][0]}; expected one")


def _adjustment_short(subject: Subject) -> Iterator[Hit]:
    # inertial sensors and satellite receivers begin and end as they like; what is corrected are frames
    framed = tuple(
        s for s in subject.scene.sensors if isinstance(s, LidarSensor | RadarSensor | CameraSensor)
    )
    span = time_span(replace(subject.scene, sensors=framed))
    if span is None:
        return
    period_ns = scene_period_ns(subject.scene)
    for path, adjustment in _adjustments(subject):
        poses = adjustment.poses
        if len(poses.timestamps_ns) < 2:
            continue
        missing_ns = max(poses.start_ns - span[0], span[1] - poses.stop_ns)
        if missing_ns > period_ns:
            reported = (
                f"{poses.start_ns} to {poses.stop_ns} ns; the frames' times are {span[0]} to {span[1]} ns"
            )
            yield Hit(f"{path}.poses", reported)


def _several_calibrations(subject: Subject) -> Iterator[Hit]:
    by_camera: dict[tuple[type, Identifier], list[str]] = defaultdict(list)
    for path, calibration in _calibrations(subject):
        by_camera[type(calibration.sensor_id), calibration.sensor_id].append(path)
    for (_, sensor_id), paths in by_camera.items():
        for path in paths[1:]:
            yield Hit(path, f"camera {sensor_id!r} has {len(paths)}, the first is {paths[0]}; expected one")


def _calibrates_nothing(subject: Subject) -> Iterator[Hit]:
    for path, calibration in _calibrations(subject):
        if calibration.poses is None and calibration.intrinsics is None and not calibration.time_offset_ns:
            yield Hit(path, "neither poses nor intrinsics nor a time offset; expected one of them")


def _other_image_size(subject: Subject) -> Iterator[Hit]:
    for path, calibration in _calibrations(subject):
        sensor, camera_model = subject.sensor(calibration.sensor_id), calibration.intrinsics
        if camera_model is None or not isinstance(sensor, CameraSensor):
            continue
        given, usual = (camera_model.width, camera_model.height), (sensor.camera.width, sensor.camera.height)
        if given != usual:
            reported = f"{given[0]} x {given[1]} px; the camera's images are {usual[0]} x {usual[1]} px"
            yield Hit(f"{path}.intrinsics", reported)


RULES: tuple[Rule, ...] = (
    Rule(
        "corrections-not-applied",
        Severity.HINT,
        "Corrections of cameras and of the localization are applied.",
        "Nothing has to be done: what computes applies them. Other programs may not: `sceneloom edit apply` does it "
        "for good.",
        find=_not_applied,
    ),
    Rule(
        "localization-adjustments-several",
        Severity.WARNING,
        "A scene has one localization adjustment at most.",
        "Keep one: in which order several are applied is not stated.",
        find=_several_adjustments,
    ),
    Rule(
        "localization-adjustment-short",
        Severity.WARNING,
        "A localization adjustment covers the time of the scene, give or take one sweep.",
        "Extend its poses to the scene's ends.",
        find=_adjustment_short,
    ),
    Rule(
        "camera-calibrations-several",
        Severity.WARNING,
        "A camera has one calibration annotation at most.",
        "Keep one: in which order several are applied is not stated.",
        find=_several_calibrations,
    ),
    Rule(
        "camera-calibration-empty",
        Severity.WARNING,
        "A camera calibration says something about poses, camera model or time.",
        "Take it out.",
        find=_calibrates_nothing,
    ),
    Rule(
        "camera-calibration-size",
        Severity.WARNING,
        "The camera model of a camera calibration is for images of the camera's size.",
        "Scale its numbers to the size of the images.",
        find=_other_image_size,
    ),
)
