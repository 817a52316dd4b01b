"""Tasks of tools that label point clouds, in the hands of these tools' own packages.

`SCENELOOM_SUPERVISELY_PYTHON` names a Python that has `supervisely`, `SCENELOOM_SEGMENTS_PYTHON` one that has
`segments-ai`.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.peers import python_with
from tests.unit.formats.cloud_labelling.test_round_trips import UUID_KEY, street

from sceneloom.formats import open_scene, write_scene
from sceneloom.scene import LabeledPoints, LabeledPointsAnnotation

PROGRAMS = Path(__file__).parent / "programs"
NEAR = 1e-6


@pytest.fixture(scope="module")
def scene():
    found = street()
    points = LabeledPoints(found.lidars[0].id, np.array([1, 4], np.uint32), 1)
    return replace(found, annotations=(*found.annotations, LabeledPointsAnnotation("road", (points,), "Road")))


@pytest.mark.parametrize("project", ["episodes", "clouds"])
def test_supervisely_has_the_cuboids_tags_points_and_calibrations_that_were_written(scene, project, tmp_path, ask):
    python = python_with("supervisely", "SCENELOOM_SUPERVISELY_PYTHON")
    write_scene(scene, tmp_path / "project", format="supervisely", project=project)
    reported = ask(python, (PROGRAMS / "supervisely_read.py").read_text("utf-8"), tmp_path / "project", project)
    assert reported["classes"]["Road"] == "point_cloud"
    (found,) = reported["datasets"].values()
    read = open_scene(tmp_path / "project")
    assert found["names"] == [f"{time:019d}.pcd" for time in read.lidars[0].frames.timestamps_ns.tolist()]
    for sample, rows in zip(read.samples(), found["frames"], strict=True):
        cuboids = [row for row in rows if "position" in row]
        assert len(cuboids) == len(sample.boxes) > 0
        for row in cuboids:
            # their box looks along y; x, y and z are width, length and height
            forward = Rotation.from_euler("XYZ", row["rotation"]).apply([0, 1, 0])
            away = np.linalg.norm(sample.boxes.centers_world - row["position"], axis=1)
            k = int(np.argmin(away))
            assert away[k] < NEAR
            np.testing.assert_allclose(sample.boxes.rotations_world[k][:, 0], forward, atol=NEAR)
            np.testing.assert_allclose(sample.boxes.sizes_lwh[k], np.array(row["dimensions"])[[1, 0, 2]], atol=NEAR)
            assert (row["object"] == UUID_KEY) == (sample.boxes.ids[k] == UUID_KEY)
    assert [row["indices"] for row in found["frames"][1] if "indices" in row] == [[1, 4]]
    if project == "episodes":
        tags = {(name, str(value)): span for name, value, span in found["tags"][UUID_KEY]}
        assert tags == {("moving", "true"): [0, 1], ("moving", "false"): [2, 2], ("speed", "1.5"): None}
    data = next(iter(found["images"].values()))["sensorsData"]
    assert np.array(data["intrinsicMatrix"]).reshape(3, 3)[0, 0] == read.cameras[0].camera.fx
    assert len(data["extrinsicMatrix"]) == 12


@pytest.mark.parametrize("task", ["cuboids", "segmentation"])
def test_the_models_of_segments_hold_all_that_is_written(scene, task, tmp_path, ask):
    python = python_with("segments-ai", "SCENELOOM_SEGMENTS_PYTHON")
    write_scene(scene, tmp_path / "release", format="segments", task=task)
    program = (PROGRAMS / "segments_read.py").read_text("utf-8")
    reported = ask(python, program, tmp_path / "release" / "release.json")
    read = open_scene(tmp_path / "release")
    names = {category["id"]: category["name"] for category in reported["task"]["categories"]}
    frames, labels = reported["sample"]["frames"], reported["label"]["frames"]
    for sample, frame, label in zip(read.samples(), frames, labels, strict=True):
        assert frame["timestamp"] == sample.timestamp_ns
        position = [frame["ego_pose"]["position"][axis] for axis in "xyz"]
        np.testing.assert_allclose(sample.world_from_lidar.translation, position, atol=NEAR)
        assert frame["images"][0]["camera_convention"] == "OpenCV"
        if task == "segmentation":
            assert len(label["point_annotations"]) == len(sample.sweep.points)
            continue
        assert len(label["annotations"]) == len(sample.boxes) > 0
        for row in label["annotations"]:
            away = np.linalg.norm(sample.boxes.centers_world - [row["position"][axis] for axis in "xyz"], axis=1)
            k = int(np.argmin(away))
            assert away[k] < NEAR
            assert names[row["category_id"]] == sample.boxes.labels[k]
            assert sample.boxes.yaws_world[k] == pytest.approx(row["yaw"], abs=NEAR)
            quaternion = [row["rotation"][name] for name in ("qx", "qy", "qz", "qw")]
            expected = Rotation.from_quat(quaternion).as_matrix()
            np.testing.assert_allclose(sample.boxes.rotations_world[k], expected, atol=NEAR)
    if task == "segmentation":
        assert labels[1]["point_annotations"][:5] == [0, 1, 0, 0, 1]
