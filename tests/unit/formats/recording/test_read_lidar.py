"""Reading lidar binaries: every field, lazily, and files that are not what a line says."""

import re
import struct
import sys

import numpy as np
import pytest

from sceneloom.errors import CalibrationError, DataError
from sceneloom.scene import WarningKind

POINTS = [
    (1.5, -2.25, 0.125, 200, 17, 0.100000001),
    (-30.0, 4.0, 5.5, 0, 65535, 0.15),
    (1e-3, 2e6, -3.75, 255, 0, -0.25),
]
SHIFTED = [[1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]]


def sweep(file, time, **further):
    return {"lidar": {"model": "RoboSense M1 XYZIRT", "dataFile": file, **further}, "time": time}


def test_points_hold_what_the_records_hold(recording):
    recording.points("lidar/0.bin", POINTS).lines([sweep("lidar/0.bin", 0.1)])
    lidar = recording.open().lidars[0]
    assert (lidar.id, lidar.model, len(lidar.frames)) == ("lidar", "RoboSense M1 XYZIRT", 1)
    frame = lidar.frames[0]
    assert frame.timestamp_ns == 100_000_000
    assert frame.extras == {"file_seconds": 0.1, "dataFile": "lidar/0.bin"}
    content = (recording.path / "lidar/0.bin").read_bytes()
    assert len(content) == 23 * 3
    x, y, z, intensity, ring, time = zip(*struct.iter_unpack("<fffBHd", content), strict=True)
    np.testing.assert_array_equal(frame.points.positions, np.array([x, y, z], np.float32).T)
    expected = {"intensities": intensity, "rings": ring, "timestamps_ns": [round(t * 1e9) for t in time]}
    for name, values in expected.items():
        assert getattr(frame.points, name).tolist() == list(values)
    assert frame.points.extras["file_seconds"].tolist() == list(time)
    for name in ("positions", *expected):
        flags = getattr(frame.points, name).flags
        assert (flags.writeable, flags.aligned) == (False, True)
    # those of one point or none are aligned, too, and points that are not numbers stay
    recording.points("0.bin", POINTS[:1]).points("1.bin", [])
    recording.points("2.bin", [(float("nan"), 1.0, 2.0, 3, 4, 0.5), POINTS[0]])
    scene = recording.lines([sweep(f"{k}.bin", 0.5 * k) for k in range(3)]).open()
    one, none, nowhere = scene.lidars[0].frames
    assert one.points.rings.flags.aligned
    assert one.points.rings.tolist() == [17]
    assert (len(none.points), none.reference_ns) == (0, 500_000_000)
    np.testing.assert_array_equal(nowhere.points.positions[0], np.array([np.nan, 1.0, 2.0], np.float32))


@pytest.mark.skipif(sys.platform == "win32", reason="a file that is read cannot be removed there")
def test_points_are_counted_without_being_unpacked_and_outlive_their_file(recording):
    recording.points("0.bin", POINTS).lines([sweep("0.bin", 0.1)])
    points = recording.open().lidars[0].frames[0].points
    assert (len(points), points.packed_count()) == (3, 3)
    (recording.path / "0.bin").unlink()
    np.testing.assert_array_equal(points.positions, np.array([p[:3] for p in POINTS], np.float32))


def test_a_point_time_may_be_any_that_nanoseconds_hold_and_others_are_faults_of_their_record(recording):
    sound = [9.2e9, -9.2e9, 2.0**33, 2.0**33 - 1e-6, 0.0, -0.0, 5e-324, -1e-9]
    wrong = [*map(float, ["nan", "-nan", "inf", "-inf"]), 9.3e9, -9.3e9, 1e300]
    for k, time in enumerate([*sound, *wrong]):
        recording.points(f"{k}.bin", [POINTS[0], (*POINTS[1][:5], time)])
    frames = recording.lines(sweep(f"{k}.bin", 0.5 + k) for k in range(15)).open().lidars[0].frames
    for k, time in enumerate(sound):
        assert frames[k].points.timestamps_ns.tolist() == [100_000_001, round(time * 1e9)]
    for k, time in enumerate(wrong, len(sound)):
        with pytest.raises(DataError, match=r"\.bin: record 1 \(byte 23\): timestamp .*expected seconds") as caught:
            _ = frames[k]
        assert f"{time}" in caught.value.problem


def test_a_missing_or_cut_file_is_a_fault_of_its_line_when_it_is_read_and_left_out_when_lenient(recording):
    (recording.path / "folder").mkdir()
    recording.points("0.bin", POINTS).points("1.bin", POINTS, extra=b"\0").points("22.bin", POINTS, extra=bytes(22))
    problems = {
        "missing.bin": r"data\.jsonl: line 1: lidar\.dataFile: 'missing.bin': no such file",
        "folder": r"data\.jsonl: line 2: lidar\.dataFile: 'folder': no such file",
        "1.bin": r"1\.bin: byte 69: .* 3 records .* remainder of 1;",
        "22.bin": r"22\.bin: byte 69: .* 3 records .* remainder of 22;",
    }
    recording.lines([sweep(name, 0.1 * k) for k, name in enumerate([*problems, "0.bin"])])
    frames = recording.open().lidars[0].frames
    for k, problem in enumerate(problems.values()):
        with pytest.raises(DataError, match=problem):
            _ = frames[k]
    assert len(frames[4].points) == 3
    scene = recording.open(lenient=True)
    assert [frame.timestamp_ns for frame in scene.lidars[0].frames] == [400_000_000]
    skipped = next(warning for warning in scene.warnings if warning.code == "unusable-lidar-files")
    assert (skipped.kind, skipped.count) == (WarningKind.SKIPPED, 4)


def test_names_and_links_that_lead_out_of_the_folder_are_refused_and_others_followed(recording, tmp_path):
    recording.points("../outside.bin", POINTS).points("own.bin", POINTS)
    outside = ("/etc/passwd", "../outside.bin", "lidar/../../outside.bin", "C:\\points.bin", "..\\points.bin")
    for file in (*outside, "", "a\0b"):
        problem = r"line 1: lidar\.dataFile: .*expected a path inside the recording's folder"
        with pytest.raises(DataError, match=problem):
            recording.lines([sweep(file, 0.0)]).open()
    (recording.path / "0.bin").symlink_to(tmp_path / "outside.bin")
    (recording.path / "lidar").symlink_to(tmp_path)
    (recording.path / "1.bin").symlink_to("own.bin")
    recording.lines([sweep("0.bin", 0.0), sweep("lidar/outside.bin", 0.1), sweep("1.bin", 0.2)])
    frames = recording.open().lidars[0].frames
    for k in range(2):
        with pytest.raises(DataError, match=f"line {k + 1}: .* by a link"):
            _ = frames[k]
    assert len(frames[2].points) == 3


def test_several_lidars_are_distinguished_by_their_index_and_mounted_by_the_inverse_of_imu_to_lidar(recording):
    recording.points("a.bin", POINTS).points("b.bin", POINTS[:2]).lines([sweep("a.bin", 0.0)])
    for entries in (None, [], [{"model": "RoboSense M1 XYZIRT"}]):
        scene = (recording if entries is None else recording.calibration(lidars=entries)).open()
        np.testing.assert_array_equal(scene.lidars[0].mount.matrix, np.eye(4))
        assert [(n.code, n.kind) for n in scene.warnings] == [("lidar-mount-identity", WarningKind.ASSUMED)]
    # unsorted sweeps come in the order of time with their own files
    frames = recording.lines([sweep("a.bin", 0.2), sweep("b.bin", 0.1)]).open().lidars[0].frames
    assert [(frame.timestamp_ns, len(frame.points)) for frame in frames] == [(100_000_000, 2), (200_000_000, 3)]
    recording.lines([sweep("a.bin", 0.0), sweep("b.bin", 0.05, lidarInd=1), sweep("a.bin", 0.1, lidarInd=0)])
    recording.calibration(lidars=[{"lidarInd": 1, "imuToLidar": SHIFTED}, {"imuToLidar": np.eye(4).tolist()}])
    scene = recording.open()
    found = {s.id: ([len(f.points) for f in s.frames], s.mount.translation.tolist()) for s in scene.lidars}
    assert found == {"lidar0": ([3, 3], [0.0, 0.0, 0.0]), "lidar1": ([2], [-1.0, -2.0, -3.0])}
    assert scene.lidars[1].extras["calibration"]["imuToLidar"] == SHIFTED
    assert scene.warnings == ()

    # entries of the calibration that contradict are faults
    recording.lines([sweep("a.bin", 0.0)])
    skewed = [{"imuToLidar": np.diag([2.0, 1.0, 1.0, 1.0]).tolist()}]
    for entries, error, problem in (
        ([{}, {}], DataError, "lidars[1]: lidarInd 0 is used twice"),
        ([{"lidarInd": 1}, {"lidarInd": 1}], DataError, "lidars[1]: lidarInd 1 is used twice"),
        (skewed, CalibrationError, "lidars[0].imuToLidar: rotation off by 3"),
    ):
        recording.calibration(lidars=entries)
        with pytest.raises(error, match=re.escape(f"{recording.path / 'calibration.json'}: {problem}")):
            recording.open()
        assert len(recording.open(lenient=True).lidars) == 1
