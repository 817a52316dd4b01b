"""Scenes in the nuScenes schema: what the tables state is in the scene, number for number, and written again."""

import base64
import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.unit.formats.nuscenes.schema_folder import (
    CAMERA_MOUNT,
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
from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats import write_scene
from sceneloom.formats.base.losses import Support
from sceneloom.formats.base.masks import MASKS, Mask, packed_runs
from sceneloom.formats.base.registry import drives_of
from sceneloom.formats.nuscenes import reader as row_tables
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations_at import CuboidAngles

NEAR = 1e-9
"""Two ways of float64 through rotations, of numbers up to 1000."""


@pytest.fixture
def scene(tmp_path):
    return sceneloom.open(street(tmp_path / "source").write())


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
    last = tables.rows["sample"].pop()
    with pytest.raises(DataError, match=r"2 samples; scene.json says 3"):
        sceneloom.open(tables.write())
    tables.rows["sample"].append(last)
    folder = tables.write() / "v1.0-mini"
    (folder / "sample_data.json").write_bytes((folder / "sample_data.json").read_bytes()[:-300])
    with pytest.raises(
        DataError, match=r"sample_data.json: line \d+, column \d+: is no JSON: the file ends within \[\d+\]"
    ):
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


KEYS = {
    "scene": ("log_token", "first_sample_token", "last_sample_token"),
    "sample": ("scene_token",),
    "sample_data": ("sample_token", "ego_pose_token", "calibrated_sensor_token"),
    "calibrated_sensor": ("sensor_token",),
    "instance": ("category_token", "first_annotation_token", "last_annotation_token"),
    "sample_annotation": ("sample_token", "instance_token"),
}
TABLE_OF = {"first_sample": "sample", "last_sample": "sample", "first_annotation": "sample_annotation"}
TABLE_OF["last_annotation"] = "sample_annotation"


def tables_of(folder):
    return {path.stem: json.loads(path.read_text("utf-8")) for path in folder.glob("v*/*.json")}


def check_tables(folder):
    """Every token is unique and leads somewhere, chains go through all rows, files are there."""
    tables = tables_of(folder)
    tokens = {name: [row["token"] for row in rows] for name, rows in tables.items()}
    assert all(len(set(found)) == len(found) for found in tokens.values())
    for name, keys in KEYS.items():
        for row in tables[name]:
            for key in keys:
                other = key.removesuffix("_token")
                assert row[key] in tokens[TABLE_OF.get(other, other)], (name, key)
    for name in ("sample", "sample_data", "sample_annotation"):
        rows = {row["token"]: row for row in tables[name]}
        for token, row in rows.items():
            assert not row["next"] or rows[row["next"]]["prev"] == token
            assert not row["prev"] or rows[row["prev"]]["next"] == token
    for row in tables["sample_data"]:
        assert (folder / row["filename"]).is_file()
        assert row["filename"].startswith("samples/" if row["is_key_frame"] else "sweeps/")
    return tables


def test_what_was_read_from_nuscenes_is_written_again_without_a_loss_and_each_time_the_same(tmp_path):
    source = with_classes(street(tmp_path / "a"), dict.fromkeys((0, 2, 4), slice(3, 9))).write()
    scene = sceneloom.open(source)
    contents = []
    for root in (tmp_path / "b" / "drive", tmp_path / "c" / "drive"):
        root.parent.mkdir()
        assert len(sceneloom.write(scene, root, format="nuscenes")) == 0
        files = (path for path in sorted(root.rglob("*")) if path.is_file())
        contents.append({path.relative_to(root): path.read_bytes() for path in files})
    assert contents[0] == contents[1]
    before, after = tables_of(source), check_tables(root)
    same = {
        "sample": ("token", "timestamp", "next", "prev"),
        "sample_data": ("timestamp", "is_key_frame", "sample_token", "width", "height"),
        "ego_pose": ("timestamp", "translation"),
        "sample_annotation": ("sample_token", "instance_token", "size", "translation", "num_lidar_pts"),
        "scene": ("token", "name", "description", "nbr_samples", "first_sample_token"),
        "log": ("token", "logfile", "location"),
    }
    for table, fields in same.items():
        rows = [[row[field] for field in fields] for row in before[table]]
        assert sorted(map(str, rows)) == sorted(str([row[f] for f in fields]) for row in after[table]), table
    for row, again in zip(before["sample_annotation"], after["sample_annotation"], strict=True):
        assert np.allclose(np.abs(np.dot(row["rotation"], again["rotation"])), 1, atol=1e-12)
    attributes = {row["token"]: row["name"] for row in after["attribute"]}
    found = [[attributes[token] for token in row["attribute_tokens"]] for row in after["sample_annotation"]]
    assert found == [["vehicle.parked"], ["vehicle.moving"], ["vehicle.moving"]]
    for folder in source.glob("s*s/*"):
        again = root / folder.relative_to(source)
        before, written = (sorted(path.read_bytes() for path in each.iterdir()) for each in (folder, again))
        assert before == written, folder
    assert len([*(root / "lidarseg" / "v1.0-mini").iterdir()]) == 3
    assert {row["name"]: row["index"] for row in after["category"]} == {"vehicle.car": 17, "noise": 0}


SECOND = 1_000_000_000


def drive(*, points_frame=sc.PointsFrame.SENSOR, sweeps=11, annotations=(), camera_model=None, radar=None):
    """A drive at 10 Hz without anything of nuScenes in it; the ego drives 10 m/s along x."""
    timestamps = np.arange(sweeps, dtype=np.int64) * (SECOND // 10) + 5 * SECOND
    mount = RigidTransform(Rotation.from_euler("z", 30, degrees=True).as_matrix(), np.array([1.0, 0.2, 1.8]))
    quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (sweeps, 1))
    trajectory = sc.Trajectory("gt", timestamps, np.outer(np.arange(sweeps), [1.0, 0, 0]), quaternions)
    intensities = np.full(20, 9, np.uint8)
    points = [sc.LidarPoints(lidar_rows(20, k)[:, :3].copy(), intensities=intensities) for k in range(sweeps)]
    sweep = [sc.LidarFrame(int(t), p) for t, p in zip(timestamps, points, strict=True)]
    lidar = sc.LidarSensor("lid ar/1", sc.LazyFrames.of(sweep, timestamps), mount=mount, points_frame=points_frame)
    camera_model = camera_model or Camera("pinhole", 64, 48, 40.0, 40.0, 31.5, 23.5)
    rgb = np.random.default_rng(1).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    shots = [sc.CameraImage.of(int(t) + 20_000_400, camera_model, rgb) for t in timestamps]
    images = sc.LazyFrames.of(shots, [shot.timestamp_ns for shot in shots])
    looking = RigidTransform(CAMERA_MOUNT.as_matrix(), np.array([1.5, 0.0, 1.5]))
    camera = sc.CameraSensor(7, camera_model, images, mount=looking)
    sensors = (lidar, camera) if radar is None else (lidar, camera, radar)
    return sc.Scene(sensors, tuple(annotations), trajectories={"gt": trajectory}, source="drive")


def test_samples_are_two_a_second_unless_somebody_says_otherwise(tmp_path):
    scene = drive()
    sceneloom.write(scene, tmp_path / "a", format="nuscenes")
    tables = check_tables(tmp_path / "a")
    assert [row["timestamp"] for row in tables["sample"]] == [5_000_000, 5_500_000, 6_000_000]
    keys = [row for row in tables["sample_data"] if row["is_key_frame"]]
    assert sorted(row["timestamp"] // 10_000 for row in keys) == [500, 502, 550, 552, 600, 602]
    # what lies between samples belongs to the one that follows
    sweep = next(row for row in tables["sample_data"] if row["timestamp"] == 5_100_000)
    assert sweep["sample_token"] == tables["sample"][1]["token"]
    sceneloom.write(scene, tmp_path / "b", format="nuscenes", keyframe_rate_hz="10")
    assert len(tables_of(tmp_path / "b")["sample"]) == 11
    assert not (tmp_path / "b" / "sweeps").exists()


@pytest.mark.parametrize("points_frame", sc.PointsFrame)
def test_points_stay_where_they_are_in_the_world(tmp_path, points_frame):
    scene = drive(points_frame=points_frame)
    sceneloom.write(scene, tmp_path / "a", format="nuscenes")
    again = sceneloom.open(tmp_path / "a").lidars[0]
    assert again.id == "lid ar/1"
    k = 4
    lidar, ego = scene.lidars[0], RigidTransform(np.eye(3), np.array([4.0, 0.0, 0.0]))
    into_world = {"sensor": ego @ lidar.mount, "ego": ego, "world": RigidTransform.identity()}[points_frame]
    expected = into_world.apply(lidar.frames[k].points.positions)
    pose = RigidTransform.from_quaternion(again.poses.positions[k], again.poses.quaternions_xyzw[k])
    found = pose.apply(again.frames[k].points.positions)
    assert np.allclose(found, expected, atol=1e-5)  # float32 of up to 35 m
    assert again.frames[k].points.intensities.tolist() == [9] * 20


def box(identifier, timestamps, *, label="car", size=(4.6, 1.9, 1.7), **fields):
    rows = [[*size, 10.0 + k, -2.0, 0.9, 0.0, 0.0, 20.0 + 10 * k] for k in range(len(timestamps))]
    path = sc.CuboidPath(np.array(timestamps, np.int64), np.array(rows))
    return sc.CuboidAnnotation(identifier, path, label=label, **fields)


def test_boxes_are_reported_at_the_samples_and_between_timestamps_of_their_paths(tmp_path):
    timestamps = [5 * SECOND, 6 * SECOND]
    stated = sc.AttributePath("attributes", (("vehicle.moving",), ()), np.array(timestamps, np.int64))
    seen = sc.AttributePath("visibility", ("v40-60", "unheard"), np.array(timestamps, np.int64))
    other = sc.AttributePath("speed", (1.0,), static=True)
    car = box(12, timestamps, label=None, attributes=(stated, seen, other))
    stationary = box("sign", [5 * SECOND], stationary=True)
    gone = box("gone", [50 * SECOND])
    losses = sceneloom.write(drive(annotations=(car, stationary, gone)), tmp_path / "a", format="nuscenes")
    tables = check_tables(tmp_path / "a")
    assert [row["nbr_annotations"] for row in tables["instance"]] == [3, 3]
    middle = tables["sample_annotation"][1]
    assert middle["translation"] == [10.5, -2.0, 0.9]
    assert middle["size"] == [1.9, 4.6, 1.7]
    rotation = Rotation.from_quat(np.roll(middle["rotation"], -1))
    assert np.allclose(rotation.as_euler("ZYX", degrees=True), [25, 0, 0])
    levels = {row["token"]: row["level"] for row in tables["visibility"]}
    found = [levels.get(row["visibility_token"]) for row in tables["sample_annotation"][:3]]
    assert found == ["v40-60", "v40-60", None]
    names = {row["token"]: row["name"] for row in tables["category"]}
    assert [names[row["category_token"]] for row in tables["instance"]] == ["unknown", "car"]
    assert tables["instance"][1]["token"] == "sign"
    reported = {(loss.field, loss.support): loss.count for loss in losses}
    assert reported["annotations.cuboid.path.values", Support.APPROXIMATED] == 3
    assert reported["annotations.cuboid", Support.DROPPED] == 1
    dropped = [loss for loss in losses if loss.field == "annotations.cuboid.attributes"]
    assert [(loss.what.split(" ")[0], loss.count) for loss in dropped] == [("attributes", 1), ("levels", 1)]


def test_points_in_boxes_are_counted_where_nobody_reported_their_number(tmp_path):
    scene = drive(annotations=(box("car", [5 * SECOND], size=(20.0, 16.0, 18.0), stationary=True),))
    sceneloom.write(scene, tmp_path / "a", format="nuscenes", keyframe_rate_hz=10)
    rows = tables_of(tmp_path / "a")["sample_annotation"]
    values = scene.annotations[0].path.values[0]
    rotation = Rotation.from_quat(CuboidAngles.of(scene).quaternions(values[6:]))
    expected = []
    for k in range(11):
        world = scene.lidars[0].mount.apply(scene.lidars[0].frames[k].points.positions) + np.array([k, 0, 0])
        inside = np.abs(rotation.inv().apply(world - values[3:6])) <= values[:3] / 2
        expected.append(int(inside.all(axis=1).sum()))
    assert sum(expected) > 10
    assert [row["num_lidar_pts"] for row in rows] == expected
    stated = sc.AttributePath("num_lidar_pts", (77,), static=True)
    reported = drive(annotations=(box("car", [5 * SECOND], stationary=True, attributes=(stated,)),))
    sceneloom.write(reported, tmp_path / "b", format="nuscenes")
    assert {row["num_lidar_pts"] for row in tables_of(tmp_path / "b")["sample_annotation"]} == {77}


def test_images_of_other_camera_models_are_resampled_and_others_lose_nothing_as_png(tmp_path):
    bent = Camera("brown_conrady", 64, 48, 40.0, 40.0, 31.5, 23.5, (-0.2, *(0.0,) * 15))
    losses = sceneloom.write(drive(camera_model=bent, sweeps=2), tmp_path / "a", format="nuscenes")
    approximated = {loss.field for loss in losses if loss.support == Support.APPROXIMATED}
    assert approximated >= {"sensors.camera.camera", "sensors.camera.images.rgb"}
    camera = sceneloom.open(tmp_path / "a").cameras[0]
    assert (camera.camera.model, camera.images[0].rgb.shape) == ("pinhole", (48, 64, 3))
    scene = drive(sweeps=2)
    losses = {loss.field: loss for loss in sceneloom.write(scene, tmp_path / "b", format="nuscenes", images="png")}
    again = sceneloom.open(tmp_path / "b").cameras[0]
    assert np.array_equal(again.images[1].rgb, scene.cameras[0].images[1].rgb)
    assert "sensors.camera.images.rgb" not in losses
    rounded = losses["sensors.camera.images.timestamp_ns"]
    assert (rounded.count, rounded.largest_error) == (2, 400.0)


def test_radars_without_returns_and_upward_speeds_are_written_too(tmp_path):
    positions = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
    directions = np.array([[0.6, 0.8, 0], [0, 0.6, 0.8]], np.float32)
    full = sc.RadarPoints(positions, directions, np.array([5, -10], np.float32))
    none, times = sc.RadarPoints(np.zeros((0, 3), np.float32)), [5 * SECOND, 5 * SECOND + SECOND // 10]
    frames = sc.LazyFrames.of([sc.RadarFrame(times[0], full), sc.RadarFrame(times[1], none)], times)
    scene = drive(radar=sc.RadarSensor("radar", frames, mount=RigidTransform.identity()), sweeps=2)
    losses = sceneloom.write(scene, tmp_path / "a", format="nuscenes")
    again = sceneloom.open(tmp_path / "a").sensor("radar")
    assert len(again.frames[1].points) == 0
    found = again.frames[0].points
    assert np.array_equal(found.positions, positions)
    assert np.allclose(found.directions * found.lengths[:, None], [[3, 4, 0], [0, -6, 0]], atol=1e-6)
    lost = next(loss for loss in losses if loss.field == "sensors.radar.frames.points.directions")
    assert lost.largest_error == pytest.approx(8.0)
    unknown = replace(full, lengths=np.array([np.nan, -10], np.float32))
    frames = sc.LazyFrames.of([sc.RadarFrame(times[0], unknown), sc.RadarFrame(times[1], none)], times)
    scene = drive(radar=sc.RadarSensor("radar", frames, mount=RigidTransform.identity()), sweeps=2)
    losses = sceneloom.write(scene, tmp_path / "b", format="nuscenes")
    found = sceneloom.open(tmp_path / "b").sensor("radar").frames[0].points
    assert np.allclose(found.directions * found.lengths[:, None], [[0, 0, 0], [0, -6, 0]], atol=1e-6)
    assert [loss.count for loss in losses if loss.field == "sensors.radar.frames.points.lengths"] == [1]


def test_classes_of_points_get_numbers_and_points_without_one_are_noise(tmp_path):
    rows = np.array([2, 5], np.uint32)
    both = sc.LabeledPoints("lid ar/1", rows, 0), sc.LabeledPoints("lid ar/1", rows, 1)
    road = sc.LabeledPointsAnnotation("a", both, label="road")
    single = sc.LabeledPointsAnnotation("b", (), label="car", is_instance=True)
    also = sc.LabeledPointsAnnotation("c", (sc.LabeledPoints("lid ar/1", rows[:1], 0),), label="road")
    losses = sceneloom.write(drive(annotations=(also, road, single)), tmp_path / "a", format="nuscenes")
    again = sceneloom.open(tmp_path / "a")
    noise, found = again.annotations
    assert (noise.label, found.label, found.extras["index"]) == ("noise", "road", 1)
    assert [entry.sensor_frame for entry in found.labeled_points] == [0]
    assert found.labeled_points[0].point_ids.tolist() == [2, 5]
    reported = {loss.what: loss.count for loss in losses if "labeled_points" in loss.field}
    assert reported["points without a class are written as `noise`"] == 18
    assert reported["points of several classes have the last one"] == 1
    assert reported["classes of sweeps between samples are left out"] == 1
    assert reported["points of single objects, or without a class, are left out"] == 1


def test_nobody_elses_folder_is_replaced_and_options_that_mean_nothing_are_refused(tmp_path):
    def refused(error, message, folder="none", scene=None, **options):
        with pytest.raises(error, match=message):
            sceneloom.write(scene or drive(), tmp_path / folder, format="nuscenes", **options)

    for options, message in (
        ({"keyframe_rate_hz": 0}, "keyframe_rate_hz 0"),
        ({"version": "../up"}, r"version '../up'; expected a name such as v1.0-mini"),
        ({"images": "h264"}, "images 'h264'; nuScenes takes copy, png"),
        ({"speed": 1}, "speed"),
    ):
        refused(OptionError, message, **options)
    refused(DataError, "holds no sweep, radar cycle or image", scene=sc.Scene(()))
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "thesis.txt").write_text("mine")
    refused(OutputError, "holds 'thesis.txt', so it is no data set of nuScenes", "a", overwrite=True)
    sceneloom.write(drive(), tmp_path / "b", format="nuscenes")
    refused(OutputError, "exists already", "b")
    sceneloom.write(drive(sweeps=2), tmp_path / "b", format="nuscenes", overwrite=True)
    assert len(tables_of(tmp_path / "b")["sample"]) == 1


AHEAD = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""`ego_from_camera` of a camera that looks ahead."""

ROUND = {0: "FRONT", 45: "FRONT_LEFT", -60: "FRONT_RIGHT", 100: "BACK_LEFT", -120: "BACK_RIGHT", 175: "BACK"}


def looking(camera, name, degrees, pitch=0.0):
    rotation = Rotation.from_euler("zy", [degrees, pitch], degrees=True).as_matrix()
    return replace(camera, id=name, mount=RigidTransform(rotation @ AHEAD, np.zeros(3)), poses=None)


def with_sensors(scene, *, lidars=("lidar",), cameras=()):
    return replace(scene, annotations=(), sensors=(*(replace(scene.lidars[0], id=name) for name in lidars), *cameras))


def channels(scene, folder, **options):
    write_scene(scene, folder, format="nuscenes", **options)
    (table,) = folder.glob("*/sensor.json")
    found = {row.get("sensor_id", row["channel"]): row["channel"] for row in json.loads(table.read_text())}
    with sceneloom.open(folder) as again:
        assert {sensor.id for sensor in again.sensors} == {sensor.id for sensor in scene.sensors}
    return found


def test_sensors_get_the_channels_of_nuscenes_where_that_is_clear_and_keep_their_ids(scene, tmp_path):
    def named(number, directions, *, lidars=("lidar",), unplaced=(), **options):
        cameras = [looking(scene.cameras[0], name, *direction) for name, direction in directions.items()]
        cameras = [replace(camera, mount=None) if camera.id in unplaced else camera for camera in cameras]
        return channels(with_sensors(scene, lidars=lidars, cameras=cameras), tmp_path / f"out{number}", **options)

    found = named(0, {f"camera{degrees}": (degrees,) for degrees in ROUND})
    assert found == {"lidar": "LIDAR_TOP", **{f"camera{degrees}": f"CAM_{name}" for degrees, name in ROUND.items()}}
    # directions that are not of one camera alone, or not known
    directions = {"left": (0,), "right": (3,), "roof": (180, -80), 7: (82,), "somewhere": (0,)}
    found = named(1, directions, lidars=("front", "Top_lidar"), unplaced=("somewhere",))
    same = {name: name for name in ("front", "left", "right", "roof", "somewhere")}
    assert found == {**same, "Top_lidar": "LIDAR_TOP", 7: "7"}
    # a name that a sensor has is given to no other
    directions = {"CAM_FRONT": (180,), "ahead": (0,), "behind": (180,)}
    found = named(2, directions, lidars=("first", "LIDAR_TOP"), channel=["ahead=CAM_BACK"])
    assert found == {**{name: name for name in ("first", "LIDAR_TOP", "CAM_FRONT", "behind")}, "ahead": "CAM_BACK"}


def test_a_sensor_gets_the_channel_that_is_named_and_its_id_only_if_that_is_unique(scene, tmp_path):
    lidar, camera = scene.lidars[0].id, scene.cameras[0].id
    found = channels(scene, tmp_path / "out", channel=f"{lidar}=LIDAR_TEST, {camera}=CAM_TEST")
    assert (found[lidar], found[camera]) == ("LIDAR_TEST", "CAM_TEST")
    for stated in ("nosuch=LIDAR_TOP", "LIDAR_TOP", "=LIDAR_TOP", ["nosuch=LIDAR_TOP"]):
        with pytest.raises(OptionError, match="expected SENSOR=CHANNEL"):
            write_scene(scene, tmp_path / "none", format="nuscenes", channel=stated)
    (table,) = (tmp_path / "out").glob("*/sensor.json")
    rows = [{**row, "sensor_id": "one"} for row in json.loads(table.read_text())]
    table.write_text(json.dumps(rows))
    with sceneloom.open(tmp_path / "out") as again:
        assert {sensor.id for sensor in again.sensors} == {row["channel"] for row in rows}


def t4_street(folder):
    """The street in the layout of T4: distorted cameras, boxes with masks on images, areas, an invalid image."""
    tables = street(folder)
    tables.folder = folder / "0" / "annotation"
    tables.file("0/.keep", b"")
    for name in ("samples", "sweeps"):
        (folder / name).rename(folder / "0" / name)
    for row in tables.rows["calibrated_sensor"]:
        row["camera_distortion"] = [-0.3, 0.1, 0.001, -0.002, -0.02] if row["camera_intrinsic"] else []
    for row in tables.rows["ego_pose"]:
        del row["timestamp"]
    tables.row("sample_data", "scene-0001-CAM_FRONT-4")["is_valid"] = False
    drawn = {"attribute_tokens": ["att-moving"], "instance_token": "scene-0001-car", "category_token": "cat-car"}
    wide = {"sample_data_token": "scene-0001-CAM_FRONT-0", "bbox": [10, 4, 14, 10]}
    # columns 10 to 13, rows 4 to 9 of 64x48 pixels: down the columns as COCO has it, and along the rows
    runs = {(48, 64): [484, *[6, 42] * 3, 6, 2438], (64, 48): [266, *[4, 60] * 5, 4, 2482]}
    for number, (size, lengths) in enumerate(runs.items()):
        mask = {"size": size, "counts": base64.b64encode(packed_runs(lengths).encode()).decode()}
        wide["sample_data_token"] = f"scene-0001-CAM_FRONT-{2 * number}"
        tables.add("object_ann", f"o-{number}", mask=mask, **wide, **drawn)
        tables.add(
            "surface_ann",
            f"a-{number}",
            mask=mask,
            category_token="cat-noise",
            sample_data_token=wide["sample_data_token"],
        )
    return tables


def test_t4_has_distorted_cameras_and_boxes_masks_and_areas_on_images(tmp_path):
    t4_street(tmp_path / "t4").write()
    scene = sceneloom.open(tmp_path / "t4")
    camera = scene.cameras[0]
    assert camera.camera == Camera("brown_conrady", 64, 48, 30, 30, 31.5, 23.5, (-0.3, 0.1, 0.001, -0.002, -0.02))
    assert len(camera.images) == 4
    assert [warning.count for warning in scene.warnings if warning.code == "frames-invalid"] == [1]
    # times of poses that the table does not state are those of the frames
    taken = [scene.lidars[0].frames, scene.sensor("RADAR_FRONT").frames, camera.images]
    expected = np.unique(np.concatenate([frames.timestamps_ns for frames in taken]))
    assert np.array_equal(scene.trajectories["pose"].timestamps_ns, expected)
    box, *areas = [one for one in scene.annotations if isinstance(one, sc.Box2DAnnotation)]
    assert (box.parent_id, box.label, box.sensor_id) == ("scene-0001-car", "vehicle.car", "CAM_FRONT")
    assert box.path.values.tolist() == [[10, 4, 4, 6]] * 2
    for record in (*box.path.extras[MASKS], *(area.path.extras[MASKS][0] for area in areas)):
        mask = Mask.of_record(record)
        assert (mask.height, mask.width, mask.area, mask.box().tolist()) == (48, 64, 24, [10, 4, 4, 6])
    # written as nuScenes: pinholes; what is drawn on images is reported as lost
    report = write_scene(scene, tmp_path / "out", format="nuscenes")
    assert any(loss.field == "annotations.box_2d" and loss.count == 3 for loss in report)
    assert sceneloom.open(tmp_path / "out").cameras[0].camera.model == "pinhole"


@pytest.mark.parametrize(
    ("table", "change", "message"),
    [
        (
            "calibrated_sensor",
            {"camera_distortion": [0.1, 0.2, 0.3]},
            r"row c-.*camera_distortion of 3 numbers; expected 0, 4, 5",
        ),
        ("object_ann", {"mask": {"size": [9, 9], "counts": "c1E="}}, "row o-1: mask: .*"),
        ("object_ann", {"category_token": "nope"}, "row o-1: category_token 'nope' leads to no row of category.json"),
        ("object_ann", {"bbox": [4, 4, 2, 2]}, r"row o-1: bbox .*expected left, top, right, bottom"),
    ],
)
def test_faults_of_t4_are_errors_with_file_and_row(table, change, message, tmp_path):
    tables = t4_street(tmp_path / "t4")
    tables.rows[table][-1].update(change)
    tables.write()
    with pytest.raises(DataError, match=f"{table}.json: {message}"):
        sceneloom.open(tmp_path / "t4")


def test_the_sample_of_t4_has_what_its_tables_state(data_dir):
    folder = data_dir / "real" / "strangers" / "t4"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    scene = sceneloom.open(folder)
    stated = json.loads((folder / "status.json").read_text())["statistics"]
    assert len(scene.sensors) == stated["sensors"]
    assert sum(len(one.frames if one.type == "lidar" else one.images) for one in scene.sensors) == stated["sample_data"]
    cuboids = [one for one in scene.annotations if isinstance(one, sc.CuboidAnnotation)]
    assert (len(cuboids), sum(len(one.path.timestamps_ns) for one in cuboids)) == (
        stated["instances"],
        stated["annotations_3d"],
    )
    boxes = [one for one in scene.annotations if isinstance(one, sc.Box2DAnnotation)]
    rows = sum(len(one.path.timestamps_ns) for one in boxes)
    assert rows == stated["annotations_2d"] + stated["surface_annotations"]
    areas = sorted(Mask.of_record(mask).area for one in boxes for mask in one.path.extras[MASKS])
    assert areas == [16000, 29450, 30000, 54000, 120000, 120000]
