"""Mutants of drives, many of each format: a scene or an error of ours, in bounded time and memory."""

import sys
from contextlib import suppress

import numpy as np
import pytest
from tests.malformed.mutants import (
    ALL_DRIVES,
    DRIVES,
    OTHER_DRIVES,
    STRANGERS,
    kinds_of_files,
    mutant_of,
    read,
    try_mutants,
)

from sceneloom.detections.settings import read_detectors
from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats import open_scene
from sceneloom.service.running import read_configuration_file

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="memory of processes is bounded on Linux only")

FEW, MANY = 8, 2000
GUARDED = "mcap lz4"
"""A drive of packed chunks with checksums, which few changes get by."""
ALWAYS = {"openlabel", "recording", "mcap"}
"""Drives whose files are replaced in the usual run; the others follow in the long one."""


@on_linux
@pytest.mark.few(7)
@pytest.mark.parametrize("name", DRIVES)
def test_a_mutant_of_a_drive_gives_a_scene_or_an_error_of_ours(name):
    tried = try_mutants(name, range(FEW))
    assert not tried.failures, str(tried)
    assert sum(tried.outcomes.values()) == FEW


@on_linux
@pytest.mark.slow
@pytest.mark.parametrize("name", DRIVES)
def test_many_mutants_of_a_drive_give_a_scene_or_an_error_of_ours(name):
    tried = try_mutants(name, range(FEW, FEW + MANY), seconds=110)
    assert not tried.failures, str(tried)
    assert set(tried.outcomes) == {"scene", "refused"} - ({"scene"} if name == GUARDED else set())


@on_linux
@pytest.mark.slow
@pytest.mark.parametrize("name", STRANGERS)
def test_many_mutants_of_files_of_others_give_a_scene_or_an_error_of_ours(name, data_dir):
    if not (data_dir / "real" / "strangers").is_dir():
        pytest.skip("no files of others beside the real data")
    tried = try_mutants(name, range(MANY), seconds=110)
    assert not tried.failures, str(tried)


@on_linux
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in ALWAYS else pytest.mark.slow)
        for name in DRIVES | OTHER_DRIVES
        if " " not in name
    ],
)
def test_what_is_no_file_and_what_is_static_in_the_position_of_any_file_is_refused_and_never_waited_for(name):
    if name == "argoverse2":
        pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    tried = try_mutants(name, None)
    assert not tried.failures, str(tried)
    assert tried.outcomes["refused"]


LONG = "9" * 5000
DEEP = "[" * 100_000 + "]" * 100_000


def test_texts_with_infinite_numbers_and_depths_or_of_other_letters_are_faults_of_the_file(tmp_path):
    path = tmp_path / "file.toml"
    for text in (f"a = {LONG}", f"a = {DEEP}", f"[{'a.' * 20_000}a]"):
        path.write_text(text)
        for reader in (read_detectors, read_configuration_file, lambda path: open_scene(path, format="rig")):
            with pytest.raises(SceneloomError):
                reader(path)
    root = ALL_DRIVES["nuscenes"](tmp_path)
    (root / "v1.0-mini" / "sensor.json").write_bytes(b'[{"token": "\xe7"}]')
    with pytest.raises(SceneloomError, match=r"sensor.json: is no JSON"):
        open_scene(root)


def test_metadata_of_a_bag_with_infinite_numbers_and_depths_are_faults_of_the_file(tmp_path):
    pytest.importorskip("ruamel.yaml", reason="ruamel.yaml is not installed")
    drive = ALL_DRIVES["ros2"](tmp_path)
    for text in (f"rosbag2_bagfile_information: {LONG}", "- " * 20_000, f"a: {DEEP[:20_000]}"):
        (drive / "metadata.yaml").write_text(text)
        with pytest.raises(DataError, match=r"metadata.yaml: cannot be read"):
            open_scene(drive, format="ros2")


FOLDERS = ["kitti-raw", "kitti-object", "kitti-tracking", "kitti-odometry", "nuscenes", "argoverse2", "pandaset"]
FOLDERS += ["scale-toolkit", "euroc-mav"]


@pytest.mark.parametrize("count", [1, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FOLDERS)
def test_a_file_of_each_kind_that_is_changed_empty_or_gone_is_a_fault_or_does_no_harm(name, count, tmp_path):
    if name == "argoverse2":
        pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    drive, chance = ALL_DRIVES[name](tmp_path), np.random.default_rng(4)
    for file, *_ in kinds_of_files(drive):
        whole = file.read_bytes()
        changed = [mutant_of(whole, chance) for _ in range(count)]
        for content in (whole[: int(chance.integers(len(whole) + 1))], *changed, b"", None):
            file.unlink() if content is None else file.write_bytes(content)
            for lenient in (False, True):
                with suppress(SceneloomError):
                    read(drive, name, lenient=lenient)
        file.write_bytes(whole)
    read(drive, name)


def test_a_feather_file_whose_texts_lead_beyond_its_end_is_refused(tmp_path):
    pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    root = ALL_DRIVES["argoverse2"](tmp_path)
    path = root / "calibration" / "egovehicle_SE3_sensor.feather"
    whole = pa.feather.read_table(str(path))
    offsets = pa.py_buffer(np.array([0, 8, 1 << 30, 35], np.int32).tobytes())
    names = pa.StringArray.from_buffers(3, offsets, pa.py_buffer(b"up_lidar" * 5))
    pa.feather.write_feather(whole.set_column(0, "sensor_name", names), str(path), compression="uncompressed")
    with pytest.raises(SceneloomError, match=r"is no whole feather file"):
        open_scene(root)
