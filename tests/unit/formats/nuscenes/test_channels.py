"""Sensors under the channels that the development kit of nuScenes asks for by name."""

import json

import pytest
from tests.unit.formats.nuscenes.schema_folder import street

import sceneloom
from sceneloom.errors import OptionError
from sceneloom.formats import write_scene


@pytest.fixture
def scene(tmp_path):
    with sceneloom.open(street(tmp_path / "source").write()) as opened:
        yield opened


def test_a_sensor_gets_the_channel_that_is_named(scene, tmp_path):
    lidar, camera = scene.lidars[0].id, scene.cameras[0].id
    write_scene(scene, tmp_path / "out", format="nuscenes", channel=f"{lidar}=LIDAR_TEST, {camera}=CAM_TEST")
    (table,) = (tmp_path / "out").glob("*/sensor.json")
    channels = {row["channel"] for row in json.loads(table.read_text())}
    assert {"LIDAR_TEST", "CAM_TEST"} <= channels
    assert not {lidar, camera} & channels


@pytest.mark.parametrize("said", ["nosuch=LIDAR_TOP", "LIDAR_TOP", "=LIDAR_TOP"])
def test_a_channel_of_no_sensor_is_refused(scene, tmp_path, said):
    with pytest.raises(OptionError, match="expected SENSOR=CHANNEL"):
        write_scene(scene, tmp_path / "out", format="nuscenes", channel=said)
