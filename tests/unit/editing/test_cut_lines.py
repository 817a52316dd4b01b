"""Lines of a recording that were kept word by word go with the part of the drive that they are of."""

import json

import pytest

from sceneloom.editing import crop_scene
from sceneloom.formats import open_scene, write_scene
from sceneloom.scene.scene import time_span
from sceneloom.simulate import LidarSpec, simulate_street


@pytest.fixture
def drive(tmp_path):
    """Three sweeps, at 1.0, 1.1 and 1.2 s, with lines that no scene has a location for."""
    folder = tmp_path / "drive"
    write_scene(simulate_street(1, frames=3, lidar=LidarSpec(beams=4, steps=30), cameras=()).scene, folder)
    lines = [
        {"madeBy": "a phone"},
        {"location": "on the road", "time": 1.02},
        {"location": "at home", "time": 1.19},
        {"gps": {"latitude": 60.0, "longitude": 25.0, "altitude": 1.0, "note": "on the road"}, "time": 1.03},
        {"gps": {"latitude": 61.0, "longitude": 25.0, "altitude": 1.0, "note": "at home"}, "time": 1.18},
        {
            "sensor": {"type": "gyroscope", "values": [1.0, 1.0, 1.0]},
            "gps": {"latitude": 62.0, "longitude": 25.0, "altitude": 1.0, "note": "at home"},
            "time": 1.185,
        },
    ]
    with (folder / "data.jsonl").open("a") as file:
        file.writelines(json.dumps(line) + "\n" for line in lines)
    return folder


def written(scene, folder):
    write_scene(scene, folder)
    return (folder / "data.jsonl").read_text()


def test_without_a_cut_all_lines_come_back(drive, tmp_path):
    with open_scene(drive) as scene:
        text = written(crop_scene(scene, without=("imu",)), tmp_path / "out")
    assert (text.count("at home"), text.count("a phone")) == (2, 1)  # not the line that the IMU had a part in


def test_lines_of_another_time_are_left_out(drive, tmp_path):
    with open_scene(drive) as scene:
        first_ns, _ = time_span(scene)
        cut = crop_scene(scene, stop=1.12 - first_ns / 1e9)
        text = written(cut, tmp_path / "out")
        assert "at home" not in str(cut.metadata["recording"])
    assert "at home" not in text
    # the line without a time stood behind the last one, and goes with it
    assert (text.count("on the road"), text.count("a phone")) == (2, 0)


def test_lines_of_a_sensor_that_is_left_out_are_left_out_too(drive, tmp_path):
    with open_scene(drive) as scene:
        cut = crop_scene(scene, without=("gnss",))
        assert "latitude" not in str(cut.metadata["recording"])
        text = written(cut, tmp_path / "out")
    assert "gps" not in text
    assert text.count("at home") == 1  # a line of which nothing says what it is of
