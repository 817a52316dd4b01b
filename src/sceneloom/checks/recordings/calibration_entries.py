"""Rules about the entries of a `calibration.json`: words that other programs spell otherwise, and times."""

from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from typing import Any

from sceneloom.checks.reading import as_read
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.formats.recording.camera_models import CAMERA_MODEL_READINGS
from sceneloom.scene.findings import Severity

CAMERA_KEYS = frozenset(
    {
        "model",
        "distortionModel",
        "distortionCoefficients",
        "focalLengthX",
        "focalLengthY",
        "principalPointX",
        "principalPointY",
        "imageWidth",
        "imageHeight",
        "imuToCamera",
        "imuToCameraMatrix",
        "imuToCameraShiftSeconds",
        "shutterRollTimeSeconds",
        "rollingShutterLeftToRight",
        "exposureTimeSeconds",
        "depthScale",
        "depthToCamera",
        "cameraInd",
    }
)
LIDAR_KEYS = frozenset({"model", "lidarInd", "imuToLidar", "imuToLidarMatrix"})
ROOT_KEYS = frozenset(
    {"cameras", "lidars", "imuToOutput", "imuToGnss", "imuForward", "imuToMagnetometer", "imuToOdometer"}
)
"""Keys that the format has, or the vendor's software writes."""

LONGEST_ROLL, LONGEST_EXPOSURE, LONGEST_SHIFT = 0.1, 1.0, 0.5
"""Longer ones [s] belong to no camera that moves."""
_PADDED = {"brown-conrady": (5, 8)}
"""Lists of the first length are read, and other programs want the second."""


def _entries(subject: Subject, name: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    content = {} if subject.recording is None else subject.recording.calibration.content
    listed = content.get(name)
    for index, entry in enumerate(listed if isinstance(listed, list) else ()):
        if isinstance(entry, dict):
            yield f"calibration.json: {name}[{index}]", entry


def _spelling(subject: Subject) -> Iterator[Hit]:
    for location, entry in _entries(subject, "cameras"):
        yield from _spelling_of_model(location, entry)
        yield from _spelling_of_matrix(location, entry, "imuToCamera")
    for location, entry in _entries(subject, "lidars"):
        yield from _spelling_of_matrix(location, entry, "imuToLidar")


def _spelling_of_model(location: str, entry: Mapping[str, Any]) -> Iterator[Hit]:
    key = "model" if "model" in entry else "distortionModel"
    name = entry.get(key)
    if not isinstance(name, str):
        return
    usual = {_plain(known): known for known in CAMERA_MODEL_READINGS}.get(_plain(name))
    if usual is None:
        return
    if name != usual:
        yield Hit(f"{location}.{key}", f"{name!r}; expected {usual!r}")
    if key != "model":
        yield Hit(f"{location}.{key}", "expected the key `model`")
    coefficients = entry.get("distortionCoefficients")
    given, wanted = _PADDED.get(usual, (-1, -1))
    if isinstance(coefficients, list) and len(coefficients) == given:
        yield Hit(f"{location}.distortionCoefficients", f"{given} numbers; expected {wanted}, padded with 0")


def _spelling_of_matrix(location: str, entry: Mapping[str, Any], key: str) -> Iterator[Hit]:
    other = f"{key}Matrix"
    if other in entry and key not in entry:
        yield Hit(f"{location}.{other}", f"expected the key `{key}`")
    matrix = entry.get(key, entry.get(other))
    if isinstance(matrix, list) and len(matrix) == 16:
        yield Hit(f"{location}.{key}", "16 numbers, read column by column; expected 4 rows of 4")


def _plain(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())


def _unknown_keys(subject: Subject) -> Iterator[Hit]:
    if subject.recording is None:
        return
    content = subject.recording.calibration.content
    yield from _strange("calibration.json: ", content, ROOT_KEYS)
    for location, entry in _entries(subject, "cameras"):
        yield from _strange(f"{location}.", entry, CAMERA_KEYS)
    for location, entry in _entries(subject, "lidars"):
        yield from _strange(f"{location}.", entry, LIDAR_KEYS)


def _strange(location: str, entry: Mapping[str, Any], known: frozenset[str]) -> Iterator[Hit]:
    for key in entry:
        if key not in known:
            plain = {_plain(name): name for name in known}
            near = get_close_matches(_plain(key), plain, n=1)
            meant = f"; is {plain[near[0]]!r} meant?" if near else ""
            yield Hit(f"{location}{key}", f"nothing here reads it{meant}")


def _shutter_times(subject: Subject) -> Iterator[Hit]:
    limits = {"shutterRollTimeSeconds": LONGEST_ROLL, "exposureTimeSeconds": LONGEST_EXPOSURE}
    for location, entry in _entries(subject, "cameras"):
        for key, longest in limits.items():
            seconds = entry.get(key)
            if isinstance(seconds, int | float) and not 0 <= seconds <= longest:
                hint = ": probably milliseconds" if seconds > longest else ""
                yield Hit(f"{location}.{key}", f"{seconds:g} s; expected 0 to {longest:g}{hint}")


def _shifts(subject: Subject) -> Iterator[Hit]:
    for location, entry in _entries(subject, "cameras"):
        seconds = entry.get("imuToCameraShiftSeconds")
        if isinstance(seconds, int | float) and not abs(seconds) <= LONGEST_SHIFT:
            reported = f"{seconds:g} s; expected at most {LONGEST_SHIFT:g} either way: probably milliseconds"
            yield Hit(f"{location}.imuToCameraShiftSeconds", reported)


RULES: tuple[Rule, ...] = (
    Rule(
        "calibration-spelling",
        Severity.WARNING,
        "Keys, models and lists of a calibration are spelt as the vendor's software reads them.",
        "Use `imuToCamera` of 4 rows, `model` in small letters with a dash, and 8 numbers for `brown-conrady`.",
        find=_spelling,
        fix=as_read,
    ),
    Rule(
        "calibration-keys-known",
        Severity.HINT,
        "Every key of a calibration is one of the format.",
        "See whether it is misspelt; it is kept as it is.",
        find=_unknown_keys,
    ),
    Rule(
        "calibration-shutter",
        Severity.WARNING,
        f"A shutter rolls for {LONGEST_ROLL:g} s at most, and is open for {LONGEST_EXPOSURE:g} s at most.",
        "Write seconds.",
        find=_shutter_times,
    ),
    Rule(
        "calibration-shift",
        Severity.WARNING,
        f"`imuToCameraShiftSeconds` is {LONGEST_SHIFT:g} s at most.",
        "Write seconds.",
        find=_shifts,
    ),
)
