"""Sensors under the channels that the development kit of nuScenes asks for by name."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.unit.formats.nuscenes.schema_folder import street

import sceneloom
from sceneloom.errors import OptionError
from sceneloom.formats import write_scene
from sceneloom.geometry.rigid import RigidTransform

AHEAD = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""`ego_from_camera` of a camera that looks ahead."""

ROUND = {0: "FRONT", 45: "FRONT_LEFT", -60: "FRONT_RIGHT", 100: "BACK_LEFT", -120: "BACK_RIGHT", 175: "BACK"}


@pytest.fixture
def scene(tmp_path):
    with sceneloom.open(street(tmp_path / "source").write()) as opened:
        yield opened


def looking(camera, name, degrees, pitch=0.0):
    rotation = Rotation.from_euler("zy", [degrees, pitch], degrees=True).as_matrix()
    return replace(camera, id=name, mount=RigidTransform(rotation @ AHEAD, np.zeros(3)), poses=None)


def with_sensors(scene, *, lidars=("lidar",), cameras=()):
    return replace(
        scene,
        annotations=(),
        sensors=(*(replace(scene.lidars[0], id=name) for name in lidars), *cameras),
    )


def channels(scene, folder, **options):
    write_scene(scene, folder, format="nuscenes", **options)
    (table,) = folder.glob("*/sensor.json")
    found = {row.get("sensor_id", row["channel"]): row["channel"] for row in json.loads(table.read_text())}
    with sceneloom.open(folder) as again:
        assert {sensor.id for sensor in again.sensors} == {sensor.id for sensor in scene.sensors}
    return found


def test_the_lidar_and_cameras_all_round_get_the_channels_of_nuscenes_and_keep_their_ids(scene, tmp_path):
    (camera,) = scene.cameras
    cameras = [looking(camera, f"camera{degrees}", degrees) for degrees in ROUND]
    found = channels(with_sensors(scene, cameras=cameras), tmp_path / "out")
    named = {f"camera{degrees}": f"CAM_{name}" for degrees, name in ROUND.items()}
    assert found == {"lidar": "LIDAR_TOP", **named}


def test_cameras_whose_direction_is_not_theirs_alone_or_not_known_keep_their_ids(scene, tmp_path):
    (camera,) = scene.cameras
    cameras = [
        looking(camera, "left", 0),
        looking(camera, "right", 3),
        looking(camera, "roof", 180, pitch=-80),
        looking(camera, 7, 82),
        replace(looking(camera, "somewhere", 0), mount=None),
    ]
    found = channels(with_sensors(scene, lidars=("front", "Top_lidar"), cameras=cameras), tmp_path / "out")
    assert found == {
        **{name: name for name in ("front", "left", "right", "roof", "somewhere")},
        "Top_lidar": "LIDAR_TOP",
        7: "7",
    }


def test_a_name_that_a_sensor_has_is_given_to_no_other(scene, tmp_path):
    (camera,) = scene.cameras
    cameras = [looking(camera, "CAM_FRONT", 180), looking(camera, "ahead", 0), looking(camera, "behind", 180)]
    drive = with_sensors(scene, lidars=("first", "LIDAR_TOP"), cameras=cameras)
    found = channels(drive, tmp_path / "out", channel=["ahead=CAM_BACK"])
    assert found == {
        **{name: name for name in ("first", "LIDAR_TOP", "CAM_FRONT", "behind")},
        "ahead": "CAM_BACK",
    }


def test_ids_of_sensors_that_are_not_unique_give_way_to_the_channels(scene, tmp_path):
    write_scene(scene, tmp_path / "out", format="nuscenes")
    (table,) = (tmp_path / "out").glob("*/sensor.json")
    rows = [{**row, "sensor_id": "one"} for row in json.loads(table.read_text())]
    table.write_text(json.dumps(rows))
    with sceneloom.open(tmp_path / "out") as again:
        assert {sensor.id for sensor in again.sensors} == {row["channel"] for row in rows}


def test_a_sensor_gets_the_channel_that_is_named(scene, tmp_path):
    lidar, camera = scene.lidars[0].id, scene.cameras[0].id
    found = channels(scene, tmp_path / "out", channel=f"{lidar}=LIDAR_TEST, {camera}=CAM_TEST")
    assert (found[lidar], found[camera]) == ("LIDAR_TEST", "CAM_TEST")


@pytest.mark.parametrize("stated", ["nosuch=LIDAR_TOP", "LIDAR_TOP", "=LIDAR_TOP", ["nosuch=LIDAR_TOP"]])
def test_a_channel_of_no_sensor_is_refused(scene, tmp_path, stated):
    with pytest.raises(OptionError, match="expected SENSOR=CHANNEL"):
        write_scene(scene, tmp_path / "out", format="nuscenes", channel=stated)
