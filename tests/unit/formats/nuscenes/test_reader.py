"""Scenes in the nuScenes schema: what the tables state is in the scene, number for number."""

import json
import pickle

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.unit.formats.nuscenes.schema_folder import (
    CAR_SIZE_WLH,
    FIRST_US,
    SENSORS,
    car_pose,
    ego_pose,
    lidar_rows,
    radar_rows,
    street,
    with_classes,
)

import sceneloom
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.registry import drives_of
from sceneloom.formats.nuscenes import reader as row_tables
from sceneloom.scene.annotations_at import CuboidAngles

NEAR = 1e-9
"""Two ways of float64 through rotations, of numbers up to 1000."""


@pytest.fixture
def scene(tmp_path):
    return sceneloom.open(street(tmp_path).write())


def test_sensors_frames_points_and_images_are_those_of_the_tables_and_their_files(scene):
    assert scene.format == "nuscenes"
    assert [(sensor.id, sensor.type) for sensor in scene.sensors] == [(k, v[0]) for k, v in SENSORS.items()]
    timestamps = [(FIRST_US + 250_000 * k) * 1000 for k in range(5)]
    assert scene.sensor("LIDAR_TOP").frames.timestamps_ns.tolist() == timestamps
    assert scene.sensor("CAM_FRONT").images.timestamps_ns.tolist() == [time + 12_341_000 for time in timestamps]
    for frames in (scene.lidars[0].frames, scene.cameras[0].images):
        assert pickle.loads(pickle.dumps(frames))[1].timestamp_ns == frames[1].timestamp_ns
    rows, points = lidar_rows(43, 3), scene.lidars[0].frames[3].points
    found = np.column_stack([points.positions, points.intensities, points.rings])
    assert np.array_equal(found, rows)
    assert points.extras == {}
    rows, points = radar_rows(7, 2), scene.sensor("RADAR_FRONT").frames[2].points
    velocities = points.directions * points.lengths[:, None]
    assert np.allclose(velocities[:, :2].T, [rows["vx"], rows["vy"]], atol=1e-5)  # float32 of up to 14 m/s
    for name in ("vx_comp", "id"):
        assert np.array_equal(points.extras[name], rows[name])
    camera = scene.cameras[0]
    assert (camera.camera.model, camera.camera.fx, camera.camera.cy) == ("pinhole", 30.0, 23.5)
    assert (camera.images[2].rgb.shape, camera.images[2].encoded()[:2]) == ((48, 64, 3), b"\xff\xd8")
    assert [image.extras["is_key_frame"] for image in camera.images] == [True, False] * 2 + [True]


def test_sensors_and_boxes_are_where_poses_and_mountings_state_also_in_a_scene_file(scene, tmp_path):
    for channel, (_, translation, rotation, _) in SENSORS.items():
        sensor = scene.sensor(channel)
        assert np.allclose(sensor.mount.translation, translation)
        assert np.allclose(sensor.mount.rotation, rotation.as_matrix())
        for k, timestamp in enumerate(sensor.poses.timestamps_ns.tolist()):
            location, delta_rotation = ego_pose(timestamp // 1000)
            assert np.allclose(sensor.poses.positions[k], location + delta_rotation.apply(translation), atol=NEAR)
            found = Rotation.from_quat(sensor.poses.quaternions_xyzw[k])
            assert (found.inv() * delta_rotation * rotation).magnitude() < NEAR
    assert np.allclose(scene.cameras[0].mount.rotation @ [0, 0, 1], [1, 0, 0])
    trajectory = scene.trajectories["pose"]
    expected = [ego_pose(timestamp // 1000)[0] for timestamp in trajectory.timestamps_ns.tolist()]
    assert len(expected) == 15
    assert np.allclose(trajectory.positions, expected, atol=NEAR)
    (car,) = scene.annotations
    assert (car.id, car.label) == ("scene-0001-car", "vehicle.car")
    width, length, height = CAR_SIZE_WLH
    for k, row in enumerate(car.path.values):
        location, delta_rotation = car_pose(k)
        assert row[:6].tolist() == [length, width, height, *location]
        found = Rotation.from_quat(CuboidAngles.of(scene).quaternions(row[6:]))
        assert (found.inv() * delta_rotation).magnitude() < NEAR
    stated = {path.name: path.values for path in car.attributes}
    assert stated["attributes"] == (("vehicle.parked",), ("vehicle.moving",), ("vehicle.moving",))
    assert stated["num_lidar_pts"] == (3, 4, 5)
    assert stated["visibility"] == ("", "v80-100", "v80-100")
    assert car.path.extras["tokens"][1] == "scene-0001-ann-1"
    sceneloom.write(scene, tmp_path / "a.sfs", time_unit="nanoseconds")
    with sceneloom.open(tmp_path / "a.sfs") as again:
        assert np.array_equal(again.lidars[0].frames[2].points.positions, lidar_rows(42, 2)[:, :3])
        assert np.allclose(again.annotations[0].path.values, car.path.values)
        assert json.dumps(again.metadata["nuscenes"]["log"])


def test_a_point_at_the_origin_stays_since_labels_count_rows_and_classes_become_labelled_points(tmp_path):
    tables = with_classes(street(tmp_path), {0: slice(3, 5), 2: slice(3, 7)})
    rows = lidar_rows(40)
    rows[2, :3] = 0
    rows[1, 3] = 17.25
    tables.file(tables.row("sample_data", "scene-0001-LIDAR_TOP-0")["filename"], rows.tobytes())
    scene = sceneloom.open(tables.write())
    points = scene.lidars[0].frames[0].points
    assert (len(points), points.intensities[1]) == (40, 17)
    assert points.extras["intensity"].tolist() == rows[:, 3].tolist()
    noise, car = scene.annotations[1:]
    assert (noise.label, car.label, car.is_instance) == ("noise", "vehicle.car", False)
    assert [(p.sensor_id, p.sensor_frame) for p in car.labeled_points] == [("LIDAR_TOP", 0), ("LIDAR_TOP", 2)]
    assert car.labeled_points[1].point_ids.tolist() == [3, 4, 5, 6]
    assert noise.labeled_points[0].point_ids.tolist() == [0, 1, 2, *range(5, 40)]


def test_one_of_several_scenes_and_of_several_sets_of_tables_has_to_be_chosen(tmp_path):
    root = street(tmp_path, scenes=("scene-0001", "scene-0002")).write()
    with pytest.raises(OptionError, match="2 scenes; choose one with `--sequence NAME`: scene-0001, scene-0002"):
        sceneloom.open(root)
    assert drives_of(root) == ("scene-0001", "scene-0002")
    with pytest.raises(OptionError, match="no scene 'scene-0003'; it has scene-0001, scene-0002"):
        sceneloom.open(root, sequence="scene-0003")
    scene = sceneloom.open(root, sequence="scene-0002")
    assert scene.lidars[0].frames.timestamps_ns[0] == (FIRST_US + 60_000_000) * 1000
    assert [a.id for a in scene.annotations] == ["scene-0002-car"]
    assert scene.metadata["nuscenes"]["scene"]["description"] == "The street of scene-0002"
    other = street(tmp_path)
    other.folder = tmp_path / "v1.0-other"
    other.write()
    with pytest.raises(OptionError, match="several sets of tables"):
        sceneloom.open(root)
    assert sceneloom.open(other.folder).metadata["nuscenes"]["version"] == "v1.0-other"


def test_key_frames_alone_open_without_the_folder_of_sweeps_and_a_lenient_reading_counts_what_it_lacks(tmp_path):
    tables = street(tmp_path)
    root = tables.write()
    for file in (root / "sweeps" / "LIDAR_TOP").iterdir():
        file.unlink()
    with pytest.raises(DataError, match=r"is not there.*open the key frames only"):
        sceneloom.open(root)
    assert len(sceneloom.open(root, keyframes=True).lidars[0].frames) == 3
    tables.row("sample_data", "scene-0001-LIDAR_TOP-2")["ego_pose_token"] = "gone"
    lenient = sceneloom.open(tables.write(), lenient=True)
    assert len(lenient.lidars[0].frames) == 2
    assert {n.code: n.count for n in lenient.warnings}.items() >= {("files-missing", 2), ("dangling-tokens", 1)}


def test_large_tables_are_read_in_chunks_and_whole_ones_alike(tmp_path, monkeypatch):
    tables = street(tmp_path)
    tables.rows["log"][0]["location"] = "}, {"
    root = tables.write()
    whole = list(row_tables.iter_rows(tables.folder, "sample_data"))
    monkeypatch.setattr(row_tables, "_PIECE", 700)
    assert list(row_tables.iter_rows(tables.folder, "sample_data")) == whole
    monkeypatch.setattr(row_tables, "_PIECE", 60)
    assert [row.location for row in row_tables.iter_rows(tables.folder, "log")] == ["}, {"]
    assert len(sceneloom.open(root).sensors) == 3


FRAME, CAR = "scene-0001-LIDAR_TOP-1", "scene-0001-ann-1"
GONE = "'gone' leads to no row of"
CAMERA, OBJECT = "c-CAM_FRONT", "scene-0001-car"
DAMAGED = [
    ("sample_data", FRAME, "ego_pose_token", "gone", rf"row {FRAME}: ego_pose_token {GONE} ego_pose.json"),
    ("sample_data", FRAME, "calibrated_sensor_token", "gone", f"calibrated_sensor_token {GONE}"),
    ("sample_annotation", CAR, "attribute_tokens", ["gone"], f"attribute_token {GONE} attribute.json"),
    ("instance", OBJECT, "category_token", "gone", "instance.json: row scene-0001-car: category_token 'gone'"),
    ("ego_pose", FRAME, "translation", [1.0, 2.0], r"ego_pose.json: row 1.translation: Expected `array` of length 3"),
    ("ego_pose", FRAME, "rotation", [1, 1, 0, 0], rf"{FRAME}: rotation \[1.0, 1.0, 0.0, 0.0\] has the length 1.4142"),
    ("calibrated_sensor", CAMERA, "camera_intrinsic", [], rf"row {CAMERA}: camera_intrinsic \[\]; expected rows"),
    ("sample_annotation", CAR, "size", [0.0, 1.0, 1.0], rf"row {CAR}: size \[0.0, 1.0, 1.0\]"),
    ("sample_data", FRAME, "filename", "../x.bin", "filename '../x.bin'; expected one inside the folder"),
    ("ego_pose", None, None, None, r"ego_pose.json: missing"),
    ("visibility", None, None, None, r"visibility.json: missing"),
]


@pytest.mark.parametrize(("table", "token", "field", "value", "message"), DAMAGED)
def test_what_is_wrong_with_a_row_is_reported_with_its_location(tmp_path, table, token, field, value, message):
    tables = street(tmp_path)
    if token is None:
        tables.rows.pop(table)
    else:
        tables.row(table, token)[field] = value
    with pytest.raises(DataError, match=message):
        sceneloom.open(tables.write())


def test_samples_that_are_missing_a_table_that_is_cut_off_and_a_folder_without_tables_are_reported(tmp_path):
    tables = street(tmp_path)
    tables.rows["sample"].pop()
    folder = tables.write() / "v1.0-mini"
    with pytest.raises(DataError, match=r"2 samples; scene.json says 3"):
        sceneloom.open(tmp_path)
    (folder / "sample_data.json").write_bytes((folder / "sample_data.json").read_bytes()[:-300])
    with pytest.raises(DataError, match=r"sample_data.json: is no JSON"):
        sceneloom.open(tmp_path)
    for file in folder.iterdir():
        file.unlink()
    with pytest.raises(DataError, match=r"samples/ as nuScenes has, but no folder of tables"):
        sceneloom.open(tmp_path)


def test_a_cloud_that_is_cut_off_and_labels_of_another_number_than_the_points_are_reported(tmp_path):
    tables = street(tmp_path)
    tables.file(tables.row("sample_data", FRAME)["filename"], lidar_rows(3).tobytes()[:-7])
    scene = sceneloom.open(tables.write())
    with pytest.raises(DataError, match="53 bytes are 2 points of 20 bytes"):
        scene.lidars[0].frames[1]
    name = tables.file("lidarseg/short.bin", bytes(12))
    tables.add("lidarseg", "l", sample_data_token="scene-0001-LIDAR_TOP-0", filename=name)
    with pytest.raises(DataError, match="12 labels; expected 40, one for each point of scene-0001-LIDAR_TOP-0"):
        sceneloom.open(tables.write())
