"""Whatever a manifest and its files are made of: the folder opens as a scene, or fails with one of our errors."""

import functools
import json
import operator

import numpy as np
import pytest
from PIL import Image
from tests.malformed.damage import flipped, locations, replaced

from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats.rig.spec import FORMAT
from sceneloom.formats.rig.template import survey

LIDAR = {
    "id": "top",
    "type": "lidar",
    "files": "top/*.bin",
    "times": {"csv": "times.csv", "column": "t", "unit": "milliseconds"},
    "timestamp": "middle",
    "sweep_s": 0.1,
    "points_in": "base",
    "fields": ["x", "y", "z", "t:float32"],
    "point_times": {"field": "t", "unit": "seconds", "relative_to": "timestamp"},
    "intensity_max": 255,
    "use": {"ring": "t"},
    "extrinsic": {"to": "base", "translation": [1, 0, 2], "euler_deg": [0, 0, 90], "euler_order": "zyx"},
}
K = [[6, 0, 3.5], [0, 6, 2.5], [0, 0, 1]]
CAMERA = {
    "id": "front",
    "type": "camera",
    "files": "front/*.png",
    "times": {"pattern": "{index}", "rate_hz": 10, "start_s": 0.5},
    "axes": "-y,-z,+x",
    "time_offset_s": 0.001,
    "extrinsic": {"from": "base", "quaternion_wxyz": [1, 0, 0, 0]},
    "camera_model": {"K": K, "coefficients": [0.1, 0, 0, 0], "width": 8, "height": 6},
}
RIG = {
    "ego": "base",
    "transforms": [{"from": "imu", "to": "base", "matrix": np.eye(4).tolist()}],
    "sensors": [LIDAR, CAMERA, {"id": "imu", "type": "imu", "file": "imu.csv", "columns": {"ax": "ax"}}],
    "trajectories": [{"file": "poses.txt", "form": "tum", "frame": "imu", "world_axes": "optical"}],
}
VALUES = ["nan", "-1", "1e308", '"x"', '""', "[]", "{}", "[[1]]", "true", "2020-01-01", '"../x"']
FURTHER_VALUES = ["inf", "0", '"\\u0000"', "1" * 25, "[[[[1]]]]", '"["', '"**"', '"nan"', "[nan, nan, nan]"]


def as_toml(value):
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(k)} = {as_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(as_toml, value)) + "]"
    return value if isinstance(value, Raw) else json.dumps(value)


class Raw(str):
    """Text that stands in the file as it is."""

    __slots__ = ()


def misspelt(value, keys):
    """The value with one key that nobody knows."""
    holder = functools.reduce(operator.getitem, keys[:-1], value)
    changed = {f"{k}_x" if k == keys[-1] else k: v for k, v in holder.items()}
    return replaced(value, keys[:-1], changed) if len(keys) > 1 else changed


def write(folder, rig):
    (folder / "rig.toml").write_text("".join(f"{key} = {as_toml(value)}\n" for key, value in rig.items()))


@pytest.fixture
def folder(tmp_path):
    for name in ("top", "front"):
        (tmp_path / name).mkdir()
    for k in range(2):
        (tmp_path / "top" / f"{k}.bin").write_bytes(np.full((3, 4), 0.01 * (k + 1), "<f4").tobytes())
        Image.new("RGB", (8, 6)).save(tmp_path / "front" / f"{k}.png")
    (tmp_path / "times.csv").write_text("file,t\n0.bin,500\n1.bin,600\n")
    (tmp_path / "imu.csv").write_text("time,ax,ay,az\n0.5,1,2,3\n0.6,1,2,3\n")
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    write(tmp_path, RIG)
    return tmp_path


def read_everything(folder, *, lenient=False):
    """Open the folder and read all of it; report whether that went well."""
    try:
        scene = FORMAT.open(folder, lenient=lenient)
        for lidar in scene.lidars:
            assert all(np.isfinite(frame.points.positions).all() for frame in lidar.frames)
        for camera in scene.cameras:
            assert all(image.rgb.dtype == np.uint8 for image in camera.images)
    except SceneloomError:
        return False
    return True


@pytest.mark.parametrize("text", [*VALUES, *(pytest.param(v, marks=pytest.mark.slow) for v in FURTHER_VALUES)])
@pytest.mark.few(4)
def test_any_value_may_be_another(folder, text):
    for keys in locations(RIG):
        write(folder, replaced(RIG, keys, Raw(text)))
        read_everything(folder)


def test_any_key_may_be_missing_or_misspelt(folder):
    assert read_everything(folder)
    for keys in locations(RIG):
        write(folder, replaced(RIG, keys))
        read_everything(folder)
        if isinstance(keys[-1], str) and keys[-2:-1] not in [("columns",), ("use",)]:
            write(folder, misspelt(RIG, keys))
            assert not read_everything(folder), keys


@pytest.mark.parametrize("name", ["rig.toml", "times.csv", "imu.csv", "poses.txt", "front/0.png", "top/0.bin"])
@pytest.mark.parametrize("lenient", [False, True])
@pytest.mark.few(5)
def test_a_file_that_is_cut_or_has_a_byte_flipped_is_read_or_refused_and_looked_into(folder, name, lenient):
    content = (folder / name).read_bytes()
    for location in range(0, len(content), 1 if name.endswith(("csv", "txt")) else 3):
        for changed in (content[:location], flipped(content, location, 0x81)):
            (folder / name).write_bytes(changed)
            read_everything(folder, lenient=lenient)
    for changed in (b"", content[: len(content) // 2], b"\xff" * 40):
        (folder / name).write_bytes(changed)
        named = str(folder)
        try:
            survey(folder)
        except DataError as error:
            named = error.file
        assert named.startswith(str(folder))


@pytest.mark.parametrize("name", ["times.csv", "imu.csv", "poses.txt", "front/0.png", "top/0.bin", "front", "top"])
def test_a_file_that_is_missing_or_a_folder_is_refused(folder, name):
    (folder / name).rename(folder / "elsewhere")
    # a lidar's file is only one of those that the times name
    assert not read_everything(folder) or name == "front/0.png"
    (folder / name).mkdir()
    assert not read_everything(folder) or name == "front/0.png"
