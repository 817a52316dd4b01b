"""Rules about order, rates, gaps and ends of streams."""

import json

import pytest

from sceneloom.checks import validate
from sceneloom.checks.recordings.files import PRESENCE_RULES
from sceneloom.checks.recordings.samples import SAMPLE_RULES
from sceneloom.checks.recordings.satellite_fixes import FIX_RULES
from sceneloom.checks.recordings.times import STREAM_RULES

TABLES = (STREAM_RULES, SAMPLE_RULES, FIX_RULES, PRESENCE_RULES)


def test_a_sound_drive_keeps_every_rule_over_its_lines(written, drive):
    rules = [rule.id for table in TABLES for rule in table]
    assert len(rules) > 20
    assert validate(written(drive), rules=rules).findings == ()


def test_a_stream_that_goes_back_in_time_is_reported_with_its_line(written, drive, line_of):
    lines = drive.lines()
    late = drive.streams["gyroscope"][500]
    lines.remove(late)
    lines.insert(lines.index(drive.streams["gyroscope"][510]) + 1, late)
    folder = written(lines)
    [finding] = validate(folder, rules=["lines-in-order"]).findings
    assert finding.path == line_of(folder, late)
    assert finding.message.startswith("gyroscope at 6.000000 s comes after the one at 6.100000 s")
    assert "up to 0.100000 s" in finding.message


def test_lines_out_of_order_between_streams_are_reported_once(written, drive):
    streams = [line for stream in drive.streams.values() for line in stream]
    report = validate(written(streams), rules=["lines-in-order", "reading-repaired"])
    [finding] = report.findings
    assert (finding.rule, finding.path) == ("lines-in-order", "data.jsonl: line 1201")
    assert finding.count == len(drive.streams) - 1


def test_a_time_that_comes_twice_is_reported_in_every_kind_of_stream(reported, drive):
    for stream in drive.streams.values():
        stream[10]["time"] = stream[9]["time"]
    messages = [message.split(" at ")[0] for _, message in reported(drive, "stream-times-unique")]
    assert sorted(messages) == sorted(["camera0", *(name for name in drive.streams if name != "frames")])


@pytest.mark.parametrize(("name", "lost", "fewer"), [("accelerometer", 40, 20), ("frames", 1, 0), ("barometer", 12, 9)])
def test_a_gap_is_reported_where_it_begins_and_shorter_breaks_are_none(written, drive, line_of, name, lost, fewer):
    last = drive.streams[name][30]
    kept = drive.streams[name][31 : 31 + lost - fewer]
    del drive.streams[name][31 : 31 + lost]
    folder = written(drive)
    [finding] = validate(folder, rules=["stream-gaps", "frame-gaps", "stream-outages"]).findings
    assert finding.rule == "stream-gaps"
    assert finding.path == line_of(folder, last)
    assert f"{lost} seem" in finding.message
    drive.streams[name][31:31] = kept
    assert validate(written(drive), rules=["stream-gaps"]).findings == ()


def test_samples_that_are_missing_one_by_one_are_a_hint(written, drive, line_of):
    lost = [line for k, line in enumerate(drive.streams["gyroscope"]) if k in {300, 301, 500, 700}]
    before = drive.streams["gyroscope"][299]
    drive.streams["gyroscope"] = [line for line in drive.streams["gyroscope"] if line not in lost]
    folder = written(drive)
    [finding] = validate(folder, rules=["samples-lost", "stream-gaps", "stream-jitter"]).findings
    assert (finding.rule, finding.severity) == ("samples-lost", "hint")
    assert finding.path == line_of(folder, before)
    assert finding.message.endswith("in all, 4 seem missing at 3 locations")


def test_a_camera_that_slows_down_and_an_outage_of_the_satellites_have_no_gaps(reported, drive):
    frames = drive.streams["frames"]
    drive.streams["frames"] = [*frames[:70], *frames[70::2]]
    del drive.streams["gps"][20:35]
    assert reported(drive, "stream-gaps") == []
    [(location, _)] = reported(drive, "stream-jitter")
    assert location == "data.jsonl: camera0"
    [(_, message)] = reported(drive, "stream-outages")
    assert message.startswith("gps at 4.800000 s: 3.200000 s to the next, 0.200000 s usually; 15 seem")


@pytest.mark.parametrize(
    ("name", "rule"), [("gyroscope", "stream-jitter"), ("frames", "stream-jitter"), ("gps", "stream-uneven")]
)
def test_uneven_times_are_reported_above_one_in_twenty(reported, drive, name, rule):
    stream = drive.streams[name]
    period = stream[1]["time"] - stream[0]["time"]
    few = len(stream) // 50
    for line in stream[5 : 5 + 2 * few : 2]:  # two intervals each
        line["time"] += 0.3 * period
    assert reported(drive, rule) == []
    for line in stream[-2 * few - 6 :: 2]:
        line["time"] += 0.3 * period
    [(location, message)] = reported(drive, rule)
    assert location == f"data.jsonl: {'camera0' if name == 'frames' else name}"
    assert "off the usual" in message


@pytest.mark.parametrize(
    ("name", "every", "expected"),
    [
        ("accelerometer", 10, "comes at 10 Hz; expected 50 to 10000 Hz"),
        ("gyroscope", 3, "comes at 33.33 Hz; expected 50 to 10000 Hz"),
        ("magnetometer", 25, "comes at 0.8 Hz; expected 1 to 1000 Hz"),
        ("barometer", 25, "comes at 0.8 Hz; expected 1 to 1000 Hz"),
        ("groundTruth", 25, "comes at 0.8 Hz; expected 1 to 10000 Hz"),
        ("frames", 20, "comes at 0.5 Hz; expected 1 to 100 Hz"),
    ],
)
def test_rates_that_are_too_low_are_reported(reported, drive, name, every, expected):
    drive.streams[name] = drive.streams[name][::every]
    assert [message for _, message in reported(drive, "stream-rate")] == [expected]


def test_rates_that_are_too_high_are_reported_and_milliseconds_recognised(reported, drive):
    for line in drive.lines():
        line["time"] *= 1000
    messages = [message for _, message in reported(drive, "stream-rate")]
    assert len(messages) > 4
    assert all("are the times milliseconds?" in message for message in messages)
    for line in drive.lines():
        line["time"] /= 1000
    for line in drive.streams["gps"] + drive.streams["frames"]:
        line["time"] = 1.0 + (line["time"] - 1.0) / 30
    messages = [message for _, message in reported(drive, "stream-rate")]
    assert messages == ["comes at 300 Hz; expected 1 to 100 Hz", "comes at 150 Hz; expected 0 to 100 Hz"]


def test_streams_that_end_early_or_start_late_are_reported(reported, drive):
    assert reported(drive, "streams-together") == []
    drive.streams["frames"] = drive.streams["frames"][60:]
    drive.streams["gps"] = drive.streams["gps"][:30]
    assert reported(drive, "streams-together") == [
        ("data.jsonl: camera0", "starts at 7.004 s, 6.004 s later than others; expected within 5 s"),
        ("data.jsonl: gps", "ends at 6.800 s, 6.150 s earlier than others; expected within 5 s"),
    ]


def test_images_beyond_the_imu_are_reported(reported, drive):
    for name in ("accelerometer", "gyroscope"):
        drive.streams[name] = drive.streams[name][300:]
    [(_, message)] = reported(drive, "frames-far-from-imu")
    assert message.startswith("camera0 at 1.003700 s is 2.996 s from the nearest sample of the gyroscope")
    assert message.endswith("found up to 2.996 s in 29 of 120 images")  # of the first 3 s, but for the last 0.1 s


def test_images_timestamped_by_the_imu_are_a_hint(reported, drive):
    drive.shifted("frames", -0.0037)
    for line in drive.streams["frames"]:
        line["time"] = round(line["time"], 9)
    [(_, message)] = reported(drive, "frames-at-imu-times")
    assert message.startswith("100% of the images have the very time of a sample of the accelerometer")


def test_an_accelerometer_that_is_put_off_by_more_than_one_interval_is_reported(reported, drive):
    assert reported(drive.shifted("accelerometer", 0.01), "imu-clocks") == []
    [(location, message)] = reported(drive.shifted("accelerometer", 0.02), "imu-clocks")
    assert location == "data.jsonl: accelerometer"
    assert "30.0 ms after" in message


def test_a_recording_without_imu_or_calibration_gets_warnings(written, drive):
    rules = ["imu-there", "calibration-there"]
    del drive.streams["gyroscope"]
    assert [f.message for f in validate(written(drive), rules=rules).findings] == ["no gyroscope lines"]
    del drive.streams["frames"]
    folder = written(drive)
    (folder / "calibration.json").unlink()
    report = validate(folder, rules=rules)
    assert [(f.rule, f.severity) for f in report.findings] == [(rule, "warning") for rule in rules]
    assert report.findings[1].path == "calibration.json"
    assert report.passed


def test_a_file_of_lines_alone_is_known_by_its_name_and_needs_nothing_beside_it(tmp_path, drive):
    lines = [line["groundTruth"] | {"time": line["time"]} for line in drive.streams["groundTruth"]]
    lines[7]["time"] = lines[6]["time"]
    path = tmp_path / "vio.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines) + "{torn\n")
    assert [(f.rule, f.path) for f in validate(path).findings] == [
        ("broken-lines", "vio.jsonl: line 241"),
        ("stream-times-unique", "vio.jsonl: line 8"),
    ]
