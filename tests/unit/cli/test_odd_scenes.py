"""Every verb on scenes that are odd: it is done, or one error says which file and what of it; never anything else."""

import io
import json
import re
import resource
import signal
import subprocess
import sys
import traceback
from collections import defaultdict
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tests.unit.cli.conftest import small_drive, verbs, write_boxes

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.cli.main import sceneloom as command_line
from sceneloom.formats.base.registry import written_formats
from sceneloom.service.running import running_server

SECONDS = 60
"""After this long a verb hangs; each takes a fraction of a second."""
MEMORY = 3 << 30
"""How much more memory than before a verb may ask for [bytes of address space]; sound scenes take a hundredth."""
UNFORESEEN = r"Traceback|(Runtime|User|Rerun)Warning|(Value|Index|Type|Key|Overflow|Attribute|Memory|Assertion)Error"
"""What no output of a verb holds."""
LARGEST = float(np.finfo(np.float32).max)
FIRST, LAST = -(2**63), 2**63 - 1
"""The ends of int64."""


def jpeg(width=48, height=32):
    pixels = np.random.default_rng(1).integers(0, 255, (height, width, 3), dtype=np.uint8)
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, "JPEG")
    return np.frombuffer(content.getvalue(), np.uint8)


def points(seed):
    rng = np.random.default_rng(seed)
    return {
        "positions": rng.uniform([2, -4, -1], [12, 4, 1], (60, 3)).astype(np.float32),
        "intensities": rng.integers(0, 255, 60).astype(np.uint8),
        "timestamps": np.linspace(0, 90_000, 60).astype(np.uint32) + seed * 100_000,
    }


INTRINSICS = {"fx": 30.0, "fy": 30.0, "cx": 23.5, "cy": 15.5, "width": 48, "height": 32}
ROW = [4.0, 2.0, 1.5, 8.0, 1.0, 0.0, 0.0, 0.0, 30.0]


def poses(*pose):
    values = [[0.5 * k, 0.0, *pose] for k in range(3)]
    return {"timestamps": [0, 100_000, 200_000], "values": values}


def base():
    """A sound scene of two sweeps, two images, an odometry and annotations of most kinds."""
    sweeps = [{"timestamp": 100_000 * k, "points": points(k)} for k in range(2)]
    images = [{"timestamp": 50_000 + 100_000 * k, "content": jpeg()} for k in range(2)]
    ego, mounted = poses(0.0, 0.0, 0.0, 0.0, 1.0), poses(0.5, -0.5, 0.5, -0.5, 0.5)
    camera = {"type": "camera", "coordinates": "world", "intrinsics": {**INTRINSICS}}
    path = {"timestamps": [0, 200_000], "values": [[*ROW], [*ROW[:3], 9.0, *ROW[4:]]]}
    box = {"timestamps": [50_000], "values": [[3.0, 4.0, 10.0, 8.0]]}
    lane = {"timestamps": [0], "values": [[4.0, 0.0, 0.0, 9.0, 1.0, 0.0]]}
    car = {"label": "car", "stationary": False}
    return {
        "version": "1.0",
        "sensors": [
            {"id": "lidar", "type": "lidar", "coordinates": "world", "poses": ego, "frames": sweeps},
            {"id": "camera", **camera, "poses": mounted, "images": images},
            {"id": "ego", "type": "odometry", "poses": {**ego}},  # the lidar's: what is odd about one is so of both
        ],
        "annotations": [
            {"id": "car", "type": "cuboid", **car, "path": path},
            {"id": "flat", "type": "box_2d", **car, "sensor_id": "camera", "path": box},
            {"id": "line", "type": "polyline", "label": "lane", "is_closed": False, "path": lane},
        ],
    }


def keys_of(holder, key):
    """What a key, the number or the id of something in a list, or `*` for all of it, stands for."""
    if isinstance(holder, dict):
        return [key]
    if key == "*" or key.isdecimal():
        return range(len(holder)) if key == "*" else [int(key)]
    return [[one["id"] for one in holder].index(key)]


def make_odd(header, name):
    """Put what is odd at its locations: a value, what a function makes of the sound one, or `...` for nothing."""
    for location, value in ODD[name].items():
        *way, last = location.split(".")
        holders = [header]
        for key in way:
            holders = [holder[found] for holder in holders for found in keys_of(holder, key)]
        for holder in holders:
            for key in keys_of(holder, last):
                if value is ...:
                    del holder[key]
                else:
                    holder[key] = value(holder[key]) if callable(value) else deepcopy(value)


def more(*others):
    return lambda found: [*found, *deepcopy(others)]


def first_points(count):
    return lambda points: {name: array[:count] for name, array in points.items()}


def in_nanoseconds(lidar_ns, camera_ns=None):
    start_ns, stop_ns = lidar_ns
    times = {"lidar.frames": lidar_ns, "camera.images": camera_ns or lidar_ns}
    return {
        "time_unit": "nanoseconds",
        **{f"sensors.{of}.{k}.timestamp": both[k] for of, both in times.items() for k in range(2)},
        "sensors.lidar.frames.*.points.timestamps": ...,
        "sensors.*.poses.timestamps": [start_ns, (start_ns + stop_ns) // 2, stop_ns],
        f"{PATH}.timestamps": lidar_ns,
    }


def corrected_by(shift, later, camera="camera"):
    poses = {"timestamps": [0], "values": [[shift, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]]}
    mounted = {"id": "mounted", "type": "camera_calibration", "sensor_id": camera, "poses": poses}
    placed = {"id": "placed", "type": "localization_adjustment", "poses": poses}
    return {"annotations": more({**mounted, "intrinsics": INTRINSICS, "time_offset": later}, placed)}


def size_of_cuboid(*size):
    return {f"{PATH}.values.*.{k}": value for k, value in enumerate(size)}


def column_of_cuboid(column, *values):
    return {f"{PATH}.values.{k}.{column}": value for k, value in enumerate(values)}


PATH = "annotations.car.path"
SWEEPS, POINTS, IMAGES = "sensors.lidar.frames", "sensors.lidar.frames.1.points", "sensors.camera.images"
CAMERA_MODEL, EGO = "sensors.camera.intrinsics", "sensors.ego.poses"
BOX, LANE = "annotations.flat.path.values", "annotations.line.path.values"
NAMED = {
    "id": "keypoints",
    "type": "points",
    "label": "person",
    "labels": ["nose", "ear"],
    "paths": [
        {"id": "nose", "timestamps": [0], "values": [[8.0, 0.0, 0.0]]},
        {"id": "ear", "timestamps": [0], "values": [[1e300, 0.0, 0.0]]},
    ],
    "projections": [[{"sensor_id": "camera", "timestamps": [50_000], "points": [[20.0, 10.0]]}], []],
}
HUGE = [1e300, -1e300, 1e300, 1e300]
ENDS = np.array([[LARGEST] * 3, [-LARGEST] * 3, [1.0, 2.0, 3.0]], np.float32)
ALTERNATING = np.where(np.arange(60)[:, None] % 2, -LARGEST, LARGEST).repeat(3, axis=1).astype(np.float32)
RADAR = {"positions": ENDS, "directions": ENDS, "lengths": np.array([LARGEST, -LARGEST, 0], np.float32)}
PAINTED = {"sensor_id": "lidar", "sensor_frame": 1, "point_ids": np.array([0, 59, 4_000_000_000], np.uint32)}
ROAD = {"type": "labeled_points", "label": "road", "is_instance": False, "labeled_points": [PAINTED]}
LINK = {"type": "link", "label": "l", "from_id": "nobody", "to_id": "link", "is_bidirectional": True}

ODD: dict[str, dict[str, Any]] = {
    "sound": {},
    "one_far_point": {f"{POINTS}.positions.0": (1e30, 0, 0)},
    "a_point_at_the_end_of_float32": {f"{POINTS}.positions.0": (LARGEST, -LARGEST, LARGEST)},
    "a_subnormal_point": {f"{POINTS}.positions.0": (1e-45, 1e-45, 1e-45)},
    "a_point_of_nan": {f"{POINTS}.positions.0": (np.nan, 0, 0)},
    "a_point_of_infinity": {f"{POINTS}.positions.0": (np.inf, -np.inf, 0)},
    "a_point_10_km_off": {f"{POINTS}.positions.0": (1e4, 0, 0)},
    "only_points_of_nan": {f"{SWEEPS}.*.points.positions.*": np.nan},
    "all_points_at_the_end_of_float32": {f"{SWEEPS}.*.points.positions": ALTERNATING},
    "all_points_at_one_position": {f"{SWEEPS}.*.points.positions.*": 0},
    **{
        f"a_pose_of_{name}_at_{value:g}": {f"sensors.{name}.poses.values.1.0": value}
        for name in ("lidar", "camera", "ego")
        for value in (1e15, 1e300, 1.7e308)
    },
    "all_poses_at_1e15": {"sensors.*.poses.values.*.0": lambda x: x + 1e15},
    "poses_at_both_ends_of_float64": {"sensors.*.poses.values.0.0": -1.7e308, "sensors.*.poses.values.1.0": 1.7e308},
    "one_pose": {"sensors.*.poses": lambda poses: {"timestamps": [0], "values": poses["values"][:1]}},
    "no_poses": {"sensors.*.poses": {"timestamps": [], "values": []}},
    "a_quaternion_of_zeros": {f"{EGO}.values.1": lambda pose: [*pose[:3], 0.0, 0.0, 0.0, 0.0]},
    "no_sensors": {"sensors": [], "annotations": []},
    "only_annotations": {"sensors": ...},
    "only_an_odometry": {"sensors": lambda sensors: sensors[2:]},
    "only_a_lidar": {"sensors": lambda sensors: sensors[:1]},
    "only_a_camera": {"sensors": lambda sensors: sensors[1:2]},
    "sensors_without_frames": {SWEEPS: [], IMAGES: []},
    "a_camera_without_images": {IMAGES: []},
    "a_lidar_without_frames": {SWEEPS: []},
    "frames_without_points": {f"{SWEEPS}.*.points": first_points(0)},
    "a_frame_without_points": {f"{SWEEPS}.0.points": first_points(0)},
    "frames_of_one_point": {f"{SWEEPS}.*.points": first_points(1)},
    "times_at_both_ends_of_int64": in_nanoseconds([FIRST, LAST]),
    "times_at_the_upper_end_of_int64": in_nanoseconds([LAST - 99_999_999, LAST]),
    "times_at_the_lower_end_of_int64": in_nanoseconds([FIRST, FIRST + 100_000_000]),
    "an_image_at_the_end_of_int64": in_nanoseconds([0, 100_000_000], [0, LAST]),
    "an_annotation_at_the_ends_of_int64": {**in_nanoseconds([0, 100_000_000]), f"{PATH}.timestamps": [FIRST, LAST]},
    "times_beyond_int64": {f"{SWEEPS}.1.timestamp": 2**63},
    "a_time_offset_at_the_end_of_int64": {"time_unit": "nanoseconds", "time_offset": LAST},
    "equal_times": {f"{SWEEPS}.1.timestamp": 0, f"{IMAGES}.1.timestamp": 50_000},
    "times_out_of_order": {
        location: lambda rows: rows[::-1]
        for location in (SWEEPS, IMAGES, "sensors.*.poses.timestamps", f"{PATH}.timestamps")
    },
    "point_times_out_of_the_sweep": {f"{POINTS}.timestamps": np.full(60, 2**32 - 1, np.uint32)},
    "a_cuboid_of_no_size": size_of_cuboid(0, 0, 0),
    "a_cuboid_of_1e12_m": size_of_cuboid(1e12, 1e12, 1e12),
    "a_cuboid_of_1e300_m": size_of_cuboid(1e300, 1e300, 1e300),
    "a_cuboid_of_negative_size": size_of_cuboid(-4, -2, -1),
    "a_cuboid_as_thin_as_can_be": size_of_cuboid(5e-324, 4, 4),
    "a_cuboid_at_1e15": column_of_cuboid(3, 1e15, 1e15),
    "a_cuboid_from_end_to_end_of_float64": column_of_cuboid(3, -1.7e308, 1.7e308),
    "a_cuboid_rotated_by_1e300": column_of_cuboid(8, 1e300, 0.0),
    "a_cuboid_rotated_by_1.7e308": column_of_cuboid(7, 1.7e308, 1.7e308),
    "a_cuboid_in_the_camera": column_of_cuboid(3, 0.0, 0.5),
    "a_cuboid_without_a_path": {PATH: {"timestamps": [], "values": []}},
    "huge_shapes": {
        BOX: [[-1e300, -1e300, 1.7e308, 1.7e308]],
        LANE: [[-1.7e308, 0.0, 0.0, 1.7e308, 0.0, 0.0, 0.0, 1e15, 1.0]],
    },
    "shapes_of_no_size": {BOX: [[3.0, 4.0, 0.0, 0.0]], LANE: [[4.0, 0.0, 0.0, 4.0, 0.0, 0.0]]},
    "shapes_without_corners": {LANE: [[]]},
    "keypoints_that_no_camera_sees": {"annotations": more(NAMED)},
    "a_keypoint_without_projections": {
        "annotations": more({**NAMED, "labels": ["nose"], "paths": NAMED["paths"][:1], "projections": [[]]})
    },
    "activations": {
        "annotations.car.activations": [
            {"sensor_id": "lidar", "timestamps": [0, 100_000], "durations": [0, 2**53], "cuboids": [ROW, ROW]},
            {"sensor_id": "camera", "timestamps": [], "durations": []},
            {"sensor_id": "nobody", "timestamps": [0]},
        ],
        "annotations.car.projections": [
            {"sensor_id": "camera", "timestamps": [50_000], "boxes": [HUGE], "confirmed": [True]}
        ],
    },
    "activations_at_the_ends_of_int64": {
        **in_nanoseconds([0, 100_000_000]),
        "annotations.car.activations": [{"sensor_id": "lidar", "timestamps": [FIRST, LAST], "durations": [LAST, LAST]}],
    },
    "corrections": corrected_by(0.1, 3),
    "corrections_by_1e15": corrected_by(1e15, 2**53),
    "corrections_by_1.7e308": corrected_by(1.7e308, -(2**53)),
    "a_correction_of_nobody": corrected_by(0.1, 3, camera="nobody"),
    "labelled_points_beyond_the_cloud": {"annotations": more({"id": "painted", **ROAD})},
    "attributes_of_extreme_numbers": {
        "annotations.car.attributes": [
            {"name": "speed", "timestamps": [0, 100_000], "values": [1.7e308, -1.7e308]},
            {"name": "", "timestamps": [0], "values": [2**63]},
            {"name": "none", "timestamps": [], "values": []},
        ]
    },
    "an_image_without_size": {f"{CAMERA_MODEL}.width": 0, f"{CAMERA_MODEL}.height": 0},
    "a_camera_model_of_a_huge_image": {f"{CAMERA_MODEL}.{side}": 1_000_000_000 for side in ("width", "height")},
    "a_camera_model_without_focal_length": {f"{CAMERA_MODEL}.fx": 0.0, f"{CAMERA_MODEL}.fy": 0.0},
    "a_camera_model_of_1e300_px": {f"{CAMERA_MODEL}.fx": 1e300, f"{CAMERA_MODEL}.fy": 1e300},
    "a_camera_model_centred_at_1.7e308": {f"{CAMERA_MODEL}.cx": 1.7e308, f"{CAMERA_MODEL}.cy": -1.7e308},
    "a_camera_model_of_huge_coefficients": {
        f"{CAMERA_MODEL}.distortion": {"model": "brown_conrady", "params": [1e300, 1e300, 1.0, 1.0, 1e300]}
    },
    "a_fisheye_of_huge_coefficients": {
        f"{CAMERA_MODEL}.distortion": {"model": "fisheye", "params": [-1e300, 1e300, 1e10, 1e300]}
    },
    "images_that_are_none": {f"{IMAGES}.1.content": np.zeros(0, np.uint8)},
    "images_of_one_pixel": {
        f"{IMAGES}.*.content": jpeg(1, 1),
        CAMERA_MODEL: {**INTRINSICS, "width": 1, "height": 1, "cx": 0.0, "cy": 0.0},
    },
    "images_of_another_size": {f"{IMAGES}.1.content": jpeg(64, 8)},
    "ids_of_all_scripts": {
        **{f"sensors.{k}.id": name for k, name in enumerate(("激光雷达/..\\ \u202e", "\U0001f4f7\n", ""))},
        "annotations.flat.sensor_id": "\U0001f4f7\n",
        "annotations.0.id": "../../x",
        "annotations.0.label": "\u0000\u001b[31m машина",
    },
    "ids_without_letters": {
        **{f"sensors.{k}.id": name for k, name in enumerate(("", " ", "."))},
        "annotations.flat.sensor_id": " ",
        "annotations.0.id": "",
        "annotations.0.label": "",
    },
    "ids_of_300_letters": {
        "sensors.*.id": lambda name: name[0] * 300,
        "annotations.flat.sensor_id": "c" * 300,
        "annotations.0.id": "x" * 300,
        "annotations.0.label": "y" * 300,
    },
    "ids_that_are_numbers": {
        **{f"sensors.{k}.id": number for k, number in enumerate((2**63, -1, 0))},
        "annotations.flat.sensor_id": -1,
    },
    "ids_twice": {location: lambda found: [*found, deepcopy(found[0])] for location in ("sensors", "annotations")},
    "ids_that_differ_in_type_only": {
        "sensors": lambda found: [*found, *({**deepcopy(found[0]), "id": name} for name in (7, "7"))]
    },
    "many_sensors_of_a_kind": {
        "sensors": lambda found: [*found, *({**deepcopy(one), "id": f"{one['id']}2"} for one in found[:2])]
    },
    "a_radar_and_a_map_at_the_ends_of_float32": {
        "sensors": lambda found: [
            *found,
            {**found[0], "id": "radar", "type": "radar", "frames": [{"timestamp": 0, "points": RADAR}]},
            {"id": "map", "type": "points", "points": {"positions": ENDS}},
        ]
    },
    "links_to_nobody": {
        "annotations": more(
            {"id": "link", **LINK},
            {"id": "event", "type": "event", "label": "e", "start": -(2**53), "duration": 2**53},
            {"id": "group", "type": "group", "label": "g", "parent_id": "group"},
        )
    },
    **{
        f"{value}_in_{what}": {location: number}
        for value, number in (("nan", np.nan), ("infinity", np.inf))
        for what, location in (
            ("a_pose", f"{EGO}.values.1.0"),
            ("a_cuboid", f"{PATH}.values.0.3"),
            ("a_camera_model", f"{CAMERA_MODEL}.fx"),
            ("a_time", f"{SWEEPS}.0.timestamp"),
        )
    },
}
"""What is odd about each scene: where, and what is there."""


SCENE = ("-o", "OUT.sfs")
LISTS = ("--boxes3d", "BOXES3D", "--boxes2d", "BOXES2D")
CASES: dict[str, tuple[str, ...]] = {
    "info": ("DRIVE",),
    "info --visualize": ("DRIVE", "--visualize", "OUT"),
    "fuse": ("DRIVE", *SCENE, "--visualize", "OUT.drawn", "--depth", "OUT.depths"),
    "fuse --type detection": ("DRIVE", "--type", "detection", *LISTS, "-o", "OUT.jsonl"),
    "track": ("DRIVE", *LISTS, *SCENE, "--format", "sfs", "--visualize", "OUT.drawn"),
    "track --offline": ("DRIVE", *LISTS, "-o", "OUT.jsonl", "--format", "jsonl"),
    "colour": ("DRIVE", *SCENE, "--visualize", "OUT.drawn", "--remove-moving"),
    "colour --per-sweep": ("DRIVE", "--per-sweep", "OUT.sfs"),
    "depth": ("DRIVE", "-o", "OUT", "--method", "dense", "--visualize", "OUT.drawn"),
    "depth --method sparse": ("DRIVE", "-o", "OUT", "--form", "npz", "--method", "sparse"),
    "view": ("DRIVE", "--save", "OUT.rrd"),
    "view --as-measured": ("DRIVE", "--save", "OUT.rrd", "--as-measured", "--colour-by", "height"),
    **{f"convert --to {name}": ("DRIVE", "OUT", "--to", name) for name in written_formats()},
    "convert to a trajectory": ("DRIVE", "OUT.tum"),
    "convert --profile scale": ("DRIVE", "OUT.sfs", "--profile", "scale"),
    "validate": ("DRIVE",),
    "validate --fix": ("DRIVE", "--fix", "OUT.sfs"),
    "validate --profile scale": ("DRIVE", "--profile", "scale", "--json"),
    "salvage": ("DRIVE", *SCENE),
    "report": ("DRIVE", "-o", "OUT.html", "--numbers", "OUT.json"),
    "diff": ("DRIVE", "SOUND"),
    "view --colour-by ring": ("DRIVE", "--save", "OUT.rrd", "--every", "2", "--sensor", "lidar", "--colour-by", "ring"),
    "info --visualize --at": ("DRIVE", "--visualize", "OUT", "--at", "0.01", "--no-corrections"),
    "diff of the same": ("DRIVE", "DRIVE"),
    "batch fuse": ("DRIVE", "-o", "OUT", "--workers", "1"),
    "batch convert": ("DRIVE", "-o", "OUT", "--workers", "1", "--to", "kitti-tracking"),
    "batch validate": ("DRIVE", "-o", "OUT", "--workers", "1"),
    "batch track": ("DRIVE", "-o", "OUT", "--workers", "1", *LISTS),
    "batch report": ("DRIVE", "-o", "OUT", "--workers", "1"),
    "catalog build": ("DRIVE", "-o", "OUT", "--workers", "1"),
    "edit merge": ("DRIVE", "SOUND", *SCENE, "--rename", "--force"),
    "edit crop": ("DRIVE", *SCENE, "--box", "0,-5,-2,20,5,3"),
    "edit crop --range": ("DRIVE", *SCENE, "--frame", "sensor", "--range", "9"),
    "edit crop --stop": ("DRIVE", *SCENE, "--stop", "0.05"),
    "edit thin": ("DRIVE", *SCENE, "--voxel", "0.5"),
    "edit camera-model": ("DRIVE", *SCENE, "--model", "fisheye", "--limit", "9"),
    "edit simplify": ("DRIVE", *SCENE),
    "edit anonymise": ("DRIVE", *SCENE, "--fixes", "shift"),
    "edit anonymise --dates": ("DRIVE", *SCENE, "--dates", "shift"),
    "edit blur": ("DRIVE", *SCENE, "--label", "car"),
    "edit count": ("DRIVE", *SCENE, "--activations", "--labeled-points"),
    "edit project": ("DRIVE", *SCENE, "--activations", "--lidar", "lidar"),
    **{f"edit {n}": ("DRIVE", *SCENE) for n in ("deskew", "to-world", "to-ego", "to-sensor", "apply", "undistort")},
    "eval detection": ("DRIVE", "SOUND"),
    "eval tracking": ("DRIVE", "SOUND", "--plot", "OUT.png"),
    "eval tracking --similarity 3d": ("SOUND", "DRIVE", "--similarity", "3d"),
    "eval trajectory": ("DRIVE", "SOUND", "--plot", "OUT.png"),
    "eval trajectory --align": ("SOUND", "DRIVE", "--align", "sim3"),
    "sync": ("DRIVE",),
    "calibrate": ("DRIVE", "--visualize", "OUT"),
    "calibrate --refine": ("DRIVE", "--refine", *SCENE),
    "calibrate --conventions": ("DRIVE", "--conventions"),
    "calibrate --hand-eye": ("DRIVE", "--hand-eye"),
    "calibrate --lidar-to-lidar": ("DRIVE", "--lidar-to-lidar"),
    "send": ("DRIVE", "ADDRESS", "--rate", "0"),
}
"""Each verb, in its modes, and what it is given. OUT is what does not exist yet."""
WITHOUT_DRIVES = frozenset(
    {"demo", "serve", "get", "conformance", "formats", "doctor", "completion", "batch status"}
    | {"catalog update", "catalog query"}
)
"""Verbs that read no drive; a catalogue that is built is also brought up to date and asked."""
CODES: dict[str, set[int]] = defaultdict(set, sync={1, 3}, calibrate={1, 3, 4, 5})
CODES.update((name, {1}) for name in ("validate", "diff", "eval", "batch", "catalog"))
"""What verbs may end with beside 0 and an error."""
VERBS = dict(verbs(command_line))


@contextmanager
def bounded():
    """Stop what takes too long, and let nothing ask for much memory."""

    def stop(*_):
        raise AssertionError(f"it takes more than {SECONDS} s")

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, hard))
    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def words_of(case):
    """The words of a verb in the name of its case."""
    return tuple(max((name for name in VERBS if case.split(" --")[0].startswith(name)), key=len).split())


def test_every_verb_that_reads_a_drive_is_tried_on_odd_scenes():
    tried = {" ".join(words_of(case)) for case in CASES}
    assert tried | WITHOUT_DRIVES == set(VERBS)
    assert not tried & WITHOUT_DRIVES


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """What detectors reported, as files, and a server."""
    folder = tmp_path_factory.mktemp("lists")
    drive = small_drive(Camera("pinhole", 48, 32, 30.0, 30.0, 23.5, 15.5), frames=2)
    boxes_3d, boxes_2d = write_boxes(drive, folder)
    with running_server() as server:
        yield {"BOXES3D": str(boxes_3d), "BOXES2D": str(boxes_2d), "ADDRESS": server.address}


@pytest.fixture
def words_on(encode_sfs, given):
    """The words of a case, for an odd scene beside a sound one."""

    def words(case, name, folder):
        header = base()
        (folder / "sound.sfs").write_bytes(encode_sfs(header))
        make_odd(header, name)
        (folder / "drive.sfs").write_bytes(encode_sfs(header))
        known = {"DRIVE": folder / "drive.sfs", "SOUND": folder / "sound.sfs", **given}
        return [*words_of(case), *(known.get(word, word.replace("OUT", str(folder / "out"))) for word in CASES[case])]

    return words


@pytest.fixture
def fault_of(call, words_on, tmp_path, inline):
    """Report what is wrong with the end of a verb on an odd scene; None where nothing is."""

    def run(case, name):
        folder = tmp_path / f"{len(list(tmp_path.iterdir()))}"
        folder.mkdir()
        words = words_on(case, name, folder)
        verb = words_of(case)
        further = [("catalog", "update"), ("catalog", "query")] if verb == ("catalog", "build") else []
        try:
            with bounded():
                outcome = call(*words)
                for other in further if outcome.code == 0 else ():
                    asked = call(*other, str(folder / "out"))
                    if asked.code != 0:
                        return f"{other}: {asked}"
        except Exception:  # noqa: BLE001 - whatever it is, it is the answer
            return traceback.format_exc(limit=-4)
        error = next((line for line in outcome.err.splitlines() if line.startswith("sceneloom: ")), None)
        if error is not None and outcome.code in (1, 2):
            return f"it names no file: {outcome}" if outcome.code == 1 and "drive.sfs" not in error else None
        if outcome.code == 0 or outcome.code in CODES[verb[0]]:
            return outcome.out + outcome.err if re.search(UNFORESEEN, outcome.out + outcome.err) else None
        return f"code {outcome.code}: {outcome}"

    return run


FOUND = (
    ("info", "corrections_by_1.7e308"),
    ("fuse", "huge_shapes"),
    ("fuse", "times_at_both_ends_of_int64"),
    ("fuse", "times_at_the_lower_end_of_int64"),
    ("fuse --type detection", "a_pose_of_ego_at_1.7e+308"),
    ("track", "a_lidar_without_frames"),
    ("view", "times_at_the_lower_end_of_int64"),
    ("view", "activations_at_the_ends_of_int64"),
    ("convert --to recording", "times_at_the_upper_end_of_int64"),
    ("convert --to recording", "times_at_both_ends_of_int64"),
    ("convert --to recording", "a_camera_model_of_a_huge_image"),
    ("convert --to nuscenes", "nan_in_a_cuboid"),
    ("validate", "poses_at_both_ends_of_float64"),
    ("report", "times_at_the_upper_end_of_int64"),
    ("report", "times_at_both_ends_of_int64"),
    ("catalog build", "attributes_of_extreme_numbers"),
    ("catalog build", "times_at_the_lower_end_of_int64"),
    ("edit merge", "activations_at_the_ends_of_int64"),
    ("edit count", "times_at_the_upper_end_of_int64"),
    ("edit project", "an_image_at_the_end_of_int64"),
    ("edit to-ego", "nan_in_a_cuboid"),
    ("edit to-sensor", "a_pose_of_lidar_at_1.7e+308"),
    ("eval trajectory", "one_pose"),
    ("eval trajectory", "ids_of_300_letters"),
    ("eval detection", "nan_in_a_cuboid"),
    ("calibrate", "times_at_the_upper_end_of_int64"),
    ("send", "times_at_the_lower_end_of_int64"),
)
"""What did not end well once."""
COUNT = max(len(CASES), len(ODD))
DRAWN = [(list(CASES)[k % len(CASES)], list(ODD)[k % len(ODD)]) for k in range(COUNT)]
"""Each verb and each scene once."""


@pytest.mark.parametrize(("case", "name"), dict.fromkeys([*FOUND, *DRAWN]))
@pytest.mark.few(60)
def test_a_verb_ends_well_on_an_odd_scene(fault_of, case, name):
    assert fault_of(case, name) is None


@pytest.mark.slow
@pytest.mark.parametrize("name", ODD)
def test_every_verb_ends_well_on_an_odd_scene(fault_of, name):
    faults = {case: fault_of(case, name) for case in CASES}
    assert {case: fault for case, fault in faults.items() if fault is not None} == {}


LEFT_OUT = (
    ("view", "a_point_of_nan", "lidar points", 1),
    ("view", "a_point_of_infinity", "lidar points", 1),
    ("view", "only_points_of_nan", "lidar points", 120),
    ("view", "a_cuboid_of_1e300_m", "cuboid moments", 4),
    ("view", "a_pose_of_ego_at_1e+300", "ego poses", 1),
    ("view", "huge_shapes", "shapes", 1),
    ("view", "huge_shapes", "boxes in images", 1),
    ("view", "keypoints_that_no_camera_sees", "named points", 1),
    ("fuse", "a_point_of_nan", "points", 3),
    ("colour", "a_point_of_nan", "points", 1),
    ("depth", "a_point_of_nan", "points", 1),
    ("info --visualize --at", "only_points_of_nan", "points", 60),
    ("info --visualize", "a_cuboid_from_end_to_end_of_float64", "annotations", 5),
)


@pytest.mark.parametrize(("case", "name", "kind", "count"), LEFT_OUT)
@pytest.mark.few(5)
def test_what_an_image_or_a_view_cannot_show_is_counted(succeeds, words_on, tmp_path, case, name, kind, count):
    reported = json.loads(succeeds(*words_on(case, name, tmp_path), "--json").out)
    warnings = [*reported.get("warnings", ()), *(one for d in reported.get("drives", ()) for one in d["warnings"])]
    found = [one for one in warnings if one["code"] in {"not-drawn", "beyond-the-viewer"}]
    counted = {
        one["message"].split(" whose")[0] if one["location"] == "images" else one["location"]: one["count"]
        for one in found
    }
    assert counted[kind] == count
    assert "not finite" in found[0]["message"]


def test_of_a_sound_scene_nothing_is_left_out_and_a_report_says_how_many_points_are_not_drawn(
    succeeds, words_on, tmp_path
):
    for case in ("view", "fuse", "info --visualize", "track"):
        (folder := tmp_path / case).mkdir()
        outcome = succeeds(*words_on(case, "sound", folder))
        assert "finite" not in outcome.out + outcome.err, case
    succeeds(*words_on("report", "a_point_of_nan", tmp_path), "--quick")
    assert "points whose coordinates are not finite are not drawn" in (tmp_path / "out.html").read_text()


NO_NUMBERS = ("Infinity", "-Infinity", "NaN", "1e999")
NUMBER = re.compile("finite|number|inf|nan|range", re.IGNORECASE)
TOKEN = "@" * 12
"""Stands where one of them goes; its length stays, and with it the offsets of what follows the header."""


def of_all_annotations():
    """The sound scene with every kind of annotation and most kinds of sensors."""
    header = {**base(), "time_offset": 0}
    for name in (
        *("keypoints_that_no_camera_sees", "activations", "corrections", "labelled_points_beyond_the_cloud"),
        *("attributes_of_extreme_numbers", "links_to_nobody", "a_radar_and_a_map_at_the_ends_of_float32"),
    ):
        make_odd(header, name)
    event = next(one for one in header["annotations"] if one["type"] == "event")
    event.update(start=0, duration=1)  # microseconds in 32 bits hold no more than an hour before the sweeps
    return header


def numbers_in(node, location=()):
    """The locations of all numbers in a header."""
    if isinstance(node, dict | list):
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            yield from numbers_in(value, (*location, key))
    elif isinstance(node, int | float) and not isinstance(node, bool):
        yield location


def with_token(node, location):
    """A copy with the token at a location."""
    if not location:
        return TOKEN
    changed = node.copy()
    changed[location[0]] = with_token(node[location[0]], location[1:])
    return changed


@pytest.fixture
def spelled(encode_sfs):
    """The content of a file where another spelling stands for a number of its header."""

    def content(header, location, spelling):
        encoded, quoted = encode_sfs(with_token(header, location)), f'"{TOKEN}"'.encode()
        assert encoded.count(quoted) == 1
        return encoded.replace(quoted, spelling.encode().ljust(len(quoted)))

    return content


def test_what_is_no_finite_number_is_an_error_in_every_field_of_a_header(encode_sfs, spelled, tmp_path):
    header, path = of_all_annotations(), tmp_path / "drive.sfs"
    fields: dict[tuple[Any, ...], tuple[Any, ...]] = {}
    for location in numbers_in(header):
        if not {"attributes", "values"} <= set(location):  # they are anything
            fields.setdefault(tuple(key for k, key in enumerate(location) if k == 1 or isinstance(key, str)), location)
    assert len(fields) > 40
    path.write_bytes(encode_sfs(header))
    known = {(one.rule, one.path) for one in sceneloom.validate(path, frames=False).findings}
    passed = {}
    for number, location in enumerate(fields.values()):
        spelling = NO_NUMBERS[number % len(NO_NUMBERS)]
        path.write_bytes(spelled(header, location, spelling))
        findings = sceneloom.validate(path, frames=False).findings
        new = [one for one in findings if one.severity == "error" and (one.rule, one.path) not in known]
        if not any(NUMBER.search(one.message) for one in new):
            passed[location] = spelling
    assert passed == {}


@pytest.mark.slow
@pytest.mark.parametrize("spelling", NO_NUMBERS)
@pytest.mark.parametrize(("verb", "further"), [("validate", ()), ("info", ()), ("convert", ("OUT.sfs", "--overwrite"))])
def test_no_verb_breaks_on_what_is_no_finite_number(call, spelled, tmp_path, verb, further, spelling):
    header, path = of_all_annotations(), tmp_path / "drive.sfs"
    words = [word.replace("OUT", str(tmp_path / "out")) for word in further]
    faults = {}
    for location in numbers_in(header):
        path.write_bytes(spelled(header, location, spelling))
        with bounded():
            outcome = call(verb, path, *words)
        stated = outcome.out + outcome.err
        # `info` looks at no values of annotations, and those of attributes are anything
        passed = verb == "info" or (verb == "convert" and "attributes" in location)
        named = "drive.sfs" in stated and not re.search(UNFORESEEN, stated)
        if outcome.code not in ({0, 1} if passed else {1}) or not named:
            faults[location] = outcome
    assert faults == {}


def test_only_programs_and_not_imports_change_how_numpy_warns():
    script = (
        "import warnings, numpy as np; before = list(warnings.filters), np.geterr(); "
        "import sceneloom, sceneloom.cli.main, sceneloom.batch.running, sceneloom.view; "
        "reported = [f for f in warnings.filters if f not in before[0] and 'encountered' in str(f[1])]; "
        "assert reported == [], reported; assert np.geterr() == before[1]"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
