"""What `--fix` makes of times that are out of order or come twice."""

import json

import numpy as np

import sceneloom
from sceneloom.checks import validate
from sceneloom.checks.recordings.repeated_times import without_repeated_times
from sceneloom.scene import GnssSensor, ImuSensor, LazyFrames, LidarSensor, Scene


def lines_of(folder):
    return [json.loads(line) for line in (folder / "data.jsonl").read_text().splitlines()]


def test_lines_are_sorted_and_times_that_come_twice_are_left_out(written, drive, tmp_path):
    del drive.streams["frames"]
    for name in ("gyroscope", "gps", "groundTruth"):
        drive.streams[name][10]["time"] = drive.streams[name][9]["time"]
    expected = [line for line in drive.lines() if line not in [s[10] for s in drive.streams.values()]]
    expected += [
        drive.streams[name][10] for name in drive.streams if name not in ("gyroscope", "gps", "groundTruth")
    ]
    streams = [line for stream in drive.streams.values() for line in stream]
    report = validate(written(streams), fix=tmp_path / "mended")
    assert {finding.rule for finding in report.fixed} == {"lines-in-order", "stream-times-unique"}
    assert not [f for f in report.findings if f.severity != "hint"]
    mended = lines_of(tmp_path / "mended")
    assert [line["time"] for line in mended] == sorted(line["time"] for line in expected)
    assert {json.dumps(line, sort_keys=True) for line in mended} == {
        json.dumps(line, sort_keys=True) for line in expected
    }


def test_only_what_repeats_a_time_is_left_out(sound, written, drive):
    del drive.streams["frames"]
    drive.streams["gyroscope"][10]["time"] = drive.streams["gyroscope"][9]["time"]
    drive.streams["gps"][0]["time"] = drive.streams["gps"][1]["time"]
    lidar = sound.lidar([0, 0, 5, 5, 7])
    with sceneloom.open(written(drive)) as scene:
        before = Scene((*scene.sensors, lidar))
        after = without_repeated_times(before)
    imu = next(sensor for sensor in after.sensors if isinstance(sensor, ImuSensor))
    fixes = next(sensor for sensor in after.sensors if isinstance(sensor, GnssSensor))
    sweeps = next(sensor for sensor in after.sensors if isinstance(sensor, LidarSensor))
    assert {name: len(samples) for name, samples in imu.streams.items()} == {
        "accelerometer": 1200,
        "gyroscope": 1199,
        "magnetometer": 240,
        "barometer": 240,
        "imuTemperature": 60,
    }
    assert len(fixes.timestamps_ns) == len(fixes.positions_lla) == 59
    assert sweeps.frames.timestamps_ns.tolist() == [0, 5, 7]
    np.testing.assert_array_equal(sweeps.frames[1].points.positions, lidar.frames[2].points.positions)
    assert without_repeated_times(after) is after
    assert isinstance(sweeps.frames, LazyFrames)
