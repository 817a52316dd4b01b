"""A coverage-guided fuzzer of the `.sfs` codec: whatever the bytes, the answer is values or an error of ours.

Run with `python tests/malformed/fuzz_sfs.py [--seconds 600] [FOLDER]`; it needs atheris. The folder collects the inputs
that reach something new, and in it, as files named `crash-…`, those that were answered otherwise. It begins with small
scenes of every sensor and every annotation. pytest does not run it; what it finds becomes a test of its own.
"""

import argparse
import contextlib
import copy
import json
import random
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import atheris
import numpy as np

with atheris.instrument_imports(include=["sceneloom.formats.sfs", "sceneloom.scene"]):
    from sceneloom.errors import SceneloomError
    from sceneloom.formats.sfs.salvage import salvage
    from sceneloom.formats.sfs.spec import FORMAT

LONGEST = 1 << 14
STRANGE = [None, True, -1, 0, 7, 2**31, 2**63, -(2**63), 10**30, 1e300, 0.5, float("nan"), float("inf"), "", "x", "0"]
STRANGE += ["sonar", "lidar", "camera", "cuboid", [], [None], [[]], [[0.5] * 7], {}, {"id": 1}, {"timestamps": [1]}]
"""What takes the position of values of a header."""

TWO = [[1.0, 2, 3], [4, 5, 6]]
POSES = {"timestamps": [0, 100], "values": [[1, 2, 3, 0, 0, 0, 1], [1, 2, 3, 0, 0, 0.6, 0.8]]}
CAMERA_MODEL = {"fx": 9.5, "fy": 9, "cx": 3.5, "cy": 3.5, "width": 8, "height": 8}
PATH = {"timestamps": [0, 10], "values": [[1.0] * 9] * 2}
PROJECTIONS = [{"sensor_id": "c", "timestamps": [0], "boxes": [[1, 2, 3, 4]], "confirmed": [True]}]
ATTRIBUTES = [{"name": "n", "timestamps": [0, 5], "values": ["a", 1.5]}, {"name": "s", "static": True, "values": [1]}]
FLAT = {"sensor_id": "c", "stationary": False, "attributes": ATTRIBUTES}

ANNOTATIONS = {
    "cuboid": {
        "path": PATH,
        "activations": [{"sensor_id": "l", "timestamps": [0], "durations": [5]}],
        "projections": PROJECTIONS,
    },
    "box_2d": {**FLAT, "path": {"timestamps": [0], "values": [[1, 2, 3, 4]]}},
    "polyline_2d": {**FLAT, "path": {"timestamps": [0], "values": [[1, 2, 3, 4]]}},
    "polygon_2d": {**FLAT, "path": {"timestamps": [0], "values": [[1, 2, 3, 4, 5, 6]]}},
    "point_2d": {**FLAT, "path": {"timestamps": [0], "values": [[1, 2]]}},
    "polygon": {"path": {"timestamps": [0], "values": [[1, 2, 3, 4, 5, 6, 7, 8, 9]]}},
    "polygon_topdown": {"path": {"timestamps": [0], "values": [[1, 2, 3, 4, 5, 6, 7, 8, 9]]}},
    "polyline": {"is_closed": True, "path": {"timestamps": [0], "values": [[1, 2, 3, 4, 5, 6]]}},
    "point": {"path": {"timestamps": [0], "values": [[1, 2, 3]]}},
    "point_topdown": {"path": {"timestamps": [0], "values": [[1, 2, 3]]}},
    "points": {
        "labels": ["nose"],
        "paths": [{"id": "nose", "timestamps": [0], "values": [[1, 2, 3]]}],
        "projections": [[{"sensor_id": "c", "timestamps": [0], "points": [[1, 2]]}]],
    },
    "event": {"start": 5, "duration": 7, "sensor_id": "c"},
    "labeled_points": {
        "label": "car",
        "is_instance": True,
        "labeled_points": [{"sensor_id": "l", "sensor_frame": 0, "point_ids": ("uint32", [0, 1])}],
    },
    "localization_adjustment": {"poses": POSES},
    "camera_calibration": {"sensor_id": "c", "poses": POSES, "intrinsics": CAMERA_MODEL, "time_offset": 3},
    "object": {"label": "car", "attributes": ATTRIBUTES},
    "link": {"from_id": "object", "to_id": "cuboid", "is_bidirectional": True},
    "group": {"label": "g"},
}
CLOUD = {
    "positions": ("float32", TWO),
    "colors": ("uint8", [[1, 2, 3]] * 2),
    "intensities": ("uint8", [1, 2]),
    "timestamps": ("uint32", [5, 9]),
}
RADAR = {"positions": ("float32", TWO), "directions": ("float32", TWO), "lengths": ("float32", [1, 2])}
SENSORS = {
    "lidar": {"poses": POSES, "coordinates": "world", "frames": [{"timestamp": 5, "points": CLOUD}]},
    "radar": {"poses": POSES, "coordinates": "ego", "frames": [{"timestamp": 5, "points": RADAR}]},
    "points": {"points": {"positions": ("float32", TWO)}},
    "camera": {
        "poses": POSES,
        "intrinsics": {**CAMERA_MODEL, "distortion": {"model": "fisheye", "params": [1, 2, 3, 4]}},
        "images": [{"timestamp": 3, "content": ("uint8", [255, 216, 255])}],
    },
    "odometry": {"poses": POSES},
    "sonar": {"values": ("float64", [1, 2])},
}


def encoded(header: dict[str, object]) -> bytes:
    """Write a container; arrays are given as (dtype, values)."""
    items, blobs = [], bytes(4)

    def location(node: object, keys: list[object]) -> object:
        nonlocal blobs
        if isinstance(node, dict):
            return {key: location(value, [*keys, key]) for key, value in node.items()}
        if isinstance(node, list):
            return [location(value, [*keys, index]) for index, value in enumerate(node)]
        if isinstance(node, tuple):
            array = np.array(node[1], node[0])
            item = {"keys": keys, "length": array.nbytes, "offset": len(blobs)}
            items.append({**item, "dtype": node[0], "shape": list(array.shape)})
            blobs += array.tobytes() + bytes(4 - array.nbytes % 4)
            return ""
        return node

    text = json.dumps({**location(header, []), "$items": items}, separators=(",", ":")).encode()
    return text + blobs


def seeds() -> dict[str, bytes]:
    """A small scene for each type of sensor and of annotation, and one of our own metadata."""
    found = {}
    for kind, fields in SENSORS.items():
        sensor = {"id": kind[0], "type": kind, **fields}
        found[kind] = encoded({"version": "1.0", "time_offset": 5, "sensors": [sensor]})
    for kind, fields in ANNOTATIONS.items():
        annotation = {"id": kind, "type": kind, **fields}
        found[kind] = encoded({"version": "5.1", "time_unit": "nanoseconds", "annotations": [annotation]})
    imu = {"timestamps_ns": ("int64", [1, 2]), "values": ("float64", TWO)}
    ours = {
        "sensor_notes": [{"id": "l", "points_frame": "sensor", "mount": [[1.0, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3]]}],
        "sensors": [{"id": "i", "type": "imu", "streams": {"gyroscope": imu}}],
        "trajectories": [{"name": "w", "timestamps_ns": ("int64", [1, 2]), "positions": ("float64", TWO)}],
        "warnings": [{"kind": "assumed", "code": "a", "location": "b", "message": "c", "count": 1}],
    }
    found["ours"] = encoded({"version": "1.0", "attributes": ATTRIBUTES, "metadata": {"sceneloom": ours}})
    return found


def locations(node: Any, holder: Any = None, key: Any = None) -> Iterator[tuple[Any, Any]]:
    """What holds each value of a header, and under which key."""
    if holder is not None:
        yield holder, key
    parts = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for inner, value in parts:
        yield from locations(value, node, inner)


def changed(content: bytes, longest: int, seed: int) -> bytes:
    """Change a value of the header into another, take it out or put it in twice; else change bytes."""
    rng = random.Random(seed)
    stop = content.find(b"\0")
    try:
        header = json.loads(content[:stop])
        for _ in range(rng.randint(1, 3)):
            holder, key = rng.choice(list(locations(header)))
            other, its_key = rng.choice(list(locations(header)))
            trajectory = rng.random()
            if trajectory < 0.2:
                del holder[key]
            elif trajectory < 0.3 and isinstance(holder, list):
                holder.append(copy.deepcopy(holder[key]))
            elif trajectory < 0.6:
                holder[key] = copy.deepcopy(other[its_key])
            else:
                holder[key] = copy.deepcopy(rng.choice(STRANGE))
        found = json.dumps(header, separators=(",", ":")).encode() + content[stop:]
    except (ValueError, IndexError, RecursionError):
        found = b""
    if not found or len(found) > longest or rng.random() < 0.2:
        return bytes(atheris.Mutate(content, longest))
    return found


def look_at_everything(path: Path) -> None:
    """Open a file in every way, touch all that is in it, and salvage it."""
    FORMAT.sniff(path)
    for options in ({}, {"lenient": True}):
        with contextlib.suppress(SceneloomError), FORMAT.open(path, **options) as scene:
            for sensor in scene.sensors:
                for frame in (*getattr(sensor, "frames", ()), *getattr(sensor, "images", ())):
                    getattr(frame, "points", None)
                for image in getattr(sensor, "images", ()):
                    with contextlib.suppress(SceneloomError):
                        image.rgb.max()
            repr(scene.annotations)
    with contextlib.suppress(SceneloomError):
        target = path.with_suffix(".out.sfs")
        salvage(path, target, overwrite=True)
        FORMAT.open(target).close()


def main() -> None:
    """Fuzz for the time asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=600)
    parser.add_argument("folder", type=Path, nargs="?")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = asked.folder or Path(scratch) / "inputs"
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in seeds().items():
            (folder / f"seed-{name}").write_bytes(content)
        path = Path(scratch) / "scene.sfs"

        def try_one(content: bytes) -> None:
            path.unlink(missing_ok=True)
            path.write_bytes(content)
            look_at_everything(path)

        limits = [f"-max_total_time={asked.seconds}", f"-max_len={LONGEST}", "-timeout=20", "-rss_limit_mb=2048"]
        arguments = [sys.argv[0], *limits, f"-artifact_prefix={folder}/", str(folder)]
        atheris.Setup(arguments, try_one, custom_mutator=changed)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
