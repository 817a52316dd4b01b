"""Texts cut off and with letters changed (KITTI's, lists of boxes, trajectories, OpenLABEL): read, or refused."""

import itertools
import json
import random
import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.malformed.damage import STRANGE, locations, replaced

from sceneloom.errors import SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.kitti.calibration import read_calibration
from sceneloom.formats.kitti.labels import read_labels
from sceneloom.formats.kitti.oxts import read_fields
from sceneloom.formats.openlabel.spec import FORMAT
from sceneloom.formats.trajectories.table import TRAJECTORY_FORMS, read_trajectory_file, write_trajectory
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.detection_lists import ListContext, read_boxes_2d, read_boxes_3d
from sceneloom.pipeline.fusing_detections import read_fused
from sceneloom.scene import Poses, Trajectory
from sceneloom.scene.poses import PoseSource

CONTEXT = ListContext(
    "lidar",
    np.arange(3, dtype=np.int64) * 100_000_000,
    source=PoseSource(Poses.identity(), RigidTransform.identity()),
    sensor_from_camera=RigidTransform.identity(),
    label="Car",
)
RECORD = {"id": 3, "class": "Car", "points_seq": 1, "confidence": 0.5, "timestamp": "0.100000000", "velocity": -3.0}
RECORD |= {"X": 10.0, "Y": 1.0, "Z": -0.5, "length": 4.0, "width": 2.0, "height": 1.5, "direction": [0.0, 2.0, 0.0]}
NUSCENES = {"translation": [5, 11, 1], "size": [2, 4, 1.5], "rotation": [1, 0, 0, 0], "velocity": [0, 3]}
NUSCENES |= {"detection_name": "car", "detection_score": 0.4}
IDS = {"image_seq": 1, "points_seq": 1, "camera_id": 1, "lidar_id": 0}
FUSED = json.dumps({"detections": {"timestamp": "0.100000000", **IDS, "detections": []}})
SIDE = {
    "timestamp_ns": 100_000_000,
    "image_timestamp_ns": 100_000_000,
    "lidar": "l",
    "camera": "c",
    "world_from_lidar": [0, 0, 0, 0, 0, 0, 1],
    "world_from_camera": [0, 0, 0, 0, 0, 0, 1],
    "camera_model": {"model": "pinhole", "size_wh": [9, 9], "fx_fy_cx_cy": [9, 9, 4, 4], "coefficients": []},
}


def boxes_3d(path):
    return read_boxes_3d(path, CONTEXT, Ledger(lenient=False))


def boxes_2d(path):
    return read_boxes_2d(path, CONTEXT, Ledger(lenient=False))


def fused(path):
    """The file of results stays whole; the one beside it is what is damaged."""
    path.with_name("fused.frames.jsonl").write_bytes(path.read_bytes())
    path.with_name("fused.jsonl").write_text(FUSED)
    return read_fused(path.with_name("fused.jsonl"))


GOOD = {
    "labels": (read_labels, "0 3 Car 0 1 -1.5 10 20 30 40 1.5 1.6 4.0 2.0 1.5 10.0 0.25\n"),
    "objects": (read_labels, "Car 0.5 1 -1.5 10 20 30 40 1.5 1.6 4.0 2.0 1.5 10.0 0.25 0.5\n"),
    "calibration": (
        read_calibration,
        "P2: 7 0 6 1 0 7 2 1 0 0 1 0\nR_rect 1 0 0 0 1 0 0 0 1\nTr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0\n",
    ),
    "oxts": (read_fields, "49.5 8.25 110" + " 0.5" * 27 + "\n"),
    "list 3d": (boxes_3d, "1,2,0,0,9,9,-1.5,1.5,1.6,4.0,2.0,1.5,10.0,0.0,0.2\n"),
    "list 2d": (boxes_2d, "0,10,20,30,40,0.5\n"),
    "json lines": (boxes_3d, json.dumps(RECORD)),
    "nuscenes": (boxes_3d, json.dumps({"results": {"100000": [NUSCENES]}})),
    "fused": (fused, json.dumps(SIDE)),
}


@pytest.mark.parametrize("kind", GOOD)
def test_a_whole_file_is_read_and_a_damaged_one_read_or_refused(tmp_path, kind):
    read, text = GOOD[kind]
    path, whole, dice = tmp_path / "0001.txt", text.encode(), random.Random(7)
    path.write_bytes(whole)
    read(path)
    damaged, refused = [whole[:k] for k in range(0, len(whole), 3)], 0
    for k in dice.choices(range(len(whole)), k=120):
        byte = dice.choice([b"x", b"-", b"nan", b"e9", b"\xff", b"\0", b" ", b",", b"\n", b"{"])
        damaged.append(whole[:k] + byte + whole[k + 1 :])
    for content in damaged:
        path.write_bytes(content)
        try:
            read(path)
        except SceneloomError:
            refused += 1
    assert refused > len(damaged) // 10  # the damage is such that much of it shows


FORMS = sorted(TRAJECTORY_FORMS)


def written(form: str) -> bytes:
    timestamps = np.arange(3, dtype=np.int64) * 100_000_000
    half = np.sqrt(0.5)
    rotations = np.array([[0.0, 0, 0, 1], [0, 0, half, half], [0.5, -0.5, 0.5, -0.5]])
    trajectory = Trajectory("trajectory", timestamps, np.arange(9.0).reshape(3, 3) / 7, rotations)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "trajectory.txt")
        write_trajectory(trajectory, path, form=form, origin_lla=(49.0, 8.0, 100.0))
        return path.read_bytes()


def read_trajectory_or_refuse(content: bytes, form: str | None, suffix: str, *, lenient: bool) -> None:
    """Read a file; what is read is fit to be computed with."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"trajectory{suffix}")
        path.write_bytes(content)
        try:
            trajectory = read_trajectory_file(path, form=form, rate_hz=10.0, lenient=lenient).trajectory
        except SceneloomError:
            return
    assert (np.diff(trajectory.timestamps_ns) > 0).all()
    assert np.isfinite(trajectory.positions).all()
    if trajectory.quaternions_xyzw is not None:
        assert (np.abs(np.linalg.norm(trajectory.quaternions_xyzw, axis=1) - 1) <= 0.011).all()


@pytest.mark.parametrize("form", FORMS)
def test_a_trajectory_cut_anywhere_or_with_a_first_number_that_is_none_is_read_or_refused(form: str) -> None:
    whole = written(form)
    for length in range(0, len(whole), 3):
        read_trajectory_or_refuse(whole[:length], form, ".txt", lenient=False)
    for number, count, delimiter in itertools.product(("nan", "inf", "-inf", "1e400"), (4, 8, 12, 17), ", "):
        row = delimiter.join([number, *["1"] * (count - 1)])  # the first number is none
        read_trajectory_or_refuse(f"{row}\n".encode(), None, ".txt", lenient=False)


@pytest.mark.parametrize("form", FORMS)
@settings(max_examples=60)
@given(data=st.data())
@pytest.mark.few(2)
def test_a_trajectory_with_other_bytes_or_any_bytes_at_all_is_read_or_refused(form: str, data: st.DataObject) -> None:
    content = bytearray(written(form))
    for _ in range(data.draw(st.integers(1, 4))):
        location = data.draw(st.integers(0, len(content) - 1))
        content[location] = data.draw(st.integers(0, 255) | st.sampled_from(b' ,;\n"eE-.{}[]#9'))
    if data.draw(st.integers(0, 4)) == 0:
        content = data.draw(st.binary(max_size=200))
    named = data.draw(st.booleans())
    suffix = data.draw(st.sampled_from([".txt", ".csv", ".jsonl", ".tum", ".kitti"]))
    read_trajectory_or_refuse(bytes(content), form if named else None, suffix, lenient=data.draw(st.booleans()))


GOLDEN = Path(__file__).parents[1] / "interop" / "golden" / "openlabel_vcd.json"


@pytest.mark.parametrize("seed", range(2))
def test_openlabel_whose_parts_are_exchanged_or_cut_off_gives_a_scene_or_an_error_of_ours(tmp_path, seed):
    text, path = GOLDEN.read_text(), tmp_path / "strange.json"
    for stop in range(30 + seed, len(text) - 2, 3994):
        path.write_text(text[:stop])
        with pytest.raises(SceneloomError, match="is no JSON"):
            FORMAT.open(path)
    content = json.loads(text)
    # what only we write besides, so that it is exchanged, too
    content["openlabel"]["metadata"]["sceneloom"] = {
        "object": {"0": {"id": "a", "stationary": True}, "1": {"id": 5, "shape": "polygon", "extras": {"b": 1}}},
        "event": {"0": {"id": "e", "start_ns": 5, "duration_ns": None}},
        "trajectory": "trajectory",
        "metadata": {"city": "x"},
    }
    choice = random.Random(seed)
    everywhere = list(locations(content))
    for _ in range(25):
        strange = choice.choice([*STRANGE, 0, 1e308, 10**17, [1, 2], ["a"], [[1]]])
        path.write_text(json.dumps(replaced(content, choice.choice(everywhere), strange)))
        for lenient in (False, True):
            with suppress(SceneloomError):
                FORMAT.open(path, lenient=lenient)
