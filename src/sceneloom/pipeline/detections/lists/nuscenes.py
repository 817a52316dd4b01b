"""nuScenes' JSON of detections: boxes in the global frame by sample."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import DataError
from sceneloom.formats.files import read_bytes
from sceneloom.formats.ledger import Ledger
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.pipeline.detections.detected import poses_at
from sceneloom.pipeline.detections.lists.context import ListContext, ListForm, sorted_by_time
from sceneloom.scene.detections import Boxes3D, ScoreForm
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.types import Identifier, PointsFrame
from sceneloom.scene.warnings import WarningKind

_WORD = '"results"'
_NAMES = ("sample.json",)
"""Where the times of samples are reported, beside the file or above it."""


def _recognises(head: str) -> bool:
    return head.startswith("{") and _WORD in head


def _read_3d(path: Path, context: ListContext, ledger: Ledger) -> Sequence[Boxes3D]:
    """Read boxes in space, and bring them into the sensor's frame.

    Source: "Detection: results format" of the nuScenes devkit: translation [m] x, y, z; size [m] width, length, height;
    rotation w, x, y, z; velocity [m/s] x, y; all in the global frame.
    """
    if context.source is None:
        raise DataError(path, "", "its boxes are in the world, and it is not known where the lidar was")
    results = _results(path)
    timestamps = _sample_times(path, results, context)
    lists = []
    for token, boxes in results.items():
        time_ns = timestamps.get(token)
        if time_ns is None:
            message = "samples that are not of this drive"
            ledger.note(WarningKind.SKIPPED, "other-samples", f"{path}: results.{token}", message)
            continue
        rows = []
        for k, box in enumerate(boxes):
            location = f"results.{token}[{k}]"
            try:
                rows.append(_row(path, location, box))
            except DataError as error:
                ledger.fault("faulty-detections", error)
        lists.append(_boxes(rows, time_ns, context.source, context.sensor_id))
    return [lists[k] for k in sorted_by_time(lists)]


def _results(path: Path) -> Mapping[str, Sequence[Any]]:
    try:
        content = msgspec.json.decode(read_bytes(path))
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise DataError(path, "", f"no JSON: {error}") from error
    results = content.get("results") if isinstance(content, Mapping) else None
    if not isinstance(results, Mapping):
        raise DataError(path, "results", "expected an object: by token of a sample its boxes")
    for token, boxes in results.items():
        if not isinstance(boxes, list):
            raise DataError(path, f"results.{token}", f"{str(boxes)[:40]}; expected a list of boxes")
    return results


def _sample_times(path: Path, results: Mapping[str, Any], context: ListContext) -> dict[str, int]:
    """The time of each sample [ns]: of the table `sample.json`, or of tokens that are times themselves."""
    if all(token.isascii() and token.isdigit() for token in results):
        micros = {token: int(token) * 1000 for token in results}
        return {token: t for token, t in micros.items() if _in_drive(t, context)}
    folders = (path.parent, path.parent.parent)
    table = next((folder / name for folder in folders for name in _NAMES if (folder / name).is_file()), None)
    if table is None:
        problem = "the times of its samples are not known; put nuScenes' table sample.json (token, timestamp) beside it"
        raise DataError(path, "", problem)
    try:
        rows = msgspec.json.decode(read_bytes(table))
        times = {row["token"]: int(row["timestamp"]) * 1000 for row in rows}
    except (msgspec.DecodeError, RecursionError, TypeError, KeyError, ValueError) as error:
        raise DataError(
            table, "", f"{error}; expected a list of objects with token and timestamp [µs]"
        ) from error
    return {token: t for token, t in times.items() if token in results and _in_drive(t, context)}


def _in_drive(time_ns: int, context: ListContext) -> bool:
    times = context.timestamps_ns
    return bool(len(times)) and int(times[0]) - 10**9 <= time_ns <= int(times[-1]) + 10**9


_NUMBERS = {"translation": 3, "size": 3, "rotation": 4}


def _row(path: Path, location: str, box: Any) -> tuple[Float64Array, str]:
    """Middle, length, width, height, yaw, velocity and score of a box, (11,), and its class."""
    if not isinstance(box, Mapping):
        raise DataError(path, location, f"{str(box)[:40]}; expected an object")
    numbers = {name: _vector(path, location, box, name, count) for name, count in _NUMBERS.items()}
    if (numbers["size"] <= 0).any():
        raise DataError(path, f"{location}.size", f"{numbers['size'].tolist()}; expected sizes above 0")
    w, x, y, z = numbers["rotation"]
    if not 0.99 < float(np.linalg.norm(numbers["rotation"])) < 1.01:
        raise DataError(path, f"{location}.rotation", f"{[w, x, y, z]}; expected w, x, y, z of length 1")
    heading = matrix_from_quaternion([x, y, z, w])[:, 0]
    velocity = np.nan_to_num(_velocity(path, location, box))
    label, score = box.get("detection_name"), box.get("detection_score")
    if not isinstance(label, str) or not label:
        raise DataError(path, f"{location}.detection_name", f"{label!r}; expected the name of a class")
    if isinstance(score, bool) or not isinstance(score, int | float) or not np.isfinite(score):
        raise DataError(path, f"{location}.detection_score", f"{score!r}; expected a finite number")
    yaw = np.arctan2(heading[1], heading[0])
    width, length, height = numbers["size"]
    return np.array([*numbers["translation"], length, width, height, yaw, *velocity, 0.0, score]), label


def _vector(path: Path, location: str, box: Mapping[str, Any], name: str, count: int) -> Float64Array:
    value = box.get(name)
    sound = isinstance(value, list) and len(value) == count
    if not sound or not all(isinstance(one, int | float) and abs(one) < 1e9 for one in value or ()):
        raise DataError(path, f"{location}.{name}", f"{str(value)[:60]}; expected {count} finite numbers")
    return np.array(value, np.float64)


def _velocity(path: Path, location: str, box: Mapping[str, Any]) -> Float64Array:
    """Of a box [m/s], x and y; a JSON may state NaN or null where it is not known, which stands for 0."""
    value = box.get("velocity") or [0.0, 0.0]
    if not isinstance(value, list) or len(value) < 2:
        raise DataError(path, f"{location}.velocity", f"{str(value)[:60]}; expected two numbers")
    known = [0.0 if one is None else one for one in value[:2]]
    if not all(isinstance(one, int | float) for one in known):
        raise DataError(path, f"{location}.velocity", f"{str(value)[:60]}; expected two numbers")
    return np.array(known, np.float64)


def _boxes(
    rows: Sequence[tuple[Float64Array, str]], time_ns: int, source: PoseSource, sensor_id: Identifier
) -> Boxes3D:
    """Boxes of the world at one time, in the sensor's frame; velocities stay over ground."""
    values = np.array([row for row, _ in rows], np.float64).reshape(len(rows), 11)
    boxes = Boxes3D(
        time_ns,
        values[:, :3].copy(),
        values[:, 3:6].copy(),
        values[:, 6].copy(),
        values[:, 10].copy(),
        tuple(label for _, label in rows),
        velocities=values[:, 7:10].copy(),
        frame=PointsFrame.WORLD,
        score_form=_score_form(values[:, 10]),
        sensor_id=sensor_id,
    )
    (world_from_sensor,) = poses_at(source, np.array([time_ns], np.int64))
    return boxes.moved(world_from_sensor.inverse(), PointsFrame.SENSOR)


def _score_form(scores: Float64Array) -> ScoreForm:
    within = len(scores) == 0 or (scores.min() >= 0.0 and scores.max() <= 1.0)
    return ScoreForm.PROBABILITY if within else ScoreForm.LOGIT


FORM = ListForm(
    "nuscenes", 'a JSON object with "results" by sample, as nuScenes has detections', _recognises, _read_3d
)
