"""Every verb on scenes that are odd: it is done, or one error says which file and what of it; never anything else."""

import io
import json
import re
import resource
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tests.unit.cli.conftest import verbs

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.cli.main import sceneloom as command_line
from sceneloom.db34t.json import format_json
from sceneloom.db34t.scene_objects import boxes_2d_record, boxes_3d_record
from sceneloom.formats.base.registry import written_formats
from sceneloom.service.running import running_server
from sceneloom.simulate import CameraSpec, LidarSpec, detect_2d, detect_3d, simulate_street

LARGEST = float(np.finfo(np.float32).max)
SECONDS = 60
"""After this long a verb hangs; each takes a fraction of a second."""
MEMORY = 3 << 30
"""How much more memory than before a verb may ask for [bytes of address space]; sound scenes take a hundredth."""

UNFORESEEN = r"Traceback|(Runtime|User|Rerun)Warning|(Value|Index|Type|Key|Overflow|Attribute|Memory|Assertion)Error"
"""What no output of a verb holds."""

Header = dict[str, Any]


def jpeg(width=48, height=32):
    pixels = np.random.default_rng(1).integers(0, 255, (height, width, 3), dtype=np.uint8)
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, "JPEG")
    return np.frombuffer(content.getvalue(), np.uint8)


def points(seed):
    rng = np.random.default_rng(seed)
    around = rng.uniform([2, -4, -1], [12, 4, 1], (60, 3)).astype(np.float32)
    return {
        "positions": around,
        "intensities": rng.integers(0, 255, 60).astype(np.uint8),
        "timestamps": np.linspace(0, 90_000, 60).astype(np.uint32) + seed * 100_000,
    }


def base():
    """A sound scene of two sweeps, two images, an odometry and annotations of most kinds."""
    times = [0, 100_000, 200_000]
    ego = [[0.5 * k, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0] for k in range(3)]
    seen = [[0.5 * k, 0.0, 0.5, -0.5, 0.5, -0.5, 0.5] for k in range(3)]
    row = [4.0, 2.0, 1.5, 8.0, 1.0, 0.0, 0.0, 0.0, 30.0]
    path = {"timestamps": [0, 200_000], "values": [row, [*row[:3], 9.0, *row[4:]]]}
    return {
        "version": "1.0",
        "sensors": [
            {
                "id": "lidar",
                "type": "lidar",
                "coordinates": "world",
                "poses": {"timestamps": times, "values": ego},
                "frames": [{"timestamp": 100_000 * k, "points": points(k)} for k in range(2)],
            },
            {
                "id": "camera",
                "type": "camera",
                "coordinates": "world",
                "poses": {"timestamps": times, "values": seen},
                "intrinsics": {"fx": 30.0, "fy": 30.0, "cx": 23.5, "cy": 15.5, "width": 48, "height": 32},
                "images": [{"timestamp": 50_000 + 100_000 * k, "content": jpeg()} for k in range(2)],
            },
            {"id": "ego", "type": "odometry", "poses": {"timestamps": times, "values": ego}},
        ],
        "annotations": [
            {"id": "car", "type": "cuboid", "label": "car", "stationary": False, "path": path},
            {
                "id": "flat",
                "type": "box_2d",
                "label": "car",
                "sensor_id": "camera",
                "stationary": False,
                "path": {"timestamps": [50_000], "values": [[3.0, 4.0, 10.0, 8.0]]},
            },
            {
                "id": "line",
                "type": "polyline",
                "label": "lane",
                "is_closed": False,
                "path": {"timestamps": [0], "values": [[4.0, 0.0, 0.0, 9.0, 1.0, 0.0]]},
            },
        ],
    }


def sensor(header, name):
    return next(found for found in header["sensors"] if found["id"] == name)


def cloud(header):
    """The points of the second sweep."""
    return sensor(header, "lidar")["frames"][1]["points"]


def cuboid(header):
    return header["annotations"][0]


ODD: dict[str, Callable[[Header], object]] = {}
"""What is odd about each scene; a function makes the sound one so."""
ODD["sound"] = lambda header: None


def odd(change):
    ODD[change.__name__] = change
    return change


def point_at(*xyz):
    return lambda header: cloud(header)["positions"].__setitem__(0, xyz)


ODD["one_far_point"] = point_at(1e30, 0, 0)
ODD["a_point_at_the_end_of_float32"] = point_at(LARGEST, -LARGEST, LARGEST)
ODD["a_subnormal_point"] = point_at(1e-45, 1e-45, 1e-45)
ODD["a_point_of_nan"] = point_at(np.nan, 0, 0)
ODD["a_point_of_infinity"] = point_at(np.inf, -np.inf, 0)
ODD["a_point_10_km_off"] = point_at(1e4, 0, 0)


def all_points_at(which, value):
    def change(header):
        for frame in sensor(header, "lidar")["frames"]:
            frame["points"]["positions"][which] = value

    return change


ODD["only_points_of_nan"] = all_points_at(slice(None), np.nan)


@odd
def all_points_at_the_end_of_float32(header):
    for frame in sensor(header, "lidar")["frames"]:
        frame["points"]["positions"][::2] = LARGEST
        frame["points"]["positions"][1::2] = -LARGEST


ODD["all_points_at_one_position"] = all_points_at(slice(None), 0)


def pose_of(name, value, row=1):
    def change(header):
        sensor(header, name)["poses"]["values"][row][0] = value

    return change


for _name in ("lidar", "camera", "ego"):
    for _value in (1e15, 1e300, 1.7e308):
        ODD[f"a_pose_of_{_name}_at_{_value:g}"] = pose_of(_name, _value)


@odd
def all_poses_at_1e15(header):
    for one in header["sensors"]:
        for row in one["poses"]["values"]:
            row[0] += 1e15


@odd
def poses_at_both_ends_of_float64(header):
    for one in header["sensors"]:
        one["poses"]["values"][0][0] = -1.7e308
        one["poses"]["values"][1][0] = 1.7e308


def all_poses(poses):
    return lambda header: [one.update(poses=poses(one["poses"])) for one in header["sensors"]]


ODD["one_pose"] = all_poses(lambda poses: {"timestamps": [0], "values": poses["values"][:1]})
ODD["no_poses"] = all_poses(lambda _: {"timestamps": [], "values": []})
ODD["a_quaternion_of_zeros"] = lambda h: sensor(h, "ego")["poses"]["values"][1].__setitem__(slice(3, None), [0.0] * 4)
ODD["no_sensors"] = lambda h: h.update(sensors=[], annotations=[])
ODD["only_annotations"] = lambda h: h.pop("sensors")
ODD["only_an_odometry"] = lambda h: h.update(sensors=[sensor(h, "ego")])
ODD["only_a_lidar"] = lambda h: h.update(sensors=[sensor(h, "lidar")])
ODD["only_a_camera"] = lambda h: h.update(sensors=[sensor(h, "camera")])
ODD["sensors_without_frames"] = lambda h: (sensor(h, "lidar").update(frames=[]), sensor(h, "camera").update(images=[]))
ODD["a_camera_without_images"] = lambda h: sensor(h, "camera").update(images=[])
ODD["a_lidar_without_frames"] = lambda h: sensor(h, "lidar").update(frames=[])


def frames_of(count, *, which):
    def change(header):
        for frame in sensor(header, "lidar")["frames"][which]:
            frame["points"] = {name: array[:count] for name, array in frame["points"].items()}

    return change


ODD["frames_without_points"] = frames_of(0, which=slice(None))
ODD["a_frame_without_points"] = frames_of(0, which=slice(1))
ODD["frames_of_one_point"] = frames_of(1, which=slice(None))


def nanoseconds(header, lidar_ns, camera_ns):
    header["time_unit"] = "nanoseconds"
    for frame, time in zip(sensor(header, "lidar")["frames"], lidar_ns, strict=True):
        frame["timestamp"] = time
        del frame["points"]["timestamps"]
    for image, time in zip(sensor(header, "camera")["images"], camera_ns, strict=True):
        image["timestamp"] = time
    for one in header["sensors"]:
        one["poses"]["timestamps"] = [lidar_ns[0], (lidar_ns[0] + lidar_ns[1]) // 2, lidar_ns[1]]
    cuboid(header)["path"]["timestamps"] = lidar_ns


def in_nanoseconds(lidar_ns, camera_ns=None):
    return lambda header: nanoseconds(header, lidar_ns, camera_ns or lidar_ns)


ODD["times_at_both_ends_of_int64"] = in_nanoseconds([-(2**63), 2**63 - 1])
ODD["times_at_the_upper_end_of_int64"] = in_nanoseconds([2**63 - 100_000_000, 2**63 - 1])
ODD["times_at_the_lower_end_of_int64"] = in_nanoseconds([-(2**63), -(2**63) + 100_000_000])
ODD["an_image_at_the_end_of_int64"] = in_nanoseconds([0, 100_000_000], [0, 2**63 - 1])


@odd
def an_annotation_at_the_ends_of_int64(header):
    header["time_unit"] = "nanoseconds"
    nanoseconds(header, [0, 100_000_000], [0, 100_000_000])
    cuboid(header)["path"]["timestamps"] = [-(2**63), 2**63 - 1]


ODD["times_beyond_int64"] = lambda h: sensor(h, "lidar")["frames"][1].update(timestamp=2**63)
ODD["a_time_offset_at_the_end_of_int64"] = lambda h: h.update(time_unit="nanoseconds", time_offset=2**63 - 1)


@odd
def equal_times(header):
    sensor(header, "lidar")["frames"][1]["timestamp"] = 0
    sensor(header, "camera")["images"][1]["timestamp"] = 50_000


@odd
def times_out_of_order(header):
    sensor(header, "lidar")["frames"].reverse()
    sensor(header, "camera")["images"].reverse()
    sensor(header, "ego")["poses"]["timestamps"].reverse()
    cuboid(header)["path"]["timestamps"].reverse()


ODD["point_times_out_of_the_sweep"] = lambda h: cloud(h).update(timestamps=np.full(60, 2**32 - 1, np.uint32))


def size_of_cuboid(*size):
    def change(header):
        for row in cuboid(header)["path"]["values"]:
            row[:3] = size

    return change


ODD["a_cuboid_of_no_size"] = size_of_cuboid(0, 0, 0)
ODD["a_cuboid_of_1e12_m"] = size_of_cuboid(1e12, 1e12, 1e12)
ODD["a_cuboid_of_1e300_m"] = size_of_cuboid(1e300, 1e300, 1e300)
ODD["a_cuboid_of_negative_size"] = size_of_cuboid(-4, -2, -1)
ODD["a_cuboid_as_thin_as_can_be"] = size_of_cuboid(5e-324, 4, 4)


def center_of_cuboid(column, *values):
    def change(header):
        for row, value in zip(cuboid(header)["path"]["values"], values, strict=True):
            row[column] = value

    return change


ODD["a_cuboid_at_1e15"] = center_of_cuboid(3, 1e15, 1e15)
ODD["a_cuboid_from_end_to_end_of_float64"] = center_of_cuboid(3, -1.7e308, 1.7e308)
ODD["a_cuboid_rotated_by_1e300"] = center_of_cuboid(8, 1e300, 0.0)
ODD["a_cuboid_rotated_by_1.7e308"] = center_of_cuboid(7, 1.7e308, 1.7e308)
ODD["a_cuboid_in_the_camera"] = center_of_cuboid(3, 0.0, 0.5)
ODD["a_cuboid_without_a_path"] = lambda h: cuboid(h).update(path={"timestamps": [], "values": []})


@odd
def huge_shapes(header):
    header["annotations"][1]["path"]["values"] = [[-1e300, -1e300, 1.7e308, 1.7e308]]
    header["annotations"][2]["path"]["values"] = [[-1.7e308, 0.0, 0.0, 1.7e308, 0.0, 0.0, 0.0, 1e15, 1.0]]


@odd
def shapes_of_no_size(header):
    header["annotations"][1]["path"]["values"] = [[3.0, 4.0, 0.0, 0.0]]
    header["annotations"][2]["path"]["values"] = [[4.0, 0.0, 0.0, 4.0, 0.0, 0.0]]


ODD["shapes_without_corners"] = lambda h: h["annotations"][2]["path"].update(values=[[]])


@odd
def keypoints_that_no_camera_sees(header):
    header["annotations"].append(
        {
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
    )


@odd
def a_keypoint_without_projections(header):
    keypoints_that_no_camera_sees(header)
    header["annotations"][-1]["projections"] = [[]]
    header["annotations"][-1]["paths"] = header["annotations"][-1]["paths"][:1]
    header["annotations"][-1]["labels"] = ["nose"]


@odd
def activations(header):
    row = cuboid(header)["path"]["values"][0]
    cuboid(header)["activations"] = [
        {"sensor_id": "lidar", "timestamps": [0, 100_000], "durations": [0, 2**53], "cuboids": [row, row]},
        {"sensor_id": "camera", "timestamps": [], "durations": []},
        {"sensor_id": "nobody", "timestamps": [0]},
    ]
    cuboid(header)["projections"] = [
        {"sensor_id": "camera", "timestamps": [50_000], "boxes": [[1e300, -1e300, 1e300, 1e300]], "confirmed": [True]}
    ]


@odd
def activations_at_the_ends_of_int64(header):
    header["time_unit"] = "nanoseconds"
    nanoseconds(header, [0, 100_000_000], [0, 100_000_000])
    cuboid(header)["activations"] = [
        {"sensor_id": "lidar", "timestamps": [-(2**63), 2**63 - 1], "durations": [2**63 - 1, 2**63 - 1]}
    ]


def corrected_by(shift, later):
    def change(header):
        poses = {"timestamps": [0], "values": [[shift, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]]}
        camera_model = deepcopy(sensor(header, "camera")["intrinsics"])
        header["annotations"] += [
            {
                "id": "mounted",
                "type": "camera_calibration",
                "sensor_id": "camera",
                "poses": poses,
                "intrinsics": camera_model,
                "time_offset": later,
            },
            {"id": "placed", "type": "localization_adjustment", "poses": poses},
        ]

    return change


ODD["corrections"] = corrected_by(0.1, 3)
ODD["corrections_by_1e15"] = corrected_by(1e15, 2**53)
ODD["corrections_by_1.7e308"] = corrected_by(1.7e308, -(2**53))


@odd
def a_correction_of_nobody(header):
    corrected_by(0.1, 3)(header)
    header["annotations"][-2]["sensor_id"] = "nobody"


@odd
def labelled_points_beyond_the_cloud(header):
    header["annotations"].append(
        {
            "id": "painted",
            "type": "labeled_points",
            "label": "road",
            "is_instance": False,
            "labeled_points": [
                {"sensor_id": "lidar", "sensor_frame": 1, "point_ids": np.array([0, 59, 4_000_000_000], np.uint32)}
            ],
        }
    )


@odd
def attributes_of_extreme_numbers(header):
    cuboid(header)["attributes"] = [
        {"name": "speed", "timestamps": [0, 100_000], "values": [1.7e308, -1.7e308]},
        {"name": "", "timestamps": [0], "values": [2**63]},
        {"name": "none", "timestamps": [], "values": []},
    ]


def camera_model_of(**fields):
    return lambda header: sensor(header, "camera")["intrinsics"].update(fields)


ODD["an_image_without_size"] = camera_model_of(width=0, height=0)
ODD["a_camera_model_of_a_huge_image"] = camera_model_of(width=1_000_000_000, height=1_000_000_000)
ODD["a_camera_model_without_focal_length"] = camera_model_of(fx=0.0, fy=0.0)
ODD["a_camera_model_of_1e300_px"] = camera_model_of(fx=1e300, fy=1e300)
ODD["a_camera_model_centred_at_1.7e308"] = camera_model_of(cx=1.7e308, cy=-1.7e308)
ODD["a_camera_model_of_huge_coefficients"] = camera_model_of(
    distortion={"model": "brown_conrady", "params": [1e300, 1e300, 1.0, 1.0, 1e300]}
)
ODD["a_fisheye_of_huge_coefficients"] = camera_model_of(
    distortion={"model": "fisheye", "params": [-1e300, 1e300, 1e10, 1e300]}
)
ODD["images_that_are_none"] = lambda h: sensor(h, "camera")["images"][1].update(content=np.zeros(0, np.uint8))


@odd
def images_of_one_pixel(header):
    for image in sensor(header, "camera")["images"]:
        image["content"] = jpeg(1, 1)
    sensor(header, "camera")["intrinsics"].update(width=1, height=1, cx=0.0, cy=0.0)


ODD["images_of_another_size"] = lambda h: sensor(h, "camera")["images"][1].update(content=jpeg(64, 8))


@odd
def ids_of_all_scripts(header):
    for one, name in zip(header["sensors"], ("激光雷达/..\\ \u202e", "\U0001f4f7\n", ""), strict=True):
        one["id"] = name
    cuboid(header).update(id="../../x", label="\u0000\u001b[31m машина")
    header["annotations"][1]["sensor_id"] = "\U0001f4f7\n"


@odd
def ids_without_letters(header):
    for one in header["sensors"]:
        one["id"] = {"lidar": "", "camera": " ", "ego": "."}[one["id"]]
    header["annotations"][1]["sensor_id"] = " "
    cuboid(header).update(id="", label="")


@odd
def ids_of_300_letters(header):
    for one in header["sensors"]:
        one["id"] = one["id"][0] * 300
    header["annotations"][1]["sensor_id"] = "c" * 300
    cuboid(header).update(id="x" * 300, label="y" * 300)


@odd
def ids_that_are_numbers(header):
    for number, one in enumerate(header["sensors"]):
        one["id"] = (2**63, -1, 0)[number]
    header["annotations"][1]["sensor_id"] = -1


@odd
def ids_twice(header):
    header["sensors"].append(deepcopy(sensor(header, "lidar")))
    header["annotations"].append(deepcopy(cuboid(header)))


@odd
def ids_that_differ_in_type_only(header):
    header["sensors"] += [{**deepcopy(sensor(header, "lidar")), "id": name} for name in (7, "7")]


@odd
def many_sensors_of_a_kind(header):
    header["sensors"] += [{**deepcopy(sensor(header, name)), "id": f"{name}2"} for name in ("lidar", "camera")]


@odd
def a_radar_and_a_map_at_the_ends_of_float32(header):
    ends = np.array([[LARGEST] * 3, [-LARGEST] * 3, [1.0, 2.0, 3.0]], np.float32)
    radar = {"positions": ends, "directions": ends, "lengths": np.array([LARGEST, -LARGEST, 0], np.float32)}
    poses = sensor(header, "lidar")["poses"]
    header["sensors"] += [
        {
            "id": "radar",
            "type": "radar",
            "coordinates": "world",
            "poses": poses,
            "frames": [{"timestamp": 0, "points": radar}],
        },
        {"id": "map", "type": "points", "points": {"positions": ends}},
    ]


@odd
def links_to_nobody(header):
    header["annotations"] += [
        {"id": "link", "type": "link", "label": "l", "from_id": "nobody", "to_id": "link", "is_bidirectional": True},
        {"id": "event", "type": "event", "label": "e", "start": -(2**53), "duration": 2**53},
        {"id": "group", "type": "group", "label": "g", "parent_id": "group"},
    ]


def spelled(value, where):
    def change(header):
        holder, key = where(header)
        holder[key] = {"nan": np.nan, "infinity": np.inf}[value]

    return change


for _value in ("nan", "infinity"):
    ODD[f"{_value}_in_a_pose"] = spelled(_value, lambda h: (sensor(h, "ego")["poses"]["values"][1], 0))
    ODD[f"{_value}_in_a_cuboid"] = spelled(_value, lambda h: (cuboid(h)["path"]["values"][0], 3))
    ODD[f"{_value}_in_a_camera_model"] = spelled(_value, lambda h: (sensor(h, "camera")["intrinsics"], "fx"))
    ODD[f"{_value}_in_a_time"] = spelled(_value, lambda h: (sensor(h, "lidar")["frames"][0], "timestamp"))


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
    "depth": ("DRIVE", "-o", "OUT", "--method", "quality", "--visualize", "OUT.drawn"),
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
    **{
        f"edit {name}": ("DRIVE", *SCENE)
        for name in ("deskew", "to-world", "to-ego", "to-sensor", "apply", "undistort")
    },
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

CODES = {
    "validate": {1},
    "diff": {1},
    "eval": {1},
    "sync": {1, 3},
    "calibrate": {1, 3, 4, 5},
    "batch": {1},
    "catalog": {1},
}
"""What verbs may end with beside 0 and an error."""


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


VERBS = dict(verbs(command_line))


def words_of(case):
    """The words of a verb in the name of its case."""
    return tuple(max((name for name in VERBS if case.split(" --")[0].startswith(name)), key=len).split())


def test_every_verb_that_reads_a_drive_is_tried_on_odd_scenes():
    tried = {" ".join(words_of(case)) for case in CASES}
    assert tried | WITHOUT_DRIVES == set(VERBS)
    assert not tried & WITHOUT_DRIVES


@pytest.fixture(scope="module")
def lists(tmp_path_factory):
    """What detectors reported, as files."""
    folder = tmp_path_factory.mktemp("lists")
    camera = CameraSpec(Camera("pinhole", 48, 32, 30.0, 30.0, 23.5, 15.5))
    drive = simulate_street(1, frames=2, lidar=LidarSpec(beams=8, steps=90), cameras=(camera,))
    for name, reports, record in (
        ("boxes3d.jsonl", detect_3d(drive), boxes_3d_record),
        ("boxes2d.jsonl", detect_2d(drive), boxes_2d_record),
    ):
        lines = [format_json(record(report.boxes, sensor_id=0, seq=k)) for k, report in enumerate(reports)]
        (folder / name).write_text("\n".join(lines))
    return {"BOXES3D": str(folder / "boxes3d.jsonl"), "BOXES2D": str(folder / "boxes2d.jsonl")}


@pytest.fixture(scope="module")
def address():
    with running_server() as server:
        yield server.address


def words_on(case, name, folder, encode_sfs, given):
    """The words of a case, for an odd scene beside a sound one."""
    header = base()
    (folder / "sound.sfs").write_bytes(encode_sfs(header))
    ODD[name](header)
    (folder / "drive.sfs").write_bytes(encode_sfs(header))
    given = {"DRIVE": folder / "drive.sfs", "SOUND": folder / "sound.sfs", **given}
    words = (given.get(word, word.replace("OUT", str(folder / "out"))) for word in CASES[case])
    return [*words_of(case), *words]


@pytest.fixture
def fault_of(call, encode_sfs, lists, address, tmp_path, inline):
    """Report what is wrong with the end of a verb on an odd scene; None where nothing is."""

    def run(case, name):
        folder = tmp_path / f"{len(list(tmp_path.iterdir()))}"
        folder.mkdir()
        words = words_on(case, name, folder, encode_sfs, {"ADDRESS": address, **lists})
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
        stated = outcome.err.splitlines()
        error = next((line for line in stated if line.startswith("sceneloom: ")), None)
        if error is not None and outcome.code in (1, 2):
            if outcome.code == 1 and "drive.sfs" not in error:
                return f"it names no file: {outcome}"
            return None
        if outcome.code == 0 or outcome.code in CODES.get(verb[0], ()):
            found = re.search(UNFORESEEN, outcome.out + outcome.err)
            return None if found is None else outcome.out + outcome.err
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


def drawn_pairs():
    """Each verb and each scene once, and what was found."""
    cases, names = list(CASES), list(ODD)
    count = max(len(cases), len(names))
    pairs = [(cases[k % len(cases)], names[k % len(names)]) for k in range(count)]
    return list(dict.fromkeys([*FOUND, *pairs]))


@pytest.mark.parametrize(("case", "name"), drawn_pairs())
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
    ("info --visualize", "a_cuboid_from_end_to_end_of_float64", "annotations", 4),
)


@pytest.mark.parametrize(("case", "name", "kind", "count"), LEFT_OUT)
@pytest.mark.few(5)
def test_what_an_image_or_a_view_cannot_show_is_counted(succeeds, encode_sfs, lists, tmp_path, case, name, kind, count):
    outcome = succeeds(*words_on(case, name, tmp_path, encode_sfs, lists), "--json")
    reported = json.loads(outcome.out)
    warnings = [*reported.get("warnings", ()), *(one for d in reported.get("drives", ()) for one in d["warnings"])]
    found = [one for one in warnings if one["code"] in {"not-drawn", "beyond-the-viewer"}]
    counted = {
        one["message"].split(" whose")[0] if one["location"] == "images" else one["location"]: one["count"]
        for one in found
    }
    assert counted[kind] == count
    assert "not finite" in found[0]["message"]


@pytest.mark.parametrize("case", ["view", "fuse", "info --visualize", "track"])
def test_of_a_sound_scene_nothing_is_left_out(succeeds, encode_sfs, lists, tmp_path, case):
    outcome = succeeds(*words_on(case, "sound", tmp_path, encode_sfs, lists))
    assert "finite" not in outcome.out + outcome.err


def test_a_report_says_how_many_points_are_not_drawn(succeeds, encode_sfs, tmp_path):
    header = base()
    ODD["a_point_of_nan"](header)
    (tmp_path / "drive.sfs").write_bytes(encode_sfs(header))
    succeeds("report", tmp_path / "drive.sfs", "-o", tmp_path / "page.html", "--quick")
    assert "points whose coordinates are not finite are not drawn" in (tmp_path / "page.html").read_text()


NO_NUMBERS = ("Infinity", "-Infinity", "NaN", "1e999")
TOKEN = "@" * 12
"""Stands where one of them goes; its length stays, and with it the offsets of what follows the header."""


def of_all_annotations():
    """The sound scene with every kind of annotation and most kinds of sensors."""
    header = base()
    header["time_offset"] = 0
    for name in (
        "keypoints_that_no_camera_sees",
        "activations",
        "corrections",
        "labelled_points_beyond_the_cloud",
        "attributes_of_extreme_numbers",
        "links_to_nobody",
        "a_radar_and_a_map_at_the_ends_of_float32",
    ):
        ODD[name](header)
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


def spelled_as(content, spelling):
    quoted = f'"{TOKEN}"'.encode()
    assert content.count(quoted) == 1
    return content.replace(quoted, spelling.encode().ljust(len(quoted)))


def test_what_is_no_finite_number_is_an_error_in_every_field_of_a_header(encode_sfs, tmp_path):
    header, path = of_all_annotations(), tmp_path / "drive.sfs"
    fields: dict[tuple[Any, ...], tuple[Any, ...]] = {}
    for location in numbers_in(header):
        if "attributes" in location and "values" in location:
            continue  # they are anything
        fields.setdefault(tuple(key for k, key in enumerate(location) if k == 1 or isinstance(key, str)), location)
    assert len(fields) > 40
    path.write_bytes(encode_sfs(header))
    known = {(one.rule, one.path) for one in sceneloom.validate(path, frames=False).findings}
    passed = {}
    for number, location in enumerate(fields.values()):
        spelling = NO_NUMBERS[number % len(NO_NUMBERS)]
        path.write_bytes(spelled_as(encode_sfs(with_token(header, location)), spelling))
        findings = sceneloom.validate(path, frames=False).findings
        new = [one for one in findings if one.severity == "error" and (one.rule, one.path) not in known]
        if not any(NUMBER.search(one.message) for one in new):
            passed[location] = spelling
    assert passed == {}


NUMBER = re.compile("finite|number|inf|nan|range", re.IGNORECASE)


@pytest.mark.slow
@pytest.mark.parametrize("spelling", NO_NUMBERS)
@pytest.mark.parametrize(("verb", "further"), [("validate", ()), ("info", ()), ("convert", ("OUT.sfs", "--overwrite"))])
def test_no_verb_breaks_on_what_is_no_finite_number(call, encode_sfs, tmp_path, verb, further, spelling):
    header, path = of_all_annotations(), tmp_path / "drive.sfs"
    words = [word.replace("OUT", str(tmp_path / "out")) for word in further]
    faults = {}
    for location in numbers_in(header):
        path.write_bytes(spelled_as(encode_sfs(with_token(header, location)), spelling))
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
        "import sceneloom, sceneloom.cli.main, sceneloom.batch.workers, sceneloom.view; "
        "reported = [f for f in warnings.filters if f not in before[0] and 'encountered' in str(f[1])]; "
        "assert reported == [], reported; assert np.geterr() == before[1]"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
