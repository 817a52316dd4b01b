"""A scene as rows of all tables."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.catalog.attributes import attribute_rows
from sceneloom.catalog.boxes import annotation_rows, box_rows, distances, track_rows
from sceneloom.catalog.ego import Ego
from sceneloom.catalog.values import Repeated, Rows, text_of
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.findings import Finding
from sceneloom.scene.motion import GnssSensor, OdometrySensor
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.span import frame_times, usual_period_ns
from sceneloom.scene.summary import SensorSummary, summarise

_FRAMED = (LidarSensor, CameraSensor, RadarSensor, DepthCameraSensor, GnssSensor, OdometrySensor)
"""What gives frames; the first of the first kind that has any gives a scene's moments."""


def scene_rows(
    scene: Scene,
    *,
    path: str,
    options: Mapping[str, Any],
    fingerprint: str,
    size_bytes: int | None,
    findings: Sequence[Finding],
) -> dict[str, Rows]:
    """Give the rows of all tables.

    Args:
        scene: the scene; of its frames only the first of each lidar is read.
        path: where the drive is.
        options: how it is read.
        fingerprint: what reports it from what it was at another time.
        size_bytes: bytes on disk, where known.
        findings: what the rules found in it.

    Raises:
        DataError: the first frame of a lidar cannot be read.
        OptionError: unit or order of the cuboids' angles is none of those known.
    """
    summary = summarise(scene)
    start_ns = summary.start_ns or 0
    ego, reference = Ego.of(scene), reference_sensor(scene)
    moments_ns = _annotated_ns(scene) if reference is None else np.unique(frame_times(reference))
    boxes = box_rows(scene, moments_ns)
    tables = {
        "sensors": _sensors(summary.sensors),
        "frames": _frames(scene, ego, reference, start_ns),
        "annotations": annotation_rows(scene, ego, boxes, start_ns),
        "tracks": track_rows(scene, boxes, distances(scene, ego, boxes), start_ns),
        "attributes": attribute_rows(scene),
        "findings": _findings(findings),
    }
    first_lla = (
        ego.positions_lla(np.array([start_ns]))[0] if summary.start_ns is not None else (np.nan, np.nan)
    )
    whole = {
        "path": path,
        "options": json.dumps(dict(options), sort_keys=True),
        "format": scene.format,
        "start_ns": summary.start_ns,
        "duration": summary.duration,
        "period": usual_period_ns(moments_ns) / 1e9,
        "moments_of": None if reference is None else text_of(reference.id),
        "metres": ego.metres,
        "latitude": first_lla[0],
        "longitude": first_lla[1],
        "sensors": len(scene.sensors),
        "frames": len(tables["frames"]["seconds"]),  # type: ignore[arg-type]
        "tracks": len(scene.annotations),
        "boxes": len(boxes.tracks),
        "findings": sum(finding.count for finding in findings),
        "size_bytes": size_bytes,
        "fingerprint": fingerprint,
    }
    return {"scenes": {name: [value] for name, value in whole.items()}, **tables}


def reference_sensor(scene: Scene) -> Sensor | None:
    """The sensor whose frames are the scene's moments: a lidar, else a camera, else what else has times."""
    for kind in _FRAMED:
        for sensor in scene.sensors:
            if isinstance(sensor, kind) and len(frame_times(sensor)):
                return sensor
    return None


def _annotated_ns(scene: Scene) -> Int64Array:
    """The times at which boxes are stated to be: the moments of a scene without frames."""
    boxes = [one for one in scene.annotations if isinstance(one, CuboidAnnotation | Box2DAnnotation)]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *(box.path.timestamps_ns for box in boxes)]))


def _sensors(sensors: Sequence[SensorSummary]) -> Rows:
    same = ("type", "count", "rate_hz", "start", "stop", "camera_model", "video", "mounted")
    return {
        "sensor": [str(sensor.id) for sensor in sensors],
        "gaps": [sensor.gap_count for sensor in sensors],
        **{name: [getattr(sensor, name) for sensor in sensors] for name in same},
    }


def _frames(scene: Scene, ego: Ego, reference: Sensor | None, start_ns: int) -> Rows:
    sensors = [sensor for sensor in scene.sensors if isinstance(sensor, _FRAMED)]
    timestamps = [frame_times(sensor) for sensor in sensors]
    counts = [len(times) for times in timestamps]
    times_ns: Int64Array = np.concatenate([np.zeros(0, np.int64), *timestamps])
    codes = np.repeat(np.arange(len(sensors)), counts)
    positions, locations = ego.positions(times_ns), ego.positions_lla(times_ns)
    return {
        "sensor": Repeated(codes, tuple(str(sensor.id) for sensor in sensors)),
        "type": Repeated(codes, tuple(str(sensor.type) for sensor in sensors)),
        "reference": np.repeat(np.array([sensor is reference for sensor in sensors], np.bool_), counts),
        "frame": np.concatenate([np.zeros(0, np.int64), *map(np.arange, counts)]),
        "timestamp_ns": times_ns,
        "seconds": (times_ns - start_ns) / 1e9,
        **{name: positions[:, k] for k, name in enumerate("xyz")},
        "latitude": locations[:, 0],
        "longitude": locations[:, 1],
        "ego_speed": ego.speeds(times_ns),
    }


def _findings(findings: Sequence[Finding]) -> Rows:
    same = ("rule", "severity", "message", "remedy", "count", "fixable")
    rows: Rows = {name: [getattr(finding, name) for finding in findings] for name in same}
    return {**rows, "location": [finding.path for finding in findings]}
