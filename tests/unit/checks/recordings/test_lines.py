"""Rules over the lines of a recording: streams, values, fixes and settings, and steps and agreement of poses."""

import json
import math
import pickle
import shutil
from copy import deepcopy
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom import simulate as sim
from sceneloom.cameras.camera import Camera
from sceneloom.checks import validate
from sceneloom.checks.recordings.files import PRESENCE_RULES
from sceneloom.checks.recordings.samples import FIX_RULES, SAMPLE_RULES, mean_noise
from sceneloom.checks.recordings.times import STREAM_RULES
from sceneloom.errors import SceneloomError
from sceneloom.scene import GnssSensor, ImuSensor

Line = dict[str, Any]
SPAN = 12.0


class SoundLines:
    """Lines of a drive in which no rule over lines finds anything; streams by name, each as lines in order of time."""

    def __init__(self) -> None:
        self._random = np.random.default_rng(7)
        self.streams: dict[str, list[Line]] = {
            "accelerometer": self._sensor("accelerometer", 100.0, [0.1, -0.2, 9.81], 0.05),
            "gyroscope": self._sensor("gyroscope", 100.0, [0.0, 0.01, 0.1], 0.01),
            "magnetometer": self._sensor("magnetometer", 20.0, [20.0, 5.0, -43.0], 0.5),
            "barometer": self._sensor("barometer", 20.0, [1013.25], 0.02),
            "imuTemperature": self._sensor("imuTemperature", 5.0, [305.0], 0.0),
            "gps": [self.fix(t, 8.0 * t) for t in self.times(5.0)],
            "groundTruth": [self.pose(t, 8.0 * t) for t in self.times(20.0)],
            "frames": [
                {"frames": [{"cameraInd": 0}], "number": k, "time": t} for k, t in enumerate(self.times(10.0, 0.0037))
            ],
        }

    def times(self, rate: float, shift: float = 0.0) -> list[float]:
        return [round(1.0 + shift + k / rate, 9) for k in range(int(SPAN * rate))]

    def _sensor(self, name: str, rate: float, mean: list[float], noise: float) -> list[Line]:
        times = self.times(rate)
        values = np.array(mean) + noise * self._random.standard_normal((len(times), len(mean)))
        return [self.sample(name, t, row) for t, row in zip(times, values.tolist(), strict=True)]

    def sample(self, name: str, time: float, values: list[float]) -> Line:
        return {"sensor": {"type": name, "values": values}, "time": time}

    def fix(self, time: float, north: float = 0.0, **fields: Any) -> Line:
        """A fix so many metres north of Helsinki, with half a metre of noise."""
        noise = 0.5 * self._random.standard_normal() if not fields else 0.0
        location = {"latitude": 60.17 + (north + noise) / 111_400.0, "longitude": 24.94, "altitude": 14.0}
        return {"gps": {**location, "accuracy": 0.5, **fields}, "time": time}

    def pose(self, time: float, east: float) -> Line:
        rotation = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
        return {"groundTruth": {"position": {"x": east, "y": 0.0, "z": 0.0}, "orientation": rotation}, "time": time}

    def shifted(self, name: str, seconds: float) -> "SoundLines":
        self.streams[name] = [{**line, "time": line["time"] + seconds} for line in self.streams[name]]
        return self

    def scaled(self, name: str, factor: float, rows: slice = slice(None)) -> "SoundLines":
        for line in self.streams[name][rows]:
            line["sensor"] = {**line["sensor"], "values": [v * factor for v in line["sensor"]["values"]]}
        return self

    def copy(self) -> "SoundLines":
        return pickle.loads(pickle.dumps(self))  # type: ignore[no-any-return]

    def lines(self) -> list[Line]:
        every = [line for stream in self.streams.values() for line in stream]
        return sorted(every, key=lambda line: line["time"])


@pytest.fixture(scope="session")
def sound_lines() -> SoundLines:
    return SoundLines()


@pytest.fixture
def drive(sound_lines: SoundLines) -> SoundLines:
    return sound_lines.copy()


@pytest.fixture
def written(tmp_path):
    """Write lines, or a drive's, as the log of a folder."""

    def write(lines):
        listed = lines.lines() if isinstance(lines, SoundLines) else lines
        texts = [line if isinstance(line, str) else json.dumps(line) for line in listed]
        (tmp_path / "data.jsonl").write_text("".join(text + "\n" for text in texts))
        (tmp_path / "calibration.json").write_text('{"cameras": []}')
        return tmp_path

    return write


class Check:
    """Compare what rules find in a drive with what is expected; `findings` are of these rules alone."""

    def __init__(self, written):
        self._written = written

    def findings(self, drive, rules):
        return validate(self._written(drive), rules=rules.split()).findings

    def __call__(self, drive, rules, *expected):
        """`expected`: rule, line or stream (None: wherever), part of the message, and count where that is given."""
        found = self.findings(drive, " ".join({*rules.split(), *(rule for rule, *_ in expected)}))
        assert [finding.rule for finding in found] == [rule for rule, *_ in expected]
        texts = (self._written(drive) / "data.jsonl").read_text().splitlines()
        for finding, (_, where, words, *count) in zip(found, expected, strict=True):
            location = f"line {texts.index(json.dumps(where)) + 1}" if isinstance(where, dict) else where
            assert where is None or finding.path == f"data.jsonl: {location}"
            assert words in finding.message
            assert count in ([], [finding.count])
        return found


@pytest.fixture
def check(written):
    return Check(written)


TABLES = (STREAM_RULES, SAMPLE_RULES, FIX_RULES, PRESENCE_RULES)


def test_a_sound_drive_keeps_every_rule_and_lines_out_of_order_and_times_that_come_twice_are_reported(check, drive):
    rules = [rule.id for table in TABLES for rule in table]
    assert len(rules) > 20
    check(drive, " ".join(rules))
    lines = drive.lines()
    late = drive.streams["gyroscope"][500]
    lines.remove(late)
    lines.insert(lines.index(drive.streams["gyroscope"][510]) + 1, late)
    words = "gyroscope at 6.000000 s comes after the one at 6.100000 s"
    [finding] = check(lines, "", ("lines-in-order", late, words))
    assert "up to 0.100000 s" in finding.message
    # between streams they are reported once
    lines = [line for stream in drive.streams.values() for line in stream]
    check(lines, "reading-repaired", ("lines-in-order", lines[1200], "", len(drive.streams) - 1))
    for stream in drive.streams.values():
        stream[10]["time"] = stream[9]["time"]
    twice = [finding.message.split(" at ")[0] for finding in check.findings(drive, "stream-times-unique")]
    assert sorted(twice) == sorted(["camera0", *(name for name in drive.streams if name != "frames")])


@pytest.mark.parametrize(("name", "lost", "fewer"), [("accelerometer", 40, 20), ("frames", 1, 0), ("barometer", 12, 9)])
def test_a_gap_is_reported_where_it_begins_and_shorter_breaks_are_none(check, drive, name, lost, fewer):
    kept = drive.streams[name][31 : 31 + lost - fewer]
    del drive.streams[name][31 : 31 + lost]
    check(drive, "frame-gaps stream-outages", ("stream-gaps", drive.streams[name][30], f"{lost} seem"))
    drive.streams[name][31:31] = kept
    check(drive, "stream-gaps")


def test_single_losses_slower_cameras_and_outages_of_satellites_are_no_gaps(check, drive):
    other = drive.copy()
    stream = drive.streams["gyroscope"]
    drive.streams["gyroscope"] = [line for k, line in enumerate(stream) if k not in {300, 301, 500, 700}]
    lost = ("samples-lost", stream[299], "in all, 4 seem missing at 3 locations")
    [finding] = check(drive, "stream-gaps stream-jitter", lost)
    assert finding.severity == "hint"
    frames = other.streams["frames"]
    other.streams["frames"] = [*frames[:70], *frames[70::2]]
    del other.streams["gps"][20:35]
    outage = "gps at 4.800000 s: 3.200000 s to the next, 0.200000 s usually; 15 seem"
    outage = ("stream-outages", other.streams["gps"][19], outage)
    check(other, "stream-gaps", ("stream-jitter", "camera0", ""), outage)


@pytest.mark.parametrize(
    ("name", "rule"), [("gyroscope", "stream-jitter"), ("frames", "stream-jitter"), ("gps", "stream-uneven")]
)
def test_uneven_times_are_reported_above_one_in_twenty(check, drive, name, rule):
    stream = drive.streams[name]
    period = stream[1]["time"] - stream[0]["time"]
    few = len(stream) // 50
    for line in stream[5 : 5 + 2 * few : 2]:  # two intervals each
        line["time"] += 0.3 * period
    check(drive, rule)
    for line in stream[-2 * few - 6 :: 2]:
        line["time"] += 0.3 * period
    check(drive, "", (rule, "camera0" if name == "frames" else name, "off the usual"))


@pytest.mark.parametrize(
    ("name", "every", "expected"),
    [
        ("accelerometer", 10, "10 Hz; expected 50 to 10000 Hz"),
        ("gyroscope", 3, "33.33 Hz; expected 50 to 10000 Hz"),
        ("magnetometer", 25, "0.8 Hz; expected 1 to 1000 Hz"),
        ("barometer", 25, "0.8 Hz; expected 1 to 1000 Hz"),
        ("groundTruth", 25, "0.8 Hz; expected 1 to 10000 Hz"),
        ("frames", 20, "0.5 Hz; expected 1 to 100 Hz"),
    ],
)
def test_rates_that_are_too_low_are_reported(check, drive, name, every, expected):
    drive.streams[name] = drive.streams[name][::every]
    assert [f.message for f in check.findings(drive, "stream-rate")] == [f"comes at {expected}"]


def test_rates_that_are_too_high_are_reported_and_milliseconds_recognised(check, drive):
    fast = drive.copy()
    for line in drive.lines():
        line["time"] *= 1000
    messages = [f.message for f in check.findings(drive, "stream-rate")]
    assert len(messages) > 4
    assert all("are the times milliseconds?" in message for message in messages)
    for line in fast.streams["gps"] + fast.streams["frames"]:
        line["time"] = 1.0 + (line["time"] - 1.0) / 30
    messages = [f.message for f in check.findings(fast, "stream-rate")]
    assert messages == ["comes at 300 Hz; expected 1 to 100 Hz", "comes at 150 Hz; expected 0 to 100 Hz"]


def test_streams_that_do_not_go_together_are_reported(check, drive):
    check(drive, "streams-together")
    apart, beyond, same, shifted = (drive.copy() for _ in range(4))
    apart.streams["frames"] = apart.streams["frames"][60:]
    apart.streams["gps"] = apart.streams["gps"][:30]
    check(
        apart,
        "",
        ("streams-together", "camera0", "starts at 7.004 s, 6.004 s later than others; expected within 5 s"),
        ("streams-together", "gps", "ends at 6.800 s, 6.150 s earlier than others; expected within 5 s"),
    )
    for name in ("accelerometer", "gyroscope"):
        beyond.streams[name] = beyond.streams[name][300:]
    [finding] = check.findings(beyond, "frames-far-from-imu")
    assert finding.message.startswith("camera0 at 1.003700 s is 2.996 s from the nearest sample of the gyroscope")
    assert finding.message.endswith("found up to 2.996 s in 29 of 120 images")  # of the first 3 s, but for 0.1 s
    for line in same.shifted("frames", -0.0037).streams["frames"]:
        line["time"] = round(line["time"], 9)
    [finding] = check.findings(same, "frames-at-imu-times")
    assert finding.message.startswith("100% of the images have the very time of a sample of the accelerometer")
    check(shifted.shifted("accelerometer", 0.01), "imu-clocks")
    check(drive.shifted("accelerometer", 0.02), "", ("imu-clocks", "accelerometer", "20.0 ms after"))


def test_a_recording_without_imu_or_calibration_gets_warnings(written, check, drive):
    rules = ["imu-there", "calibration-there"]
    del drive.streams["gyroscope"]
    assert [f.message for f in check.findings(drive, " ".join(rules))] == ["no gyroscope lines"]
    del drive.streams["frames"]
    folder = written(drive)
    (folder / "calibration.json").unlink()
    report = validate(folder, rules=rules)
    assert [(f.rule, f.severity) for f in report.findings] == [(rule, "warning") for rule in rules]
    assert (report.findings[1].path, report.passed) == ("calibration.json", True)
    # a file of lines alone is known by its name and needs nothing beside it
    lines = [line["groundTruth"] | {"time": line["time"]} for line in drive.streams["groundTruth"]]
    lines[7]["time"] = lines[6]["time"]
    (alone := folder / "alone").mkdir()
    path = alone / "vio.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines) + "{torn\n")
    assert [(f.rule, f.path) for f in validate(path).findings] == [
        ("broken-lines", "vio.jsonl: line 241"),
        ("stream-times-unique", "vio.jsonl: line 8"),
    ]


@pytest.mark.parametrize(
    ("name", "factor", "rule", "guess"),
    [
        ("accelerometer", 1 / 9.80665, "accelerometer-unit", "units of g"),
        ("accelerometer", 1000 / 9.80665, "accelerometer-unit", "thousandths of g"),
        ("accelerometer", 1000.0, "accelerometer-unit", "mm/s²"),
        ("accelerometer", 3.28084, "accelerometer-unit", "feet"),
        ("accelerometer", 0.02, "accelerometer-unit", "gravity taken off"),
        ("gyroscope", 57.2958, "gyroscope-unit", "degrees per second"),
        ("magnetometer", 1000.0, "magnetometer-unit", "nanotesla?"),
        ("magnetometer", 0.01, "magnetometer-unit", "gauss?"),
        ("magnetometer", 1e-6, "magnetometer-unit", "tesla?"),
        ("barometer", 100.0, "barometer-unit", "pascal?"),
        ("barometer", 0.1, "barometer-unit", "kilopascal?"),
        ("barometer", 0.001, "barometer-unit", "bar?"),
        ("imuTemperature", 0.1, "temperature-unit", "Celsius?"),
    ],
)
def test_values_in_another_unit_are_reported_with_a_guess(check, drive, name, factor, rule, guess):
    for line in drive.streams["gyroscope"][300:500]:
        line["sensor"]["values"][2] += 0.5
    rules = f"{rule} gyroscope-unit accelerometer-range accelerometer-noise gyroscope-range"
    check(drive, rules)
    where = name if name in {"accelerometer", "gyroscope"} else None
    check(drive.scaled(name, factor), rules, (rule, where, guess))


def test_a_blow_and_a_torn_yaw_rate_are_reported_with_their_lines_and_are_no_units(check, drive):
    drive.scaled("accelerometer", 25.0, slice(400, 402))
    drive.streams["gyroscope"][77]["sensor"]["values"][0] = 35.0
    blow = drive.streams["accelerometer"][400], "accelerometer at 5.000000 s is 24", 2
    torn = drive.streams["gyroscope"][77], "gyroscope at 1.770000 s is 35 rad/s long"
    units = "accelerometer-unit gyroscope-unit"
    check(drive, units, ("accelerometer-range", *blow), ("gyroscope-range", *torn))


def test_noise_above_the_limit_is_reported_and_agrees_with_the_vendors_kind_of_filter(check, drive):
    from scipy.signal import butter, filtfilt

    # of white noise a filter that cuts at a quarter of the rate leaves sqrt(1/2), of which the mean is 0.8
    for deviation, loud in ((2.0, []), (5.0, ["y"])):
        noisy = drive.copy()
        noise = deviation * np.random.default_rng(1).standard_normal(len(noisy.streams["accelerometer"]))
        for line, extra in zip(noisy.streams["accelerometer"], noise.tolist(), strict=True):
            x, y, z = line["sensor"]["values"]
            line["sensor"]["values"] = [x, y + extra, z]
        found = check.findings(noisy, "accelerometer-noise")
        assert [finding.message.split(" changes")[0] for finding in found] == loud
    noise = np.random.default_rng(1).standard_normal((20_000, 3))
    b, a = butter(3, 0.5, btype="high")
    expected = np.abs(filtfilt(b, a, noise, axis=0)).mean(axis=0)
    np.testing.assert_allclose(mean_noise(noise), expected, rtol=0.05)  # the flanks differ


@pytest.mark.parametrize(
    ("name", "every", "is_reported"),
    [
        ("accelerometer", 10, True),
        ("accelerometer", 200, False),
        ("gyroscope", 10, True),
        ("magnetometer", 10, True),
        ("barometer", 10, False),
        ("barometer", 3, True),
        ("gps", 10, True),
        ("imuTemperature", 2, False),
    ],
)
def test_samples_that_repeat_the_one_before_are_reported(check, drive, name, every, is_reported):
    stream, key = drive.streams[name], "gps" if name == "gps" else "sensor"
    for before, line in zip(stream[::every], stream[1::every], strict=False):
        line[key] = before[key]
    words = f"{name} at {stream[1]['time']:.6f} s has the very values"
    check(drive, "values-repeated", *[("values-repeated", None, words)] * is_reported)


def test_a_location_held_for_a_while_and_lines_of_barometers_and_further_receivers_are_judged_too(check, drive):
    pressure = {"barometer": {"pressureHectopascals": 101_325.0}, "time": 3.0}
    fix = {"rtkgps": {"latitude": 0.0, "longitude": 0.0, "altitude": 1.0, "accuracy": 0.02}, "time": 4.0}
    lines = sorted([*drive.lines(), pressure, fix], key=lambda line: line["time"])
    receiver = ("fixes-somewhere", fix, "rtkgps at 4.000000 s")
    check(lines, "", ("barometer-unit", pressure, ""), receiver)
    for k, line in enumerate(drive.streams["gps"][20:40]):
        line["gps"] = {**drive.streams["gps"][20]["gps"], "accuracy": 0.5 + 0.1 * k}
    check(drive, "", ("values-repeated", None, "gps at 5.2"))


FIXES = "fixes-on-earth fixes-somewhere fixes-altitude fixes-accuracy fixes-jump"


def change(drive, rows, **fields):
    for line in drive.streams["gps"][rows]:
        line["gps"] = {**line["gps"], **fields}


def test_fixes_that_are_off_the_earth_or_at_zero_are_reported(check, drive):
    change(drive, slice(0, 3), latitude=0.0, longitude=0.0)
    check(drive, FIXES, ("fixes-somewhere", drive.streams["gps"][0], "", 3))
    change(drive, slice(None), latitude=116.39, longitude=39.9)
    [finding] = check(drive, FIXES, ("fixes-on-earth", None, "116.39, 39.9", 60))
    assert finding.severity == "error"
    assert "are latitude and longitude exchanged?" in finding.message
    change(drive, slice(None), latitude=60.17 / 57.29578, longitude=0.4353)
    assert "are these radians?" in check.findings(drive, FIXES)[0].message


@pytest.mark.parametrize(
    ("rows", "field", "value", "rule", "words"),
    [
        *((slice(None), "altitude", value, "fixes-altitude", "") for value in (25_000_000.0, -900.0)),
        (slice(None), "altitude", 140_000.0, "fixes-altitude", "millimetres?"),
        *(
            (slice(10, 12), name, value, "fixes-accuracy", f"{name} {value:g}")
            for name in ("accuracy", "verticalAccuracy")
            for value in (0.0, -1.0, 5000.0)
        ),
    ],
)
def test_absurd_altitudes_and_accuracies_are_reported(check, drive, rows, field, value, rule, words):
    change(drive, rows, **{field: value})
    [finding] = check(drive, FIXES, (rule, None, words, 2 if rows.start else 60))
    assert words or "millimetres?" not in finding.message


@pytest.mark.parametrize("metres", [10.0, 100.0, 1000.0])
def test_a_single_fix_that_is_off_is_reported_once_with_its_line(check, drive, metres):
    wrong = drive.streams["gps"][25]
    wrong["gps"]["longitude"] += metres / 55_500
    [finding] = check(drive, FIXES, ("fixes-jump", wrong, "gps at 6.000000 s lies "))
    off = float(finding.message.split("lies ")[1].split(" m")[0])
    assert off == pytest.approx(metres, rel=0.2)  # of the noise of its neighbours


def test_what_fixes_may_do_is_no_jump_and_a_track_that_moves_for_good_is(check, drive):
    fixes = drive.streams["gps"]
    fixes[25]["gps"]["longitude"] += 20 / 55_500
    fixes[25]["gps"]["accuracy"] = 12.0
    check(drive, FIXES)
    fixes[25]["gps"]["longitude"] -= 20 / 55_500
    for line in fixes:
        del line["gps"]["accuracy"]
    check(drive, FIXES)
    for line in fixes[25:]:
        line["gps"]["longitude"] += 200 / 55_500
    check(drive, FIXES, ("fixes-jump", None, ""))
    for k, line in enumerate(fixes):  # as hard as tyres allow
        line["gps"] |= {"longitude": 24.94 + 0.5 * 8.0 * (k / 5) ** 2 / 55_500, "accuracy": 0.5}
    check(drive, FIXES)


@pytest.mark.parametrize(("exchanged", "down"), [(False, False), (True, False), (False, True)])
def test_a_trajectory_that_rotates_to_the_other_side_is_reported(check, drive, exchanged, down):
    """It winds 50 degrees to the left and to the right, at 10 m/s."""
    check(drive, "fixes-mirrored")  # it is straight
    for line in drive.streams["gyroscope"]:
        line["sensor"]["values"] = [0.0, 0.0, 0.87 * math.cos(line["time"])]
    east = north = 0.0
    for line in drive.streams["gps"]:
        course = 0.87 * math.sin(line["time"])
        east, north = east + 2.0 * math.cos(course), north + 2.0 * math.sin(course)
        latitude, longitude = (48.0 + north / 111_200, 11.0 + east / 74_600)[:: -1 if exchanged else 1]
        line["gps"].update(latitude=latitude, longitude=longitude, accuracy=0.1)
    for line in drive.streams["accelerometer"] if down else []:
        line["sensor"]["values"] = [-value for value in line["sensor"]["values"]]
    mirrored = ("fixes-mirrored", "gps", "are latitude and longitude exchanged")
    check(drive, "fixes-mirrored", *[mirrored] * (exchanged or down))


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        (None, []),
        ("", []),
        ("useSlam: True\n# parameterSets: [x]\nparameterSets:\n  - live\n", []),
        (
            "useSlam: True\nuseStero: False\nqqqq: 1\n",
            [
                ("config-keys-known", 2, "'useStero' is not publicly known; is 'useStereo' meant?"),
                ("config-keys-known", 3, "'qqqq' is not publicly known"),
            ],
        ),
        (
            "useSlam: True\nvisualR: 0.01\nuseSlam: False\n",
            [("config-keys-unique", 3, "'useSlam' stands in lines 1, 3; expected once")],
        ),
        ("useSlam:True\n", [("config-lines-settings", 1, "'useSlam:True'; expected a setting, `key: value`")]),
    ],
)
def test_doubtful_settings_are_reported_with_their_line(tmp_path, config, expected):
    lines = [{"sensor": {"type": "gyroscope", "values": [0.0, 0.1, 0.01 * k]}, "time": 0.01 * k} for k in range(5)]
    (tmp_path / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    if config is not None:
        (tmp_path / "vio_config.yaml").write_text(config)
    report = validate(tmp_path, rules=("config-keys-known", "config-keys-unique", "config-lines-settings"))
    assert report.passed
    assert [(f.rule, str(f.severity), f.path, f.message) for f in report.findings] == [
        (rule, "warning", f"vio_config.yaml: line {line}", message) for rule, line, message in expected
    ]


SECOND = 1_000_000_000


def make(seed=1, **options):
    """120 frames of 10 Hz: streams that end 5 s apart can be reported."""
    return sim.simulate_street(seed, frames=120, lidar=sim.LidarSpec(beams=2, steps=16), cameras=(), **options)


def report_of(scene, folder):
    """Of what gives numbers only: sweeps take their time to be measured, and no rule here looks at them."""
    sensors = tuple(sensor for sensor in scene.sensors if isinstance(sensor, ImuSensor | GnssSensor))
    sceneloom.write(replace(scene, sensors=sensors, annotations=()), folder)
    return validate(folder, ignore=["calibration-there"])  # there is nothing to calibrate


@pytest.mark.parametrize(
    "options",
    [
        {"path": sim.PathSpec(stops=(sim.Stop(5.0, 4.0),))},
        {"path": sim.PathSpec(stops=(sim.Stop(0.0, 40.0),))},
        {"path": sim.PathSpec(speeds=(20.0, 40.0), yaw_rate=0.3)},
        {"path": sim.PathSpec(speeds=(2.0, 6.0), yaw_rate=1.0)},
        {"gnss": sim.GnssSpec(rate_hz=20.0, horizontal_sigma=0.02, vertical_sigma=0.04)},
        {"gnss": sim.GnssSpec(rate_hz=5.0, horizontal_sigma=5.0, vertical_sigma=8.0)},
        {"imu": sim.ImuSpec(rate_hz=500.0, accelerometer_noise=0.05, gyroscope_noise=0.005)},
    ],
)
@pytest.mark.few(3)
def test_nothing_is_found_in_a_sound_drive(tmp_path, options):
    report = report_of(make(4, **options).scene, tmp_path / "drive")
    assert [finding for finding in report.findings if finding.severity != "hint"] == []


@pytest.fixture(scope="module")
def simulated():
    return make()


def span(first_s, last_s):
    return ((round((1 + first_s) * SECOND), round((1 + last_s) * SECOND)),)


@pytest.mark.parametrize(
    ("sensor", "wrong", "rule"),
    [
        ("imu", {"drop_outs": span(4, 5)}, "stream-gaps"),
        ("imu", {"lost_share": 0.2}, "stream-jitter"),
        ("imu", {"stuck": span(4, 5)}, "values-repeated"),
        ("imu", {"drop_outs": span(5, 60)}, "streams-together"),
        ("imu", {"time_offset_ns": 7 * SECOND}, "streams-together"),
        ("gnss", {"drop_outs": span(4, 7)}, "stream-outages"),
        ("gnss", {"stuck": span(4, 6)}, "values-repeated"),
    ],
)
def test_what_is_injected_is_found(tmp_path, simulated, sensor, wrong, rule):
    report = report_of(sim.inject(simulated, sim.Faults({sensor: sim.SensorFaults(**wrong)})).scene, tmp_path / "drive")
    assert rule in {finding.rule for finding in report.findings}
    assert report.passed


STEPS = "pose-steps pose-rotations poses-jump poses-rotation"


def rotated(line, degrees):
    half = np.radians(degrees) / 2
    rotation = {"x": 0.0, "y": 0.0, "z": float(np.sin(half)), "w": float(np.cos(half))}
    return {**line, "groundTruth": {**line["groundTruth"], "orientation": rotation}}


def test_poses_that_are_off_or_too_fast_are_reported_once_with_their_lines_and_hard_driving_is_not(check, drive):
    other, torn, stream = drive.copy(), drive.copy(), drive.streams["groundTruth"]
    stream[50]["groundTruth"]["position"]["y"] = 30.0
    words = "groundTruth at 3.500000 s is 30.00 m from the pose 0.050 s before, 600.1 m/s"
    check(drive, STEPS, ("pose-steps", stream[50], words))
    stream = other.streams["groundTruth"]
    stream[:] = [rotated(line, 90.0 * np.sin(k / 40)) for k, line in enumerate(stream)]
    check(other, STEPS)
    stream[30] = rotated(stream[30], 175.0)
    check(other, STEPS, ("pose-rotations", stream[30], ""))
    # starting and braking hard are no jumps
    for along, rules in (
        (lambda k: 10.0 * k, {"pose-steps"}),  # nothing moves at two hundred metres a second
        (lambda k: 0.5 * 9.0 * max(k / 20 - 4.0, 0.0) ** 2, set()),
    ):
        for k, line in enumerate(drive.streams["groundTruth"]):
            line["groundTruth"]["position"] |= {"x": along(k), "y": 0.0}
        assert {finding.rule for finding in check.findings(drive, STEPS)} == rules
    # a single torn yaw rate does not speak against the poses
    stream = torn.streams["groundTruth"]
    stream[:] = [rotated(line, np.degrees(0.8 * np.sin(0.9 * line["time"]))) for line in stream]
    for line in torn.streams["gyroscope"]:
        line["sensor"]["values"] = [0.0, 0.0, 0.8 * 0.9 * float(np.cos(0.9 * line["time"]))]
    torn.streams["gyroscope"][400]["sensor"]["values"] = [99.0, 0.0, 0.0]
    check(torn, "gyroscope-scale poses-clock poses-against-gyroscope", ("gyroscope-range", None, ""))


OVER_VALUES = {"accelerometer-unit", "gyroscope-unit", "fixes-on-earth"}
"""Rules over values, which no reader judges."""


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A recording of all kinds of lines, with nothing wrong in it."""
    camera_model = Camera("pinhole", 48, 32, 30.0, 30.0, 23.5, 15.5)
    cameras = [sim.CameraSpec(camera_model, sim.camera_mount(position=(1.5, y, 1.5))) for y in (0.25, -0.25)]
    drive = sim.simulate_street(1, frames=3, lidar=sim.LidarSpec(beams=4, steps=60), cameras=cameras)
    folder = tmp_path_factory.mktemp("sound") / "drive"
    sceneloom.write(drive.scene, folder, format="recording")
    return folder


@pytest.fixture
def copy(sound, tmp_path):
    return shutil.copytree(sound, tmp_path / "drive")


def check_agreement(folder):
    """Rules that found something, and whether the recording is refused: by all verbs that read it whole, or by none."""

    def fuse():
        with sceneloom.open(folder) as scene:
            sceneloom.fuse(scene)

    findings = sceneloom.validate(folder).findings
    errors = {f.rule: f.message for f in findings if f.severity == "error" and f.rule not in OVER_VALUES}
    refused = []
    again = folder.with_name("again")
    for run in (lambda: sceneloom.open(folder).close(), fuse, lambda: sceneloom.convert(folder, again, overwrite=True)):
        try:
            run()
        except SceneloomError as error:
            refused.append(str(error))
    assert bool(errors) == bool(refused), (errors, refused)
    return [f.rule for f in findings], bool(refused)


def spoilt(name, edit):
    """Edit the bytes of the first file of a name."""

    def run(folder):
        path = next(folder.glob(name))
        path.write_bytes(edit(path.read_bytes()))

    return run


def calibration(edit):
    def change(content):
        edited = json.loads(content)
        edit(edited)
        return json.dumps(edited).encode()

    return spoilt("calibration.json", change)


def camera(edit, index=0):
    return calibration(lambda content: edit(content["cameras"][index]))


def fields(**given):
    return camera(lambda entry: entry.update(given))


def without(key, index=0):
    return camera(lambda entry: entry.pop(key), index)


def log(edit):
    return spoilt("data.jsonl", lambda b: "".join(f"{x}\n" for x in edit(b.decode().splitlines())).encode())


def lines_without(text):
    return log(lambda lines: [line for line in lines if text not in line.replace(" ", "")])


def line_with(key, edit, which=0):
    def change(lines):
        at = [k for k, line in enumerate(lines) if f'"{key}"' in line][which]
        content = json.loads(lines[at])
        edit(content)
        return [*lines[:at], json.dumps(content), *lines[at + 1 :]]

    return log(change)


SHIFTED = (np.eye(4) + np.eye(4, k=3)).tolist()
MIRROR = np.diag([1, 1, -1, 1]).tolist()
REFUSED = [
    lambda d: (d / "calibration.json").unlink(),
    calibration(lambda c: c.pop("cameras")),
    calibration(lambda c: c.update(cameras=[])),
    calibration(lambda c: c["cameras"].pop()),
    fields(imuToCameraMatrix=SHIFTED),
    calibration(lambda c: c["lidars"][0].update(imuToLidarMatrix=SHIFTED)),
    without("focalLengthX"),
    without("principalPointY"),
    without("model"),
    fields(model="plate"),
    fields(distortionCoefficients=[0.1] * 7),
    fields(imuToCamera=[[1, 0], [0, 1]]),
    fields(imuToCamera=MIRROR),
    spoilt("calibration.json", lambda b: b"[]"),
    spoilt("calibration.json", lambda b: b[:-20]),
    lambda d: shutil.copy(d / "data.mkv", d / "data.mp4"),
    lines_without('"number":2'),
    lines_without('"frames"'),
    log(lambda x: [*x[:9], "", *x[9:]]),
    spoilt("data.jsonl", lambda b: b[:-9]),
    spoilt("data.jsonl", lambda b: b""),
    spoilt("data.jsonl", lambda b: b.decode().encode("utf-16")),
    line_with("groundTruth", lambda c: c["groundTruth"]["orientation"].update(w=2.0)),
    line_with("gps", lambda c: c.pop("time")),
    line_with("gps", lambda c: c["gps"].pop("altitude")),
    line_with("sensor", lambda c: c["sensor"].update(values=[1, 2])),
    line_with("lidar", lambda c: c["lidar"].update(model="other")),
    lambda d: next((d / "lidar").iterdir()).unlink(),
    spoilt("lidar/*", lambda b: b[:-1]),
    line_with("frames", lambda c: c.pop("number")),
    line_with("frames", lambda c: c["frames"][0].update(cameraParameters={"model": "plate"})),
]
PASSED = [
    lambda d: None,
    calibration(lambda c: c.pop("lidars")),
    camera(lambda c: c.update(imuToCameraMatrix=c["imuToCamera"])),
    spoilt("data.jsonl", lambda b: b + b"\n\r\n  \n"),
    spoilt("data.jsonl", lambda b: b"\xef\xbb\xbf" + b),
    spoilt("calibration.json", lambda b: b"\xef\xbb\xbf" + b),
    line_with("groundTruth", lambda c: c["groundTruth"].pop("orientation"), 7),
    lines_without('"number":1'),
    lines_without('"gps"'),
    log(lambda x: x[::-1]),
    log(lambda x: [*x, '{"trigger":1,"time":1.0}']),
]


@pytest.mark.parametrize(("change", "refused"), [*((c, True) for c in REFUSED), *((c, False) for c in PASSED)])
@pytest.mark.few(18)
def test_what_is_refused_has_an_error_and_nothing_else_has(copy, change, refused):
    change(copy)
    assert check_agreement(copy)[1] == refused


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        (without("imuToCamera"), "mounts-missing"),
        (without("imuToCamera", 1), "mounts-missing"),
        (lambda d: (d / "data2.mkv").unlink(), "missing-videos"),
        (spoilt("data.mkv", lambda b: b""), "unreadable-videos"),
        (spoilt("data.mkv", lambda b: b[:-200]), "unreadable-videos"),
    ],
)
def test_one_fault_of_a_recording_is_one_finding_and_an_empty_camera_is_another_one(copy, change, rule):
    change(copy)
    assert check_agreement(copy) == ([rule], True)
    if rule == "missing-videos":
        calibration(lambda content: content["cameras"].append(content["cameras"][0]))(copy)
        assert "sensor-empty" in {finding.rule for finding in sceneloom.validate(copy).findings}


@pytest.mark.parametrize("seed", range(12))
def test_they_agree_on_lines_and_calibrations_changed_at_random(copy, seed):
    generator = np.random.default_rng(seed)
    path = copy / ("calibration.json" if seed % 3 == 0 else "data.jsonl")
    texts = path.read_text().splitlines()
    at = int(generator.integers(len(texts)))
    if path.suffix == ".json":
        texts[at] = texts[at][: len(texts[at]) // 2]
    else:
        texts[at] = json.dumps(_mutated(json.loads(texts[at]), generator))
    path.write_text("\n".join(texts) + "\n")
    check_agreement(copy)


def _mutated(value, generator):
    """Leave out a part of an object or list, or exchange a value for one of another kind."""
    others = partial(generator.choice, [0, 3, 9])
    if isinstance(value, dict | list) and value and others():
        key = generator.choice(list(value)) if isinstance(value, dict) else int(generator.integers(len(value)))
        changed = value.copy()
        if others():
            changed[key] = _mutated(changed[key], generator)
        else:
            changed.pop(key)
        return changed
    return [None, "text", -1, 1e12, [], {}][int(generator.integers(6))]


def test_they_agree_on_real_recordings(data_dir, tmp_path):
    folders = sorted(path for path in (data_dir / "recordings").iterdir() if (path / "data.jsonl").exists())
    assert folders
    for folder in folders:
        report = sceneloom.validate(folder, frames=False)
        assert "error" not in {finding.severity for finding in report.findings}
        sceneloom.open(folder).close()


AGAINST = "poses-against-gravity poses-against-gyroscope poses-against-gnss heights-against-gnss"
CONVENTIONS = f"{AGAINST} gyroscope-scale poses-clock"
NORTH_EAST_DOWN = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
FLIP = np.diag([1.0, -1.0, 1.0])
CAMERA_FROM_IMU = Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]])


@pytest.fixture(scope="module")
def lines(tmp_path_factory):
    """The lines of 14 s of driving through bends, with IMU, fixes and the true poses; without images and points."""
    rates = {"imu": sim.ImuSpec(rate_hz=100.0), "gnss": sim.GnssSpec(rate_hz=5.0), "trajectory_hz": 25.0}
    lidar = sim.LidarSpec(beams=4, steps=60)
    scene = sim.simulate_street(3, frames=140, lidar=lidar, cameras=(), **rates).scene
    numbers = replace(scene, sensors=tuple(s for s in scene.sensors if s.id in {"imu", "gnss"}))
    folder = tmp_path_factory.mktemp("drive") / "recording"
    sceneloom.write(numbers, folder)
    return [json.loads(line) for line in (folder / "data.jsonl").read_text().splitlines()]


@pytest.fixture
def found(lines, check):
    """What the rules state of the lines after something was done to each."""

    def run(injected):
        changed = sorted((injected(deepcopy(line)) for line in lines), key=lambda x: x["time"])
        return {finding.rule: finding.message for finding in check.findings(changed, CONVENTIONS)}

    return run


def poses(change):
    """Change position and rotation of every true pose; the change gives a rotation, or its numbers as written."""

    def injected(line):
        if "groundTruth" in line:
            pose = line["groundTruth"]
            position = np.array([pose["position"][k] for k in "xyz"])
            rotation = Rotation.from_quat([pose["orientation"][k] for k in "xyzw"])
            position, rotation = change(position, rotation)
            quaternion = rotation.as_quat() if isinstance(rotation, Rotation) else rotation
            pose["position"] = dict(zip("xyz", map(float, position), strict=True))
            pose["orientation"] = dict(zip("xyzw", map(float, quaternion), strict=True))
        return line

    return injected


def world(rotation, shift=(0.0, 0.0, 0.0)):
    return poses(lambda p, r: (rotation.apply(p) + shift, rotation * r))


def samples(kind, change):
    def injected(line):
        if line.get("sensor", {}).get("type") == kind:
            line["sensor"]["values"] = np.asarray(change(np.array(line["sensor"]["values"]))).tolist()
        return line

    return injected


def late(seconds):
    return lambda line: {**line, "time": line["time"] + (seconds if "sensor" in line else 0.0)}


def flipped(rotation):
    """A rotation seen in a mirror that negates y."""
    return Rotation.from_matrix(FLIP @ rotation.as_matrix() @ FLIP)


GYROSCOPE = {"poses-against-gyroscope": "of the orientations and of the gyroscope correlate"}
OFF_UP = {"poses-against-gravity": "off up"}
UP_90, UP_180 = {"poses-against-gravity": "90° off up"}, {"poses-against-gravity": "180° off up"}
MIRRORED = {"poses-against-gnss": "mirrored"}
EXCHANGED = {"poses-against-gnss": "x and y are exchanged"}
FAR = {"poses-against-gnss": "half of the fixes lie more than"}
INJECTED = [
    (poses(lambda p, r: (p, r.inv())), GYROSCOPE),
    (poses(lambda p, r: (-r.inv().apply(p), r.inv())), GYROSCOPE | FAR),
    (world(Rotation.from_euler("x", 180, degrees=True)), UP_180 | MIRRORED),
    (world(NORTH_EAST_DOWN), UP_180 | EXCHANGED),
    (world(Rotation.from_euler("x", -90, degrees=True)), UP_90),
    (poses(lambda p, r: (FLIP @ p, flipped(r))), GYROSCOPE | MIRRORED),
    (poses(lambda p, r: (FLIP @ p, r)), MIRRORED),
    (poses(lambda p, r: (p, r.as_quat()[[3, 0, 1, 2]])), OFF_UP | GYROSCOPE),
    (poses(lambda p, r: (p, r.as_quat()[[1, 2, 3, 0]])), GYROSCOPE),
    (poses(lambda p, r: (p, r * CAMERA_FROM_IMU.inv())), OFF_UP | GYROSCOPE),
    (poses(lambda p, r: (p, [0.0, 0.0, 0.0, 1.0])), {"poses-against-gyroscope": "the orientations do not rotate"}),
    (poses(lambda p, r: (1000 * p, r)), FAR),
    (samples("gyroscope", np.degrees), {"gyroscope-scale": "degrees per second"}),
    (samples("gyroscope", lambda v: v[[1, 2, 0]]), GYROSCOPE),
    (samples("gyroscope", lambda v: -v), GYROSCOPE),
    (samples("accelerometer", lambda v: -v), UP_180),
    (samples("accelerometer", lambda v: v[[1, 2, 0]]), UP_90),
    (late(0.5), {"poses-clock": "if the IMU's times are 0.50 s later"}),
    (late(-0.5), {"poses-clock": "if the IMU's times are 0.50 s earlier"}),
    (late(0.1), {"poses-clock": "if the IMU's times are 0.10 s later"}),
]


@pytest.mark.parametrize(("injected", "expected"), INJECTED)
@pytest.mark.few(6)
def test_a_wrong_convention_is_found_where_it_disagrees(found, injected, expected):
    messages = found(injected)
    assert set(messages) == set(expected)
    for rule, words in expected.items():
        assert words in messages[rule]


NOISE = np.random.default_rng(5)
DEVICE = Rotation.from_euler("xyz", [90, 20, 50], degrees=True)


def before_reception(line):
    """Fixes at 0, 0, from where the others lie nearly around a quarter of the earth."""
    if "gps" in line:
        line["gps"]["longitude"] += 60.0
        if line["time"] < 2.0:
            line["gps"].update(latitude=0.0, longitude=0.0)
    return line


def rotated_device(line):
    """Mount the whole device another way: its poses and its IMU rotate together."""
    line = poses(lambda p, r: (p, r * DEVICE))(line)
    for kind in ("gyroscope", "accelerometer"):
        line = samples(kind, DEVICE.inv().apply)(line)
    return line


def standing(line):
    if "gps" in line:
        line["gps"].update(latitude=60.17, longitude=24.94, altitude=14.0)
    line = poses(lambda p, r: (0.0 * p, [0.0, 0.0, 0.0, 1.0]))(line)
    line = samples("gyroscope", lambda v: 0.002 * NOISE.standard_normal(3))(line)
    return samples("accelerometer", lambda v: [0.1, 0.0, 9.81])(line)


@pytest.mark.parametrize(
    "allowed",
    [
        lambda line: line,
        before_reception,
        rotated_device,
        world(Rotation.from_euler("z", 130, degrees=True), np.array([90, -4, 7])),
        samples("gyroscope", lambda v: v + NOISE.standard_normal(3)),
        poses(lambda p, r: (p, r * Rotation.from_rotvec(0.03 * NOISE.standard_normal(3)))),
        samples("gyroscope", lambda v: v + np.array([0.05, -0.05, 0.1])),
        poses(lambda p, r: (p + 0.5 * NOISE.standard_normal(3), r)),
        standing,
    ],
)
def test_nothing_is_stated_for_what_is_allowed_or_only_noisy(found, allowed):
    assert found(allowed) == {}
