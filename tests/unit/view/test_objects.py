"""Fused detections, tracks and fused depth images in a saved view."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation
from tests.properties.injected import SHOTS, TIMES

from sceneloom.cameras.camera import Camera
from sceneloom.detections.results import FusedBoxes
from sceneloom.errors import DataError
from sceneloom.formats.base.images import write_depth_image
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.tracking import track_lines
from sceneloom.scene import Support, TrackedObjects
from sceneloom.view.objects import ellipsoid
from sceneloom.visualization.objects import objects_of_fused

COVARIANCE = np.array([[0.5, 0.2, 0.0], [0.2, 0.3, 0.05], [0.0, 0.05, 0.1]])


def objects(k, ids=(4, 9)):
    """Two objects at the time of sweep k, the second one seen by the left camera."""
    covariances = np.zeros((2, 10, 10))
    covariances[:, :3, :3] = COVARIANCE
    return TrackedObjects(
        timestamp_ns=int(TIMES[k]),
        ids=np.array(ids),
        labels=("car", "pedestrian"),
        centers=np.array([[10.0 + k, 2.0, 0.5], [5.0, -3.0, 0.9]]),
        sizes_lwh=np.array([[4.0, 1.8, 1.5], [0.6, 0.5, 1.8]]),
        yaws=np.array([0.3, -1.2]),
        velocities=np.array([[10.0, 0.0, 0.0], [0.0, 0.0, 0.0]]),
        yaw_rates=np.zeros(2),
        covariances=covariances,
        scores=np.array([0.9, 0.4]),
        supports=np.array([Support.BOTH, Support.IMAGE], np.uint8),
        corners_xyxy={"left": np.array([[np.nan] * 4, [10.0, 12.0, 20.0, 30.0]])},
    )


def covariance_of(saved, path):
    """What the first ellipsoid of an entity says."""
    reported = saved.timed(path, "Ellipsoids3D:half_sizes")[0]
    rotation = Rotation.from_quat(reported.array("Ellipsoids3D:quaternions")[0]).as_matrix()
    squares = reported.array("Ellipsoids3D:half_sizes")[0] ** 2 / stats.chi2.ppf(0.95, 3)
    return rotation @ np.diag(squares) @ rotation.T


def test_tracks_are_boxes_with_ellipsoids_in_the_world_and_in_images(save, injected, tmp_path):
    file = tmp_path / "tracks.jsonl"  # as `track` writes it of three sweeps
    file.write_bytes(b"\n".join(track_lines([objects(k) for k in range(3)])) + b"\n")
    saved = save(injected, tracks=file)
    rows = saved.timed("/injected/world/tracks/boxes", "Boxes3D:centers")
    assert [row.time_ns for row in rows] == TIMES.tolist()
    assert np.allclose(rows[1].array("Boxes3D:centers"), [[11.0, 2.0, 0.5], [5.0, -3.0, 0.9]])
    assert np.allclose(Rotation.from_quat(rows[1].array("Boxes3D:quaternions")).as_euler("xyz")[:, 2], [0.3, -1.2])
    assert rows[1].values["Boxes3D:labels"] == ["car 4", "pedestrian 9"]
    assert rows[1].values["support"] == ["both", "image"]
    assert np.allclose(covariance_of(saved, "/injected/world/tracks/certainty"), COVARIANCE, atol=1e-6)
    seen = saved.timed("/injected/world/sensors/left/image/tracks", "Boxes2D:half_sizes")[0]
    assert np.allclose(seen.array("Boxes2D:centers"), [[15.0, 21.0]])
    assert np.allclose(seen.array("Boxes2D:half_sizes"), [[5.0, 9.0]])
    history = saved.timed("/injected/world/tracks/history", "LineStrips3D:strips")[2].values["LineStrips3D:strips"]
    assert np.allclose(history[0], [[10.0, 2.0, 0.5], [11.0, 2.0, 0.5], [12.0, 2.0, 0.5]])


def test_an_ellipsoid_has_the_axes_of_its_covariance():
    random = np.random.default_rng(3)
    matrices = random.normal(size=(20, 3, 3))
    covariances = matrices @ np.swapaxes(matrices, 1, 2)
    half_sizes, rotations = ellipsoid(covariances)
    axes = Rotation.from_quat(rotations).as_matrix()
    inside = stats.chi2.ppf(0.95, 3)
    made = axes @ (half_sizes[:, :, None] ** 2 / inside * np.swapaxes(axes, 1, 2))
    assert np.allclose(made, covariances)


def test_fused_detections_are_shown_where_the_lidar_was(save, injected, tmp_path, monkeypatch):
    fused = FusedBoxes(
        timestamp_ns=int(TIMES[1]),
        centers=np.array([[8.0, 0.0, 0.0]]),
        center_covariances=COVARIANCE[None],
        sizes_lwh=np.array([[4.0, 2.0, 1.5]]),
        size_covariances=np.eye(3)[None],
        yaws=np.array([0.0]),
        velocities=None,
        scores=np.array([0.8]),
        labels=("car",),
        corners_xyxy=np.array([[1.0, 2.0, 3.0, 4.0]]),
        **{name: np.array([0]) for name in ("ids", "rows_3d", "rows_2d")},
    )
    lidar = RigidTransform(Rotation.from_euler("z", 0.5).as_matrix(), np.array([3.0, 1.0, 0.0]))
    shown = objects_of_fused(fused, "left", world_from_lidar=lidar)
    monkeypatch.setattr("sceneloom.view.objects._read_detections", lambda path: (shown,))
    saved = save(injected, detections=tmp_path / "any")
    row = saved.timed("/injected/world/detections/left/boxes", "Boxes3D:centers")[0]
    assert np.allclose(row.array("Boxes3D:centers")[0], lidar.apply(fused.centers)[0], atol=1e-6)
    expected = lidar.rotation @ COVARIANCE @ lidar.rotation.T
    assert np.allclose(covariance_of(saved, "/injected/world/detections/left/certainty"), expected, atol=1e-6)


def test_a_file_of_another_kind_is_reported(save, injected, tmp_path):
    file = tmp_path / "other.jsonl"
    for option, text, reported in (
        ("tracks", b'{"timestamp_ns": 1, "objects": [{}]}\n', "line 1"),
        ("tracks", b"\xff\xfe\n", "line 1"),
        ("detections", b'{"something": "else"}\n', "fuse --type detection"),
    ):
        file.write_bytes(text)
        with pytest.raises(DataError, match=reported):
            save(injected, **{option: file})


def test_fused_depths_lie_over_their_images(save, injected, tmp_path):
    camera_model = Camera("pinhole", 64, 48, 50.0, 51.0, 31.0, 24.0)
    camera = replace(injected.cameras[0], camera=camera_model)
    depths = (np.arange(48 * 64, dtype=np.float32).reshape(48, 64) % 700) / 16
    folder = tmp_path / "depth"
    folder.mkdir()
    write_depth_image(depths, folder / "000001.png")
    line = {"file": "000001.png", "lidar": "top", "sweep_ns": int(TIMES[1]), "camera": "left"}
    (folder / "index.jsonl").write_text(json.dumps({**line, "image_ns": int(SHOTS[1])}) + "\n")
    saved = save(replace(injected, sensors=(camera,), annotations=()), depth=folder)
    row = saved.timed("/injected/world/sensors/left/image/depth", "DepthImage:buffer")[0]
    steps = np.frombuffer(bytes(row.values["DepthImage:buffer"][0]), np.uint16).reshape(48, 64)
    assert row.time_ns == SHOTS[1]
    assert np.array_equal(steps / 256, depths)
    with pytest.raises(DataError, match=r"index\.jsonl"):
        save(injected, depth=tmp_path)
