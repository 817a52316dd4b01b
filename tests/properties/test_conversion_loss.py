"""Nothing vanishes or changes without a line: every format that writes, against a drive that holds every field."""

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from tests.properties.injected import injected_scene

from sceneloom.errors import MissingExtraError, OptionError
from sceneloom.formats.base.losses import LossReport, Support, unknown_names
from sceneloom.formats.base.registry import FORMATS, find_format, format_named
from sceneloom.geometry.rigid import matrix_from_quaternion
from sceneloom.pipeline.converting import field_supports, fields_meant, kinds_by_id
from sceneloom.scene import LazyFrames, Scene, VideoContent
from sceneloom.scene.contents import MODEL_FIELDS, Counting, frame_values, stationary_values
from sceneloom.scene.scene import frames_of

WRITTEN = [name for name in FORMATS if format_named(name).writes]
REFERENCES = ("sensor_id", "order", "parent_id", "from_id", "to_id")
"""Fields that name other things: they change with the names of these."""

ROUNDING = 1e-3
"""How far numbers that are only converted may be off: as a share of them, or as a number if they are below 1."""

FREE_NUMBERS = ("time_offset_ns", "sensors.radar.frames.points.lengths", "sensors.radar.frames.points.directions")
"""Fields that mean the same with other numbers: where a clock starts, and a speed the other way round."""

FREE = ("metadata", "extras")
"""Fields of the scene that formats add something to."""


@cache
def scene(odd: bool, corrections: bool = True) -> Scene:
    """The drive; `corrections`: with its corrections as annotations, else with them applied."""
    drive = injected_scene(odd=odd)
    return drive if corrections else drive.corrected()


def framed(sensor) -> bool:
    return isinstance(getattr(sensor, "frames", getattr(sensor, "images", None)), LazyFrames)


def values_of(drive: Scene) -> dict[str, list]:
    """All values of each field, in the order of the sensors, annotations and frames."""
    found: dict[str, list] = {}
    for name, value in stationary_values(drive):
        found.setdefault(name, []).append(plain(value))
    # cameras that only poses location have no mounting: those of others stay beside theirs
    if "sensors.camera.mount" in found:
        found["sensors.camera.mount"] = [plain(camera.mount) for camera in drive.cameras]
    for sensor in filter(framed, drive.sensors):
        for frame in frames_of(sensor):
            for name, value in frame_values(sensor, frame):
                found.setdefault(name, []).append(plain(value))
    return found


def plain(value):
    """A value that can be compared: what functions give, and what objects hold."""
    if isinstance(value, VideoContent):
        with value.open() as file:
            return value.codec, file.read()
    if isinstance(value, Callable):
        return plain(value())
    if isinstance(value, np.ndarray | np.generic):
        return np.asarray(value)
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    return value


def same_values(field: str, before: list, after: list) -> bool:
    """Whether all values are there again; more may be: what the format says by itself."""
    if field == "sensors.camera.mount":
        pairs = zip(before, after, strict=False)
        return len(before) <= len(after) and all(one is None or same(one, other) for one, other in pairs)
    if field in FREE or field.endswith(".extras"):
        # without what the project itself says of a scene, which writing adds to
        before = [{key: inner for key, inner in value.items() if key != "sceneloom"} for value in before]
        after = [{key: inner.get(key) for key in value} for value, inner in zip(before, after, strict=False)]
    return same(before, after[: len(before)])


def same(one, other) -> bool:
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        one, other = np.asarray(one), np.asarray(other)  # numbers of a list and of an array are the same numbers
        if one.dtype.kind not in "fiub" or other.dtype.kind not in "fiub" or one.shape != other.shape:
            return one.shape == other.shape and bool((one == other).all())
        return np.array_equal(one, other, equal_nan=one.dtype.kind == "f" and other.dtype.kind == "f")
    if isinstance(one, dict) and isinstance(other, dict):
        if "coefficients" in one and "coefficients" in other:  # a model adds zeros at the end
            one, other = ({**each, "coefficients": np.trim_zeros(each["coefficients"], "b")} for each in (one, other))
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other


def written(name: str, odd: bool, folder: Path) -> tuple[Path, LossReport, Counting, Scene]:
    """Write the drive: to a folder where a file cannot hold it, with corrections where they have a location."""
    form, suffix = format_named(name), next(iter(format_named(name).suffixes), "")
    # what is written in other formats is corrected before, as `write_in` does
    corrections = form.holds_corrections
    for location in (folder / f"drive{suffix}", folder / "drive"):
        drive = scene(odd, corrections)
        counting = Counting(drive)
        try:
            return location, form.write(counting.scene, location), counting, drive
        except MissingExtraError as error:
            pytest.skip(str(error))
        except OptionError as error:
            refused = error
    raise refused


def unexplained(name: str, odd: bool, folder: Path) -> list[str]:
    form = format_named(name)
    location, losses, counting, source = written(name, odd, folder)
    for sensor in filter(framed, counting.scene.sensors):
        list(frames_of(sensor))  # also of sensors that the format has no field for
    supports = field_supports(counting.counts(), form.supports, losses, kinds_by_id(source))
    reported = {support.field: support.support for support in supports}
    if not form.reads:
        return []
    assert find_format(location).name == name
    before = values_of(source)
    with form.open(location) as drive:
        after = values_of(drive)
    renamed = any(field.endswith(".id") and support != Support.KEPT for field, support in reported.items())
    checked = {field: values for field, values in before.items() if not (renamed and field.endswith(REFERENCES))}
    # points and poses of the odd drive are brought into other frames, where their numbers are others
    rounded = Support.KEPT if odd else Support.CONVERTED
    judged = {field: values for field, values in checked.items() if reported[field] in (Support.KEPT, rounded)}
    faults = [difference(field, values, after.get(field), reported[field]) for field, values in judged.items()]
    return [fault for fault in faults if fault]


def difference(field: str, before: list, after: list | None, support: Support) -> str:
    if support == Support.KEPT and after is None:
        return f"{field} vanished"
    if support == Support.KEPT and not same_values(field, before, after):
        return f"{field} changed from {str(before)[:300]} to {str(after)[:300]}"
    if support == Support.CONVERTED and after is not None and field not in FREE_NUMBERS:
        off = farthest(before, after)
        if off > ROUNDING:
            return f"{field} is off by {off} of {ROUNDING} and only stated to be converted"
    return ""


def farthest(one, other) -> float:
    """How far numbers are from those in the same locations, as a share of what rounding may do; 0 for others."""
    if isinstance(one, dict) and isinstance(other, dict):
        quaternions = one.get("quaternions_xyzw"), other.get("quaternions_xyzw")
        if all(rotations is not None for rotations in quaternions):
            # a quaternion and its negative are one rotation
            matrices = map(matrix_from_quaternion, quaternions)
            one, other = ({**each, "quaternions_xyzw": next(matrices)} for each in (one, other))
        return max((farthest(one[key], other[key]) for key in one.keys() & other.keys()), default=0.0)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple) and len(one) <= len(other):
        return max(map(farthest, one, other), default=0.0)
    if not isinstance(one, int | float | np.ndarray) or not isinstance(other, int | float | np.ndarray):
        return 0.0
    one, other = np.asarray(one), np.asarray(other)
    if one.dtype.kind not in "iuf" or other.dtype.kind not in "iuf" or one.shape != other.shape:
        return 0.0
    one, other = one.astype(np.float64), other.astype(np.float64)
    return float(np.nan_to_num(np.abs(one - other) / np.maximum(np.abs(one), 1.0)).max(initial=0.0))


@pytest.mark.parametrize("odd", [False, True], ids=["usual", "odd"])
@pytest.mark.parametrize("name", WRITTEN)
@pytest.mark.few(20)
def test_what_vanishes_or_changes_is_reported(name, odd, tmp_path):
    assert unexplained(name, odd, tmp_path) == []


@pytest.mark.parametrize("name", WRITTEN)
def test_a_format_says_something_of_every_field_and_every_loss_is_of_something_held(name, tmp_path):
    supports = format_named(name).supports
    assert "" in supports
    assert unknown_names(supports) == []
    assert all(bool(holding.how) == (holding.support != Support.KEPT) for holding in supports.values())
    _, losses, _, source = written(name, False, tmp_path)
    kinds = kinds_by_id(source)
    reported = [loss.field for loss in losses if loss.support != Support.KEPT]  # the rest are notes
    assert [field for field in reported if not fields_meant(field, kinds)] == []


def test_the_drive_holds_every_field_of_the_model():
    held = {field for odd in (False, True) for field in values_of(scene(odd))}
    assert held == set(MODEL_FIELDS)
