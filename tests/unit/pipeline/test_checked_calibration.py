"""The check of a drive whose images state nothing, by boxes of synthetic cars, and by how camera and lidar rotate."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.calibrate.health import Verdict
from sceneloom.cameras.camera import Camera
from sceneloom.db34t.json import format_json
from sceneloom.db34t.scene_objects import boxes_2d_record, boxes_3d_record
from sceneloom.errors import OptionError
from sceneloom.geometry.boxes import CORNER_SIGNS
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.calibrating import check_drive
from sceneloom.pipeline.detected_drive import poses_at
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.ego import sensor_source
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

CAMERA_MODEL = Camera("pinhole", 640, 320, 360.0, 360.0, 319.5, 159.5)
SIZE = np.array([4.2, 1.8, 1.5])


@pytest.fixture(scope="module")
def drive():
    """A lidar of few beams and a camera.

    Whose images are of another camera model than the one that boxes are made for.
    """
    return simulate_street(
        2, frames=14, lidar=LidarSpec(beams=4, steps=60), cameras=(CameraSpec(CAMERA_MODEL),)
    )


def lists(scene, folder, rotation_deg):
    """Boxes of five cars in each sweep and image; the camera really is rotated from where it is stated to be."""
    lidar, camera = scene.lidars[0], scene.cameras[0]
    times = [frame.reference_ns for frame in lidar.frames]
    timestamps = camera.images.timestamps_ns.tolist()
    sources = [sensor_source(scene, sensor, None, reach_ns=10**9) for sensor in (lidar, camera)]
    locations = poses_at(sources[0], np.array(times)), poses_at(sources[1], np.array(timestamps))
    generator, rotation = np.random.default_rng(5), Rotation.from_rotvec(rotation_deg, degrees=True)
    lines = {"boxes3d": [], "boxes2d": []}
    for k, (time, timestamp) in enumerate(zip(times, timestamps, strict=True)):
        ahead = generator.uniform(12.0, 30.0, 5)
        centers = np.column_stack(
            [ahead, ahead * generator.uniform(-0.5, 0.5, 5), generator.uniform(-1, 0, 5)]
        )
        corners = centers[:, None] + CORNER_SIGNS * SIZE / 2
        seen = rotation.apply((locations[1][k].inverse() @ locations[0][k]).apply(corners.reshape(-1, 3)))
        pixels = (seen[:, :2] / seen[:, 2:] * 360.0 + [319.5, 159.5]).reshape(5, 8, 2) + 0.5
        boxes = np.hstack([pixels.min(axis=1), pixels.max(axis=1)])
        three = Boxes3D(time, centers, np.tile(SIZE, (5, 1)), np.zeros(5), np.ones(5), ("Car",) * 5)
        two = Boxes2D(timestamp, boxes, np.ones(5), ("Car",) * 5)
        lines["boxes3d"].append(format_json(boxes_3d_record(three, sensor_id=0, seq=k)))
        lines["boxes2d"].append(format_json(boxes_2d_record(two, sensor_id=0, seq=k)))
    for name, texts in lines.items():
        (folder / f"{name}.jsonl").write_text("\n".join(texts))
    return {"boxes_3d": [folder / "boxes3d.jsonl"], "boxes_2d": [folder / "boxes2d.jsonl"]}


@pytest.mark.parametrize(
    ("rotation_deg", "verdict"), [((0.0, 0.0, 0.0), Verdict.GOOD), ((2.0, -1.0, 0.0), Verdict.WRONG)]
)
def test_boxes_report_what_images_cannot(drive, tmp_path, rotation_deg, verdict):
    health = check_drive(drive.scene, most=2, **lists(drive.scene, tmp_path, rotation_deg)).health
    assert health.item("rotation").verdict is Verdict.UNDETERMINED
    assert health.verdict is verdict
    # boxes of whole pixels, at 6 pixels a degree; a sigma is 0.12
    np.testing.assert_allclose(health.item("boxes").values, rotation_deg[:2], atol=0.2)


def test_a_part_of_the_drive_is_judged_by_its_own_boxes(drive, tmp_path):
    found = lists(drive.scene, tmp_path, (2.0, -1.0, 0.0))
    health = check_drive(drive.scene, most=2, stop=0.5, **found).health
    # five images are too few
    assert health.item("boxes").verdict is Verdict.UNDETERMINED


def test_boxes_of_one_kind_are_refused(drive, tmp_path):
    found = lists(drive.scene, tmp_path, (0.0, 0.0, 0.0))
    with pytest.raises(OptionError, match="boxes of images alone"):
        check_drive(drive.scene, boxes_2d=found["boxes_2d"])


@pytest.mark.parametrize(("tilt_deg", "verdict"), [(0.0, Verdict.GOOD), (8.0, Verdict.WRONG)])
@pytest.mark.few(1)
def test_a_drive_that_rotations_reports_a_camera_that_is_tilted(tilt_deg, verdict):
    camera_model = Camera("pinhole", 320, 120, 180.0, 180.0, 159.5, 59.5)
    scene = simulate_street(
        2, frames=30, lidar=LidarSpec(beams=4, steps=60), cameras=(CameraSpec(camera_model),)
    ).scene
    (camera,) = scene.cameras
    tilt = RigidTransform(Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix(), np.zeros(3))
    tilted = replace(camera, mount=camera.mount @ tilt)
    scene = replace(scene, sensors=tuple(tilted if one is camera else one for one in scene.sensors))
    item = check_drive(scene, most=1, motion=True).health.item("motion")
    assert item.verdict is verdict
    # twice what the measure gets wrong by itself, the sign that of the change that puts it right
    np.testing.assert_allclose(item.values, [tilt_deg, 0.0], atol=1.0)
