"""Poses and fixes of lines under keys that have no shape of their own: found in the decoded line."""

from typing import Any, TypeVar

import msgspec

from sceneloom.formats.recording.json_faults import json_problem
from sceneloom.formats.recording.line_shapes import ROOT_KEYS, ExactGnssFix, ExactPose, GnssFix, Pose
from sceneloom.formats.recording.line_taking import Origin, UnfitLineError

Shape = TypeVar("Shape", Pose, GnssFix)

OUTPUT_TRAJECTORY = "output"
"""Name of the trajectory of lines with a position at their root, as the vendor's software puts out."""

_FIXED_KEYS = frozenset({"rtkgps", "groundTruth", "pose"})
"""Root keys that hold poses or fixes, beside `gps`."""


def is_pressure(value: object) -> bool:
    """Whether what stands under `barometer` reports the pressure of the air."""
    return isinstance(value, dict) and "pressureHectopascals" in value


def other_poses(content: dict[str, Any]) -> list[tuple[Origin, Pose, bool]]:
    """Find the poses of a line under any root key without a shape of its own, or at the root itself.

    Returns:
        Of each its origin, and whether the line holds nothing else.

    Raises:
        UnfitLineError: a position or an orientation is incomplete.
    """
    poses = [
        _pose(value, (key, key), says_all=set(content) == {"time", key})
        for key, value in content.items()
        if key not in ROOT_KEYS and isinstance(value, dict) and isinstance(value.get("position"), dict)
    ]
    if isinstance(content.get("position"), dict):
        fields = {key: value for key, value in content.items() if key != "time"}
        poses.append(_pose(fields, ("", OUTPUT_TRAJECTORY), says_all="time" in content))
    mean = content["gnssEnu"].get("mean") if isinstance(content.get("gnssEnu"), dict) else None
    if isinstance(mean, list):
        says_all = set(content) == {"time", "gnssEnu"} and len(content["gnssEnu"]) == 1
        poses.append(_east_north_up(mean, says_all=says_all))
    return poses


def _pose(value: dict[str, Any], origin: Origin, *, says_all: bool) -> tuple[Origin, Pose, bool]:
    return origin, *_shaped(value, ExactPose, Pose, location=origin[0], says_all=says_all)


def _east_north_up(mean: list[Any], *, says_all: bool) -> tuple[Origin, Pose, bool]:
    """`gnssEnu`: where a receiver was, metres to the east, north and up of a point that the log does not report."""
    if len(mean) != 3:
        raise UnfitLineError(f"gnssEnu.mean: {mean}; expected 3 numbers (east, north, up)")
    position = dict(zip("xyz", mean, strict=True))
    origin, pose, _ = _pose({"position": position}, ("gnssEnu", "gnssEnu"), says_all=True)
    return origin, pose, says_all


def other_fixes(content: dict[str, Any]) -> list[tuple[Origin, GnssFix, bool]]:
    """Find the fixes of satellite receivers under root keys other than `gps`.

    Raises:
        UnfitLineError: a fix is incomplete, under a key of the format; others may mean something else.
    """
    return [
        _fix(key, value, says_all=set(content) == {"time", key})
        for key, value in content.items()
        if isinstance(value, dict) and "position" not in value and _may_be_fix(key, value)
    ]


def _may_be_fix(key: str, value: dict[str, Any]) -> bool:
    if key in _FIXED_KEYS:
        return {"latitude", "longitude"} <= value.keys()
    numbers = [value.get(name) for name in ("latitude", "longitude", "altitude")]
    return key not in ROOT_KEYS and all(isinstance(number, int | float) for number in numbers)


def _fix(key: str, value: dict[str, Any], *, says_all: bool) -> tuple[Origin, GnssFix, bool]:
    name = value.get("name") if key == "pose" else None
    origin = (key, name if isinstance(name, str) and name else key)
    return origin, *_shaped(value, ExactGnssFix, GnssFix, location=key, says_all=says_all)


def _shaped(
    value: dict[str, Any], exact: type[Shape], wider: type[Shape], *, location: str, says_all: bool
) -> tuple[Shape, bool]:
    """The record in the exact shape, else in the one that allows for more, which then says less than the line."""
    try:
        return msgspec.convert(value, exact), says_all
    except msgspec.ValidationError:
        pass
    try:
        return msgspec.convert(value, wider), False
    except msgspec.ValidationError as error:
        raise UnfitLineError(json_problem(error, msgspec.json.encode(value), prefix=location)) from error
