"""Damage to values and bytes, and headers of scene files to be damaged."""

import copy
import functools
import operator

import numpy as np

STRANGE = [None, True, -1, 7, 2**63, 1e300, 0.5, float("nan"), "", "x", [], [None], [[]], {}, {"a": 1}]
"""What takes the position of any value of a text."""


def locations(node, path=()):
    """The keys of every value inside a value, outermost first."""
    if path:
        yield path
    for key, value in node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ():
        yield from locations(value, (*path, key))


def replaced(node, path, *value):
    """A copy with another value at a location, or without it."""
    changed = copy.deepcopy(node)
    owner = functools.reduce(operator.getitem, path[:-1], changed)
    if value:
        owner[path[-1]] = value[0]
    else:
        del owner[path[-1]]
    return changed


def flipped(content, location, mask):
    changed = bytearray(content)
    changed[location] ^= mask
    return bytes(changed)


def scattered(content, rng, count, *, start=0):
    """The bytes with some of them changed, anywhere from `start` on."""
    changed = np.frombuffer(content, np.uint8).copy()
    where = rng.integers(start, len(content), count)
    changed[where] ^= rng.integers(1, 256, count).astype(np.uint8)
    return changed.tobytes()


def look_at_everything(scene):
    """Touch every frame, image and labelled point of a scene."""
    for sensor in scene.sensors:
        for frame in getattr(sensor, "frames", ()):
            cloud = hasattr(frame, "points")
            assert (frame.points.positions if cloud else frame.depth).ndim == 2
            for part in ("intensities", "timestamps_ns", "colors") if cloud else ():
                getattr(frame.points, part, None)
        for image in getattr(sensor, "images", ()):
            assert image.rgb.ndim == 3
    for annotation in scene.annotations:
        list(getattr(annotation, "labeled_points", ()))


TWO = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
POSES = {"timestamps": [0, 100], "values": [[1, 2, 3, 0, 0, 0, 1], [1, 2, 3, 0, 0, 0.6, 0.8]]}
PINHOLE = {"fx": 9.5, "fy": 9, "cx": 3.5, "cy": 3.5, "width": 8, "height": 8}
FISHEYE = PINHOLE | {"distortion": {"model": "fisheye", "params": [1, 2, 3, 4]}}
CLOUD = {
    "positions": TWO,
    "colors": np.ones((2, 3), np.uint8),
    "intensities": np.ones(2, np.uint8),
    "timestamps": np.array([5, 9], np.uint32),
    "ring": np.array([1, 2], np.uint16),
}
RADAR = {"positions": TWO, "directions": TWO, "lengths": np.ones(2, np.float32)}
SENSORS = {
    "lidar": {"coordinates": "world", "parent_id": "p", "poses": POSES, "frames": [{"timestamp": 5, "points": CLOUD}]},
    "radar": {"coordinates": "ego", "poses": POSES, "frames": [{"timestamp": 5, "points": RADAR}]},
    "points": {"points": {"positions": TWO}},
    "camera": {
        "poses": POSES,
        "intrinsics": FISHEYE,
        "images": [{"timestamp": 3, "content": np.array([255, 216, 255], np.uint8)}],
    },
    "odometry": {"poses": POSES},
    "sonar": {"values": np.ones(2)},
}
"""The fields of a sensor of each type, and of an unknown one."""

AT_0 = {"timestamps": [0]}
SEEN = {"sensor_id": "c", **AT_0, "confirmed": [None]}
ATTRIBUTES = [{"name": "n", "timestamps": [0, 5], "values": ["a", 1.5]}, {"name": "s", "static": True, "values": [1]}]
FLAT = {"sensor_id": "c", "stationary": False, "attributes": ATTRIBUTES}
ANNOTATIONS = {
    "cuboid": {
        "path": {"timestamps": [0, 10], "values": [[1.0] * 9] * 2},
        "attributes": ATTRIBUTES,
        "activations": [{"sensor_id": "l", **AT_0, "durations": [5], "cuboids": [[1.0] * 9]}],
        "projections": [SEEN | {"boxes": [[1, 2, 3, 4]]}, SEEN | {"boxes": [None], "cuboids": [[1.0] * 9]}],
    },
    "box_2d": FLAT | {"path": AT_0 | {"values": [[1, 2, 3, 4]]}},
    "polyline_2d": FLAT | {"path": AT_0 | {"values": [[1, 2, 3, 4]]}},
    "polygon_2d": FLAT | {"path": AT_0 | {"values": [[1, 2, 3, 4, 5, 6]]}},
    "point_2d": FLAT | {"path": AT_0 | {"values": [[1, 2]]}},
    "polygon": {"path": AT_0 | {"values": [[1, 2, 3, 4, 5, 6, 7, 8, 9]]}},
    "polygon_topdown": {"path": AT_0 | {"values": [[1, 2, 3, 4, 5, 6, 7, 8, 9]]}},
    "polyline": {"is_closed": True, "path": AT_0 | {"values": [[1, 2, 3, 4, 5, 6]]}},
    "point": {"path": AT_0 | {"values": [[1, 2, 3]]}},
    "point_topdown": {"path": AT_0 | {"values": [[1, 2, 3]]}},
    "points": {
        "labels": ["nose"],
        "paths": [{"id": "nose", **AT_0, "values": [[1, 2, 3]]}],
        "projections": [[SEEN | {"points": [[1, 2]], "positions": [None]}]],
    },
    "event": {"start": 5, "duration": 7.5, "sensor_id": "c"},
    "labeled_points": {
        "label": "car",
        "is_instance": True,
        "labeled_points": [{"sensor_id": "l", "sensor_frame": 0, "point_ids": np.array([0, 1], np.uint32)}],
    },
    "localization_adjustment": {"poses": POSES},
    "camera_calibration": {"sensor_id": "c", "poses": POSES, "intrinsics": FISHEYE, "time_offset": 3},
    "object": {"label": "car", "attributes": ATTRIBUTES},
    "link": {"from_id": "object", "to_id": "cuboid", "is_bidirectional": True},
    "group": {"label": "g"},
}
"""The fields of an annotation of each type."""

OURS = {
    "time_shift_ns": 5,
    "sensor_notes": [
        {
            "id": "c",
            "points_frame": "sensor",
            "mount": [[1.0, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3]],
            "camera": {"model": "pinhole", "coefficients": [], **PINHOLE},
            "images": {"cameras": [{"model": "fisheye", "coefficients": [1.0], **PINHOLE}], "camera_of_image": [0]},
        }
    ],
    "sensors": [
        {
            "id": "i",
            "type": "imu",
            "streams": {"gyroscope": {"timestamps_ns": np.array([1, 2]), "values": np.ones((2, 3))}},
        }
    ],
    "trajectories": [
        {"name": "o", "sensor_id": "o"},
        {"name": "w", "timestamps_ns": np.array([1, 2]), "positions": np.ones((2, 3))},
    ],
    "warnings": [{"kind": "assumed", "code": "a", "location": "b", "message": "c", "count": 1}],
    "exact_attributes": [{"index": 0, "timestamps": [1], "values": [1.5], "written": [1500]}],
}
"""Our own metadata."""


def header(sensors=(), annotations=(), **fields):
    """The header of a scene file with sensors and annotations of these types."""
    listed = {
        "sensors": [{"id": kind[0], "type": kind, **SENSORS[kind]} for kind in sensors],
        "annotations": [{"id": kind, "type": kind, **ANNOTATIONS[kind]} for kind in annotations],
    }
    return copy.deepcopy({"version": "1.0", **{key: value for key, value in listed.items() if value}, **fields})
