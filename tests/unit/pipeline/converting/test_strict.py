"""Conversions that refuse to lose anything, and reports in files."""

import json

import numpy as np
import pytest

from sceneloom.errors import LossError, OptionError, OutputError
from sceneloom.formats import open_scene, write_scene
from sceneloom.formats.base.losses import Support
from sceneloom.pipeline import convert
from sceneloom.scene import (
    EventAnnotation,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsFrame,
    Poses,
    Scene,
    Trajectory,
)

TIMESTAMPS = np.array([1_000_000_000, 1_100_000_000])
TRAJECTORY = Poses(TIMESTAMPS, np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.tile([0.0, 0, 0, 1], (2, 1)))


def drive(*, events=(), points_ns=0):
    frames = [
        LidarFrame(int(t), LidarPoints(np.ones((4, 3), np.float32), timestamps_ns=np.full(4, t + points_ns)))
        for t in TIMESTAMPS
    ]
    lidar = LidarSensor(
        "top", LazyFrames.of(frames, TIMESTAMPS.tolist()), TRAJECTORY, points_frame=PointsFrame.WORLD
    )
    trajectory = Trajectory("trajectory", TIMESTAMPS, TRAJECTORY.positions, TRAJECTORY.quaternions_xyzw)
    return Scene((lidar,), annotations=events, trajectories={"trajectory": trajectory})


@pytest.fixture
def scene_file(tmp_path):
    write_scene(drive(), tmp_path / "drive.sfs")
    return tmp_path / "drive.sfs"


@pytest.fixture
def with_event(tmp_path):
    write_scene(drive(events=(EventAnnotation("e", int(TIMESTAMPS[0])),)), tmp_path / "event.sfs")
    return tmp_path / "event.sfs"


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_strict_conversion_that_loses_nothing_is_written(scene_file, tmp_path):
    report = convert(scene_file, tmp_path / "copy.sfs", strict=True)
    assert (report.written, report.lost) == (True, ())
    with open_scene(tmp_path / "copy.sfs") as copy:
        assert len(copy.lidars[0].frames) == 2
    assert names(tmp_path) == ["copy.sfs", "drive.sfs"]


def test_what_is_known_beforehand_is_refused_before_anything_is_written(with_event, tmp_path, monkeypatch):
    monkeypatch.setattr("sceneloom.formats.recording.writer.write_recording", None)
    with pytest.raises(LossError, match=r"recording would not hold all: .*annotations.event.id") as caught:
        convert(with_event, tmp_path / "drive", strict=True, loss=tmp_path / "loss.json")
    assert names(tmp_path) == ["event.sfs", "loss.json"]
    reported = json.loads((tmp_path / "loss.json").read_text())
    assert reported["written"] is False
    assert {"field": "annotations.event.id", "support": "dropped"}.items() <= {
        key: value
        for row in reported["fields"]
        if row["field"] == "annotations.event.id"
        for key, value in row.items()
    }.items()
    assert caught.value.report.written is False


def test_what_shows_only_while_writing_leaves_nothing_behind(tmp_path):
    write_scene(drive(points_ns=500), tmp_path / "drive.sfs", time_unit="nanoseconds")
    with open_scene(tmp_path / "drive.sfs") as scene:
        assert scene.lidars[0].frames[0].points.timestamps_ns[0] == TIMESTAMPS[0] + 500
    with pytest.raises(LossError, match=r"'lidar'|points_frame|model|poses"):
        convert(tmp_path / "drive.sfs", tmp_path / "trajectory", strict=True)
    assert names(tmp_path) == ["drive.sfs"]


def test_rounding_to_other_units_is_no_loss(tmp_path):
    write_scene(drive(points_ns=500), tmp_path / "drive.sfs", time_unit="nanoseconds")
    report = convert(tmp_path / "drive.sfs", tmp_path / "copy.sfs", strict=True, time_unit="microseconds")
    rounded = {field.field: field for field in report.of_support(Support.CONVERTED)}
    assert rounded["sensors.lidar.frames.points.timestamps_ns"].largest_error == 0.5


def test_strict_output_replaces_only_where_it_may(scene_file, tmp_path):
    (tmp_path / "copy.sfs").write_bytes(b"mine")
    with pytest.raises(OutputError, match="exists already"):
        convert(scene_file, tmp_path / "copy.sfs", strict=True)
    assert (tmp_path / "copy.sfs").read_bytes() == b"mine"
    convert(scene_file, tmp_path / "copy.sfs", strict=True, overwrite=True)
    with open_scene(tmp_path / "copy.sfs") as copy:
        assert copy.lidars[0].id == "top"


def test_a_trajectory_out_of_a_drive_says_what_stays_behind(scene_file, tmp_path):
    report = convert(scene_file, tmp_path / "trajectory.jsonl")
    supports = {field.field: field.support for field in report.fields}
    assert supports["trajectories.positions"] == supports["trajectories.name"] == Support.KEPT
    assert supports["sensors.lidar.frames.points.positions"] == Support.DROPPED
    with pytest.raises(LossError, match="jsonl would not hold all"):
        convert(scene_file, tmp_path / "again.jsonl", strict=True)
    assert "again.jsonl" not in names(tmp_path)


def test_a_trajectory_from_form_to_form_loses_nothing(tmp_path, scene_file):
    convert(scene_file, tmp_path / "trajectory.jsonl")
    report = convert(tmp_path / "trajectory.jsonl", tmp_path / "trajectory.tum")
    assert [field.field for field in report.lost] == ["trajectories.name"]


@pytest.mark.parametrize("suffix", [".md", ".txt"])
def test_a_report_for_people_names_every_field(with_event, tmp_path, suffix):
    report = convert(with_event, tmp_path / "drive", loss=tmp_path / f"loss{suffix}")
    text = (tmp_path / f"loss{suffix}").read_text()
    assert report.fields
    assert all(field.field in text for field in report.fields)
    assert f"{with_event.name} (sfs) → drive (recording)" in text


def test_a_report_whose_name_says_no_form_is_refused_before_anything_is_done(scene_file, tmp_path):
    with pytest.raises(OptionError, match=r"suffix '.pdf'; a loss report is written as .json, .md, .txt"):
        convert(scene_file, tmp_path / "drive", loss=tmp_path / "loss.pdf")
    assert names(tmp_path) == ["drive.sfs"]


def test_a_format_that_is_only_read_is_refused_as_a_target(scene_file, tmp_path):
    with pytest.raises(OptionError, match="the format rig is only read; written are sfs, recording"):
        convert(scene_file, tmp_path / "drive", to="rig")
