"""KITTI's text and lists of boxes, cut off and with letters flipped: read, or refused, and nothing else."""

import json
import random

import numpy as np
import pytest

from sceneloom.errors import SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.kitti.calibration import read_calibration
from sceneloom.formats.kitti.labels import read_labels
from sceneloom.formats.kitti.oxts import read_fields
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.detection_lists import ListContext, read_boxes_2d, read_boxes_3d
from sceneloom.pipeline.fusing_detections import read_fused
from sceneloom.scene import Poses
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
