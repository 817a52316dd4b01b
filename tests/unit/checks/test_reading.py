"""Rules about what cannot be read, and what readers remarked, on files."""

import numpy as np
import pytest

import sceneloom
from sceneloom.checks.faults import FAULT_RULES
from sceneloom.errors import DataError
from sceneloom.scene import DataWarning, LazyFrames, LidarSensor, WarningKind

POSE = [0, 0, 0, 0, 0, 0, 1]


def lidar(**fields):
    return {
        "id": "top",
        "type": "lidar",
        "poses": {"timestamps": [0], "values": [POSE]},
        "frames": [{"timestamp": 0, "points": {"positions": np.ones((2, 3), np.float32)}}],
        **fields,
    }


def header(*sensors, **fields):
    return {"version": "1.0", "sensors": list(sensors or [lidar()]), **fields}


@pytest.fixture
def file_of(tmp_path, encode_sfs):
    """Write a header through the independent writer; cut so many bytes off."""

    def write(content, *, cut=0):
        path = tmp_path / "scene.sfs"
        encoded = content if isinstance(content, bytes) else encode_sfs(content)
        path.write_bytes(encoded[: len(encoded) - cut])
        return path

    return write


def poses(*rows, times=None):
    return {"timestamps": list(times or range(len(rows))), "values": list(rows)}


FAULTY = {
    "file-readable": (b'{"version": "1.0", "sens', "header"),
    "version-known": (header(version="2.0"), "version"),
    "fields-valid": (header(lidar(coordinates="map")), "sensors[0].coordinates"),
    "ids-unique": (header(lidar(), lidar()), "sensors[1].id"),
    "quaternion-norm": (header(lidar(poses=poses([0, 0, 0, 0, 0, 0, 3]))), "sensors[0].poses.values[0]"),
    "pose-times-increasing": (
        header(lidar(poses=poses(POSE, POSE, times=[5, 4]))),
        "sensors[0].poses.timestamps[1]",
    ),
    "poses-finite": (
        header(lidar(poses=poses([float("nan"), *POSE[1:]]))),
        "sensors[0].poses.values[0]",
    ),
}


@pytest.mark.parametrize("rule", FAULTY)
def test_a_fault_of_a_file_is_known_by_its_rule_alone(file_of, found, rule):
    content, location = FAULTY[rule]
    path = file_of(content)
    assert [where for where, _ in found(path, rule)] == [location]
    others = [other.id for other in FAULT_RULES if other.id != rule]
    assert [hit for other in others for hit in found(path, other)] == []


def test_an_array_that_is_cut_off_is_reported(file_of, found):
    path = file_of(header(), cut=20)
    assert [where for where, _ in found(path, "arrays-whole")] == [
        "sensors[0].frames[0].points.positions ($items[0])"
    ]


def test_a_sound_file_keeps_all_of_them(file_of, found):
    path = file_of(header(lidar(poses=poses(POSE, POSE))))
    assert [hit for rule in FAULT_RULES for hit in found(path, rule.id)] == []


class Broken:
    """Reads the first frame and no other."""

    def __init__(self, first):
        self.first = first

    def __call__(self, k):
        if k:
            raise DataError("drive", f"frames[{k}]", "is torn")
        return self.first


def test_a_frame_that_cannot_be_read_is_a_finding(sound, found):
    frames = LazyFrames(sound.times(3), Broken(sound.sweep(0)))
    scene = sound.scene(LidarSensor("top", frames, poses=sound.path()))
    assert found(scene, "frame-readable") == [
        ("sensors[0].frames[1]", "drive: frames[1]: is torn"),
        ("sensors[0].frames[2]", "drive: frames[2]: is torn"),
    ]
    assert found(scene, "frame-readable", frames=False) == []
    assert found(sound.scene(), "frame-readable") == []


@pytest.mark.parametrize("kind", list(WarningKind))
def test_notes_of_readers_are_hints(sound, found, kind):
    rule = f"reading-{kind}"
    note = DataWarning(kind=kind, code="lines-sorted", location="data.jsonl", message="so", count=3)
    reported_elsewhere = DataWarning(kind=kind, code="no-poses", location="sensors[0]", message="none")
    scene = sound.scene(warnings=(note, reported_elsewhere))
    assert found(scene, rule) == [("data.jsonl", "so")]
    assert found(sound.scene(), rule) == []


def test_what_was_remarked_when_a_file_was_made_is_not_remarked_again(file_of, tmp_path, found):
    path, written = file_of(header()), tmp_path / "written.sfs"
    assert [where for where, _ in found(path, "reading-assumed")] == ["sensors[0]"]
    with sceneloom.open(path) as scene:
        sceneloom.write(scene, written)
    with sceneloom.open(written) as scene:
        assert scene.warnings
    assert found(written, "reading-assumed") == []


def test_a_broken_recording_is_checked_without_what_is_broken(tmp_path, sound, found):
    folder = tmp_path / "drive"
    sceneloom.write(sound.scene(sound.lidar(), sound.odometry()), folder)
    lines = (folder / "data.jsonl").read_text("utf-8").splitlines()
    (folder / "data.jsonl").write_text("\n".join([lines[0], "{torn", *lines[1:]]), "utf-8")
    [(location, message)] = found(folder, "broken-lines")
    assert location == "data.jsonl: line 2"
    assert "{torn" in message
    assert found(folder, "file-readable") == []
    assert found(folder, "sensor-empty") == []
