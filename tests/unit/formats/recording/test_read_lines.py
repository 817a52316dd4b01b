"""Reading `data.jsonl`: streams, order, further keys, and lines that are wrong."""

import bz2
import codecs
import gzip
import json
import lzma

import numpy as np
import pytest

from sceneloom.errors import DataError
from sceneloom.formats.recording.spec import FORMAT
from sceneloom.scene import GnssSensor, WarningKind

ROTATION = {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}


def imu_line(time, value=0.0, sensor="gyroscope"):
    return {"sensor": {"type": sensor, "values": [value, 0.5, -0.25]}, "time": time}


def pose_line(key, time, x=0.0, *, rotation=ROTATION):
    pose = {"position": {"x": x, "y": 2.0, "z": 3.0}}
    return {key: pose | ({"orientation": rotation} if rotation else {}), "time": time}


def warnings_of(scene):
    return [(w.code, w.kind, w.count, w.location.rpartition("data.jsonl: ")[2]) for w in scene.warnings]


def test_every_kind_of_sample_lands_in_its_stream(recording):
    pressure = {"barometer": {"pressureHectopascals": 1013}}
    others = [
        {"sensor": {"type": "imuTemperature", "values": [292.8961]}, "time": 0.1},
        {"sensor": {"type": "pressure", "values": [1, 2, 3, 4]}, "time": 0.2},
        {"time": 0.25, **pressure},
    ]
    lines = [imu_line(0.0, 1.0), imu_line(0.1, 2.0, "accelerometer"), *others, imu_line(0.3, 3.0)]
    scene = recording.lines(lines).open()
    streams = scene.sensor("imu").streams
    assert {name: stream.values.tolist() for name, stream in streams.items()} == {
        "gyroscope": [[1.0, 0.5, -0.25], [3.0, 0.5, -0.25]],
        "accelerometer": [[2.0, 0.5, -0.25]],
        "imuTemperature": [[292.8961]],
        "pressure": [[1.0, 2.0, 3.0, 4.0]],
        "barometer": [[1013.0]],
    }
    assert streams["gyroscope"].file_seconds.tolist() == [0.0, 0.3]
    assert scene.warnings == ()
    with pytest.raises(ValueError, match="read-only"):
        streams["gyroscope"].values[0, 0] = 1.0


FIX = {"latitude": 60.1, "longitude": 24.9, "altitude": 14.2}


def test_receivers_are_sensors_of_their_own_with_nan_for_accuracies_that_are_not_given(recording):
    recording.lines(
        [
            {"gps": {**FIX, "accuracy": 4.0}, "time": 0.5},
            {"rtkgps": {**FIX, "accuracy": 0.02}, "time": 1.0},
            {"gps": {**FIX, "verticalAccuracy": 7.5}, "time": 1.0},
            {"pose": {"name": "gps", **FIX}, "time": 2.0},
            {"groundTruth": FIX, "time": 3.0},
        ]
    )
    scene = recording.open()
    sensors = {sensor.id: sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)}
    assert set(sensors) == {"gnss", "rtkgps", "gps", "groundTruth"}
    assert sensors["rtkgps"].accuracies.tolist() == [0.02]
    assert sensors["gps"].timestamps_ns.tolist() == [2_000_000_000]
    gnss = sensors["gnss"]
    assert gnss.positions_lla.tolist() == [[60.1, 24.9, 14.2]] * 2
    np.testing.assert_array_equal([gnss.accuracies, gnss.vertical_accuracies], [[4.0, np.nan], [np.nan, 7.5]])
    assert scene.trajectories == {}


def test_the_default_trajectory_stands_first(recording):
    pose = pose_line("pose", 0.0)["pose"]
    lines = [pose_line(key, 0.0) for key in ("arcore", "externalPose", "pose", "groundTruth")]
    scene = recording.lines([*lines, {"pose": {**pose, "name": "ARKit"}, "time": 0.1}, {"time": 0.2, **pose}]).open()
    assert list(scene.trajectories) == ["groundTruth", "externalPose", "pose", "ARKit", "arcore", "output"]
    origins = scene.metadata["recording"]["trajectory_origins"]
    assert origins == {"ARKit": ["pose", "ARKit"], "output": ["", "output"]}
    # names that are taken get their root key in front
    named = {"pose": {**pose, "name": "groundTruth"}, "time": 0.1}
    scene = recording.lines([pose_line("groundTruth", 0.0), named, pose_line("gnss", 0.0)]).open()
    assert list(scene.trajectories) == ["groundTruth", "pose:groundTruth", "gnss:gnss"]


def test_poses_keep_position_and_orientation_if_any_and_of_two_at_one_time_the_first_is_kept(recording, tmp_path):
    rotation = {"w": 0.53464, "x": -0.15299, "y": -0.826976, "z": -0.082863}
    times = ((1.5, 7.0), (1.5, 2.0), (2.5, 8.0))
    scene = recording.lines([pose_line("pose", time, x, rotation=rotation) for time, x in times]).open()
    trajectory = scene.trajectories["pose"]
    assert trajectory.positions.tolist() == [[7.0, 2.0, 3.0], [8.0, 2.0, 3.0]]
    assert trajectory.quaternions_xyzw.tolist() == [[-0.15299, -0.826976, -0.082863, 0.53464]] * 2
    assert trajectory.timestamps_ns.tolist() == [1_500_000_000, 2_500_000_000]
    assert warnings_of(scene) == [("repeated-poses", WarningKind.SKIPPED, 1, "line 2")]
    enu = {"gnssEnu": {"mean": [1, 2, 3], "covariance": [[1, 0, 0]] * 3}, "time": 1.0}
    for key, line in (("gnssEnu", enu), ("groundTruth", pose_line("groundTruth", 1.0, 1.0, rotation=None))):
        scene = recording.lines([line]).open()
        assert scene.trajectories[key].positions.tolist() == [[1.0, 2.0, 3.0]]
        assert scene.trajectories[key].quaternions_xyzw is None
        assert "orientations-missing" in [warning.code for warning in scene.warnings]
    recording.lines([pose_line("pose", 0.0), pose_line("pose", 1.0, rotation={**ROTATION, "z": 0.9})])
    with pytest.raises(DataError, match=r"line 2: .*0\.9.*length 1"):
        recording.open()
    assert recording.open(lenient=True).trajectories["pose"].timestamps_ns.tolist() == [0]
    # those without the orientation that others have are left out, counted and written again
    lines = [pose_line("groundTruth", 0.1 * k, rotation=None if k in (3, 7) else ROTATION) for k in range(10)]
    with recording.lines(lines).open() as scene:
        times = scene.trajectories["groundTruth"].timestamps_ns
        assert times.tolist() == [k * 100_000_000 for k in range(10) if k not in (3, 7)]
        assert scene.trajectories["groundTruth"].quaternions_xyzw is not None
        assert warnings_of(scene) == [("poses-without-orientation", WarningKind.SKIPPED, 2, "line 4")]
        assert "2 of 10 poses" in scene.warnings[0].message
        FORMAT.write(scene, tmp_path / "again")
    again = (tmp_path / "again" / "data.jsonl").read_text().splitlines()
    assert [json.loads(text) for text in again] == lines


def test_unsorted_lines_are_sorted_stably_with_a_warning_also_in_the_example_of_the_formats_description(recording):
    scene = recording.lines([imu_line(2.0, 0.0), imu_line(1.0, 1.0), imu_line(2.0, 2.0), imu_line(0.5, 3.0)]).open()
    stream = scene.sensor("imu").streams["gyroscope"]
    assert stream.values[:, 0].tolist() == [3.0, 1.0, 0.0, 2.0]
    assert stream.timestamps_ns.tolist() == [500_000_000, 1_000_000_000, 2_000_000_000, 2_000_000_000]
    assert warnings_of(scene) == [("lines-sorted", WarningKind.REPAIRED, 2, "line 2")]
    lines = (
        '{"groundTruth":{"position":{"x":-0.0075,"y":0.0227,"z":0.0081},"orientation":{"w":0.53464,"x":-0.15299,'
        '"y":-0.826976,"z":-0.082863}},"time":1.444770263671875}\n'
        '{"sensor":{"type":"accelerometer","values":[-0.0382,9.1216,-2.9831]},"time":1.43846240234375}\n'
        '{"sensor":{"type":"imuTemperature","values":[292.8961]},"time":1.44976953125}\n'
        '{"gps": {"accuracy": 4.0, "altitude": 14.18831106834269, "latitude": 60.173783793064594, '
        '"longitude": 24.906486344581662}, "time": 1.474782958984375}'
    )
    scene = recording.lines([lines]).open()
    fix = [60.173783793064594, 24.906486344581662, 14.18831106834269]
    assert scene.sensor("gnss").positions_lla.tolist() == [fix]
    assert [warning.code for warning in scene.warnings] == ["lines-sorted"]


def test_unknown_keys_are_kept_with_their_line_and_lines_of_other_kinds_word_by_word(recording):
    sdk = {"time": 0.5, **pose_line("pose", 0.0)["pose"], "status": "TRACKING"}
    hot = {"sensor": {"type": "gyroscope", "values": [1, 2, 3], "temperature": 40}, "time": 0.25}
    narrow = {"sensor": {"type": "pressure", "values": [1]}, "time": 1}  # the first one has two values
    others = ['{"barometer": {"pressure":  1013.25}, "time": 0.1}', '{"sdkVersion":"1.54"}', '{"status": null}']
    wide = {"sensor": {"type": "pressure", "values": [1, 2]}, "time": 0.6}
    scene = recording.lines([imu_line(0.0), *others, hot, sdk, wide, narrow]).open()
    kept, streams = scene.metadata["recording"], scene.sensor("imu").streams
    assert [*kept["other_lines"][:3], json.loads(kept["other_lines"][3])] == [*others, narrow]
    assert json.loads(kept["further_keys"]["imu.gyroscope"]["250000000"]) == hot
    assert json.loads(kept["further_keys"]["trajectories.output"]["500000000"]) == sdk
    assert streams["gyroscope"].values[1].tolist() == [1.0, 2.0, 3.0]
    assert streams["pressure"].values.tolist() == [[1.0, 2.0]]
    found = {warning.code: warning for warning in scene.warnings}
    assert {code: n.count for code, n in found.items()} == {"further-keys-kept": 2, "lines-kept-as-text": 4}
    assert all(key in found["lines-kept-as-text"].message for key in ("barometer", "sdkVersion", "status", "sensor"))
    # lines without such keys are not kept twice
    for count, lines in (
        (2, [pose_line("arcore", 0.0), {"time": 0.5, **pose_line("pose", 0.0)["pose"]}]),
        (2, [{**imu_line(0.0), **pose_line("groundTruth", 0.0)}]),
        (1, [{"gps": FIX | {"accuracy": None}, "time": 1.0}]),
    ):
        scene = recording.lines(lines).open()
        assert (scene.warnings, len(scene.sensors) + len(scene.trajectories)) == ((), count)
        assert "further_keys" not in scene.metadata["recording"]


def test_a_file_of_many_blocks_reads_as_plain_json_does(recording):
    rng = np.random.default_rng(7)
    lines = [imu_line(0.005 * k, float(value)) for k, value in enumerate(rng.normal(size=30_000))]
    recording.lines(lines)
    text = (recording.path / "data.jsonl").read_text()
    assert len(text) > 2 * (1 << 20)
    expected = [json.loads(line)["sensor"]["values"] for line in text.splitlines()]
    np.testing.assert_array_equal(recording.open().sensor("imu").streams["gyroscope"].values, expected)


def sample(values, time="1", kind="gyroscope"):
    return f'{{"sensor":{{"type":"{kind}","values":{values}}},"time":{time}}}'


LIDAR = '{"lidar":{"model":"RoboSense M1 XYZIRT","dataFile":"../a.bin"},"time":1}'
FAULTS = {
    sample("[1,2,3]")[:-4]: ["not a JSON object", "truncated"],
    "": ["blank", "expected a JSON object"],
    "[1, 2]": ["[1, 2]", "expected a JSON object"],
    sample("[1,NaN,3]"): ["NaN", "no JSON numbers"],
    sample("[1,2,-Infinity]"): ["Infinity"],
    sample("[1,2,1e999]"): ["out of range"],
    '{"sensor":{"type":"gyroscope","values":[1,2,3]}}': ["time: missing", "expected seconds"],
    sample("[1,2,3]", "null"): ["time: missing"],
    sample("[1,2,3]", '"1.5"'): ['time: "1.5": expected a number, not a text'],
    sample("[1,2,3]", "1e10"): ["time: 10000000000.0: expected seconds, within ±9.2e+09"],
    sample("[1,2,3]", "17e17"): ["time: 1.7e18: expected", "9.2e+09; this looks like nanoseconds"],
    sample("[1,2,3]", "17e14"): ["time: 1700000000000000.0: expected", "looks like microseconds"],
    sample("[1,2,3]", "17e11"): ["time: 1700000000000.0: expected", "looks like milliseconds"],
    '{"frames":[{"cameraInd":"0"}],"time":1}': ['frames[0].cameraInd: "0": expected a whole number, not a text'],
    '{"frames":[{"cameraInd":0,"missingBitmap":"x"}],"time":1}': ['"x": expected true or false, not a text'],
    '{"sensor":{"type":3,"values":[1]},"time":1}': ["sensor.type: 3: expected a text, not a whole number"],
    '{"sensor":{"type":"x","values":{}},"time":1}': ["sensor.values: {}: expected a list, not an object"],
    '{"gps":[1.0],"time":1}': ["gps: [1.0]: expected an object, not a list"],
    "[": ["a log is no list"],
    '{"number":1},': ["a log is no list"],
    "{": ["each object in one line"],
    '{"sensor":{"type":"gyroscope","values":[1,2,3]},"lidar":{"model":"x","dataFile":"a"},"time":1}': ["lidar.model"],
    sample("[1,2]"): ["sensor.values", "[1.0, 2.0]", "expected 3"],
    sample("[]", kind="odd"): ["sensor.values", "at least one"],
    sample('[1,"two",3]'): ["sensor.values[1]", '"two"', "a number"],
    '{"sensor":{"type":"gyroscope"},"time":1}': ["sensor", "values", "missing"],
    '{"gps":{"latitude":60,"longitude":25},"time":1}': ["gps", "altitude", "missing"],
    '{"groundTruth":{"position":{"x":1,"y":2}},"time":1}': ["groundTruth.position", "`z`"],
    '{"arcore":{"position":{"x":1,"y":2,"z":"up"}},"time":1}': ["arcore.position.z", '"up"', "a number"],
    '{"arcore":{"position":{"x":1,"y":2,"z":3}}}': ["time: missing"],
    '{"frames":[{"cameraInd":0}],"time":1}': ["number: missing"],
    '{"frames":[{}],"number":0,"time":1}': ["frames[0]", "cameraInd"],
    '{"frames":[{"cameraInd":0},{"cameraInd":0}],"number":0,"time":1}': ["cameraInd", "[0, 0]", "once"],
    '{"frames":[{"cameraInd":-1}],"number":0,"time":1}': ["frames[0].cameraInd", "-1"],
    '{"lidar":{"model":"other","dataFile":"a.bin"},"time":1}': ["lidar.model", "'other'", "RoboSense M1 XYZIRT"],
    LIDAR: ["lidar.dataFile", "'../a.bin'"],
    LIDAR.replace(',"dataFile":"../a.bin"', ""): ["lidar", "dataFile", "missing"],
    '{"barometer":{"pressureHectopascals":"1013"},"time":1}': ["barometer.pressureHectopascals", '"1013"'],
    '{"rtkgps":{"latitude":60,"longitude":25},"time":1}': ["rtkgps", "altitude", "missing"],
    '{"rtkgps":{"latitude":60,"longitude":25,"altitude":null},"time":1}': ["rtkgps.altitude", "null"],
    '{"gnssEnu":{"mean":[1,2]},"time":1}': ["gnssEnu.mean", "[1, 2]", "3 numbers"],
    '{"gnssEnu":{"mean":[1,2,"up"]},"time":1}': ["gnssEnu.position.z", '"up"'],
    '{"pose":{"name":"gps","latitude":60,"longitude":25},"time":1}': ["pose", "altitude"],
    sample("[1,2,3]") + "\0": ["not a JSON object"],
    "\0" + sample("[1,2,3]"): ["not a JSON object"],
    sample("[1,2,3]") + ' {"time":2}': ["not a JSON object"],
    sample("[1,2,3]", '1,"gps":{"latitude":60}'): ["gps", "longitude"],
}
"""Wrong lines, and what is stated for each."""

SOUND = [
    '{"sensor":{"type":"magnetometer","values":[1,2,3]},"time":1}',
    '  {"sensor":{"type":"odd","values":[1]},"time":-0.0}\t',
    '{"time":1,"gps":{"longitude":25,"latitude":60,"altitude":-1,"accuracy":null}}',
    '{"groundTruth":{"position":{"x":1,"y":2,"z":1e12}},"time":1}',
    '{"arcore":{"position":{"x":1,"y":2,"z":-3}},"time":9.2e9}',
    '{"barometer":{"pressureHectopascals":1013},"time":1}',
    '{"rtkgps":{"latitude":60,"longitude":25,"altitude":1},"time":1}',
    '{"gnssEnu":{"mean":[1,2,-3]},"time":1}',
    '{"pose":{"name":"gps","latitude":60,"longitude":25,"altitude":0},"time":1}',
    '{"unknown":[1,{"NaN":"Infinity"}]}',
    "{}",
]
"""Lines near to the wrong ones that nothing is wrong with."""


@pytest.mark.parametrize("line", SOUND)
def test_a_sound_line_is_taken_whole(recording, line):
    found = {warning.code for warning in recording.lines([line]).open().warnings}
    assert found <= {"lines-kept-as-text", "further-keys-kept", "orientations-missing"}


@pytest.mark.parametrize("line", FAULTS)
def test_a_wrong_line_is_named_with_its_number_its_value_and_what_was_expected(recording, line):
    recording.lines([imu_line(0.0), line, line, imu_line(2.0)])
    with pytest.raises(DataError) as caught:
        recording.open()
    assert caught.value.file.endswith("data.jsonl")
    assert caught.value.location == "line 2"
    for part in FAULTS[line]:
        assert part in caught.value.problem
    scene = recording.open(lenient=True)
    assert scene.sensor("imu").streams["gyroscope"].timestamps_ns.tolist() == [0, 2_000_000_000]
    ((_, *reported),) = warnings_of(scene)
    assert reported == [WarningKind.SKIPPED, 2, "line 2"]


def test_files_that_are_no_text_are_named_by_their_first_bytes_and_lines_that_are_none_are_faults(
    recording, monkeypatch
):
    text = b'{"time":1}'
    contents = {
        bz2.compress(text): "is compressed by bzip2",
        lzma.compress(text): "is compressed by xz",
        gzip.compress(text, mtime=0): "is compressed by gzip",
        **{text.decode().encode(name): "is text in UTF-16" for name in ("utf-16", "utf-16-le", "utf-16-be")},
    }
    for content, kind in contents.items():
        (recording.path / "data.jsonl").write_bytes(content)
        with pytest.raises(DataError, match=rf"data\.jsonl: {kind}; expected lines of JSON"):
            recording.open(lenient=True)
        if not kind.endswith("16") or content.startswith(codecs.BOM_UTF16):
            (recording.lines([imu_line(0.0)]).path / "calibration.json").write_bytes(content)
            with pytest.raises(DataError, match=rf"calibration\.json: {kind}; expected plain JSON"):
                recording.open()
            (recording.path / "calibration.json").unlink()
    # nor are bytes, lines nested beyond reason, or longer than any
    (recording.path / "data.jsonl").write_bytes(b'{"time":0,"word":"\xff\xfe"}\n')
    with pytest.raises(DataError, match="line 1"):
        recording.open()
    assert recording.open(lenient=True).sensors == ()
    with pytest.raises(DataError, match="line 1"):
        recording.lines(['{"a":' * 100_000]).open()
    monkeypatch.setattr("sceneloom.formats.recording.contents._LONGEST_LINE", 1 << 21)
    (recording.path / "data.jsonl").write_bytes(b" " * (1 << 22))
    with pytest.raises(DataError, match="longer than 2097152 bytes"):
        recording.open(lenient=True)


def test_the_last_line_may_end_as_it_likes_and_blank_ones_after_it_are_left_out_with_a_warning(recording):
    text = "\n".join(json.dumps(imu_line(0.1 * k)) for k in range(3))
    for ending, blank in (("", 0), ("\n", 0), ("\r\n", 0), ("\n\n \t\n\r\n", 3)):
        (recording.path / "data.jsonl").write_bytes((text + ending).encode())
        with recording.open() as scene:
            assert len(scene.sensor("imu").streams["gyroscope"]) == 3
            assert warnings_of(scene) == [("blank-lines-at-end", WarningKind.REPAIRED, 3, "line 4")][: bool(blank)]


@pytest.mark.parametrize("blank", [1, pytest.param(200_000, marks=pytest.mark.slow)])
def test_blank_lines_before_others_are_faults_however_many(recording, blank):
    # more of them than one block of the file holds
    lines = [json.dumps(imu_line(0.0)), *[""] * blank, json.dumps(imu_line(0.1)), "", ""]
    (recording.path / "data.jsonl").write_text("\n".join(lines) + "\n")
    with pytest.raises(DataError, match="line 2: blank"):
        recording.open()
    with recording.open(lenient=True) as scene:
        found = {warning.code: (warning.count, warning.location.split(": ")[-1]) for warning in scene.warnings}
        assert found == {"unfit-lines": (blank, "line 2"), "blank-lines-at-end": (2, f"line {blank + 3}")}
    # a file of nothing else is empty
    (recording.path / "data.jsonl").write_text("\n" * blank + " \n")
    with pytest.raises(DataError, match="is empty"):
        recording.open(lenient=True)


def test_a_byte_order_mark_is_passed_over_with_a_warning_and_lines_keep_their_locations(recording, pinhole):
    # what a line says beyond the columns is read again by the byte at which it begins
    frames = {"frames": [{"cameraInd": 0, "features": [1]}], "number": 0, "time": 0.5}
    recording.lines([imu_line(0.0), frames, imu_line(1.0)]).video("data.mkv", 1)
    path = recording.calibration([pinhole]).path / "data.jsonl"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    with recording.open() as scene:
        assert [warning.code for warning in scene.warnings] == ["byte-order-mark"]
        assert len(scene.sensor("imu").streams["gyroscope"]) == 2
        assert scene.cameras[0].images[0].extras["features"] == [1]
    alone = recording.path.rename(recording.path.with_name("other")) / "lines.log"
    (alone.parent / "data.jsonl").rename(alone)
    assert FORMAT.sniff(alone)
