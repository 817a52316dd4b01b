"""All faults of a file at once, with the scene of all that is sound."""

import json

import numpy as np
import pytest
from tests.unit.formats.sfs.conftest import make

from sceneloom.errors import DataError
from sceneloom.formats.sfs.reader import examine
from sceneloom.formats.sfs.spec import ReadingOptions

POSE = [0, 0, 0, 0, 0, 0, 1]
PATH = {"timestamps": [0], "values": [[1, 1, 1, 0, 0, 0, 0, 0, 0]]}


@pytest.fixture
def examined(tmp_path, encode_sfs):
    """Write a header through the independent writer, and examine the file."""

    def run(header, **options):
        path = tmp_path / "scene.sfs"
        path.write_bytes(encode_sfs(header))
        return examine(path, ReadingOptions(**options))

    return run


def placed(examination):
    return [(fault.where, fault.code) for fault in examination.faults]


def frame(**points):
    return {"timestamp": 0, "points": {"positions": np.ones((2, 3), np.float32), **points}}


def test_what_is_kept_knows_its_location_in_the_file(examined):
    sound = examined(make.scene(make.lidar(), annotations=[{"id": 1, "type": "object"}]))
    assert (sound.faults, sound.header["version"]) == ((), "1.0")
    assert (sound.sensor_paths, sound.annotation_paths) == (("sensors[0]",), ("annotations[0]",))
    annotations = [{"id": 1}, {"id": 2, "type": "group"}]
    ours = {"annotations": [{"id": 3, "type": "group"}]}
    found = examined(make.scene({"id": "x"}, make.lidar(), annotations=annotations, metadata={"sceneloom": ours}))
    assert found.sensor_paths == ("sensors[1]",)
    assert found.annotation_paths == ("annotations[1]", "metadata.sceneloom.annotations[0]")


def test_faults_of_every_part_are_found_at_once(examined):
    shorter = {"colors": np.zeros((3, 3), np.uint8), "intensities": np.zeros(2, np.float32)}
    bad_frames = [frame(), frame(**shorter), {"timestamp": 5}]
    longer = {"timestamps": [0], "values": [[0, 0, 0, 0, 0, 0, 2]]}
    sensors = (make.lidar(), make.lidar(id="second", frames=bad_frames, coordinates=5, poses=longer), {"id": "x"})
    annotations = [
        {"id": 1, "type": "cuboid", "path": PATH},
        {"id": 2, "type": "cuboid", "path": {"timestamps": [0]}},
        {"id": 3, "type": "link", "from_id": 1},
    ]
    examination = examined(make.scene(*sensors, version="9", time_unit="hours", annotations=annotations))
    assert placed(examination) == [
        ("version", "version"),
        ("time_unit", "malformed"),
        ("sensors[1].frames[1].points.intensities ($items[4])", "malformed"),
        ("sensors[1].frames[2].points", "malformed"),
        ("sensors[1].coordinates", "malformed"),
        ("sensors[1].frames[1].points.colors ($items[3])", "malformed"),
        ("sensors[1].poses.values[0]", "quaternion-norm"),
        ("sensors[2].type", "malformed"),
        ("annotations[1].path.values", "malformed"),
        ("annotations[2].to_id", "malformed"),
    ]
    assert [fault.vital for fault in examination.faults[:3]] == [True, True, False]
    assert [sensor.id for sensor in examination.scene.sensors] == ["top"]
    assert [annotation.id for annotation in examination.scene.annotations] == [1]
    costs = [*["lidar 'second'"] * 4, "", "sensors[2]", "cuboid 2", "link 3"]
    assert [fault.costs for fault in examination.faults[2:]] == costs
    # of two with one id the first is kept
    sensors = (make.lidar(), make.lidar(frames=[]), make.lidar(id=1), make.lidar(id="1"))
    annotations = [{"id": 1, "type": "group"}, {"id": 1, "type": "object"}]
    examination = examined(make.scene(*sensors, annotations=annotations))
    assert placed(examination) == [("sensors[1].id", "duplicate-id"), ("annotations[1].id", "duplicate-id")]
    assert [len(sensor.frames) for sensor in examination.scene.sensors] == [1, 1, 1]
    assert examination.scene.annotations[0].type == "group"
    assert examination.sensor_paths == ("sensors[0]", "sensors[2]", "sensors[3]")


def test_quaternions_are_normalised_and_each_is_reported_unless_they_report_no_direction(examined):
    rows = [POSE, [1, 0, 0, 0, 0, 1.5, 2], [2, 0, 0, 0, 0, 0, 1.009]]
    examination = examined(make.scene(make.lidar(poses={"timestamps": [0, 1, 2], "values": rows})))
    assert placed(examination) == [("sensors[0].poses.values[1]", "quaternion-norm")]
    assert examination.faults[0].repaired
    poses = examination.scene.sensors[0].poses
    assert poses.quaternions_xyzw.tolist() == [[0, 0, 0, 1], [0, 0, 0.6, 0.8], [0, 0, 0, 1.009]]
    assert poses.positions[1].tolist() == [1, 0, 0]
    for quaternion in ([0, 0, 0, 0], [0, 0, 1e-5, 0], [1e200, 1e200, 1e200, 1e200]):
        poses = {"timestamps": [0], "values": [[0, 0, 0, *quaternion]]}
        examination = examined(make.scene(make.lidar(poses=poses)))
        assert placed(examination) == [("sensors[0].poses.values[0]", "malformed")]
        assert [(sensor.id, sensor.poses) for sensor in examination.scene.sensors] == [("top", None)]
    # they are sorted and taken once, unless two of one time differ
    rows = [[k, *POSE[1:]] for k in (0, 2, 1, 1)]
    examination = examined(make.scene(make.lidar(poses={"timestamps": [0, 20, 10, 10], "values": rows})))
    assert placed(examination) == [
        ("sensors[0].poses.timestamps[2]", "pose-times-increasing"),
        ("sensors[0].poses.timestamps[3]", "pose-times-increasing"),
    ]
    poses = examination.scene.sensors[0].poses
    assert poses.timestamps_ns.tolist() == [0, 10_000, 20_000]
    assert poses.positions[:, 0].tolist() == [0, 1, 2]
    rows = [POSE, POSE, [1, *POSE[1:]], POSE]
    left = examined(make.scene(make.lidar(poses={"timestamps": [0, 7, 7, 9], "values": rows})))
    assert [(fault.path, fault.repaired) for fault in left.faults] == [
        ("sensors[0].poses.values[1]", False),
        ("sensors[0].poses.values[2]", False),
    ]
    assert left.scene.sensors[0].poses.timestamps_ns.tolist() == [0, 9_000]


def test_arrays_and_poses_at_fault_are_all_reported_and_once_and_a_file_without_a_header_is_one_fault(
    tmp_path, encode_sfs
):
    path = tmp_path / "scene.sfs"
    path.write_bytes(encode_sfs(make.scene(make.lidar(), make.lidar(id="b"), make.lidar(id="c")))[:-35])
    examination = examine(path)
    assert placed(examination) == [
        ("sensors[1].frames[0].points.positions ($items[1])", "item"),
        ("sensors[2].frames[0].points.positions ($items[2])", "item"),
    ]
    assert [(sensor.id, len(sensor.frames)) for sensor in examination.scene.sensors] == [("top", 1), ("b", 0), ("c", 0)]
    poses = {"timestamps": [0, 1, 2], "values": [POSE, [float("nan"), *POSE[1:]], [*POSE[:6], float("inf")]]}
    path.write_bytes(json.dumps(make.scene({"id": "ego", "type": "odometry", "poses": poses})).encode())
    assert placed(examine(path)) == [(f"sensors[0].poses.values[{k}]", "not-finite") for k in (1, 2)]
    path.write_bytes(b'{"version": "1.0", "sensors": [')
    examination = examine(path)
    assert (examination.scene, placed(examination)) == (None, [("header", "unreadable")])


def test_faults_of_our_metadata_leave_the_rest_of_it(examined, open_header):
    ours = {"sensor_notes": [{"model": "x"}, {"id": "top", "model": "VLP-16"}], "warnings": [{}], "sensors": 5}
    examination = examined(make.scene(make.lidar(), metadata={"sceneloom": ours, "mine": 1}))
    assert ("metadata.sceneloom.sensor_notes[0].id", "malformed") in placed(examination)
    assert examination.scene.sensors[0].model == "VLP-16"
    assert examination.scene.metadata["mine"] == 1
    # and lenient reading keeps what was brought into order, with a warning
    header = make.scene(make.lidar(poses={"timestamps": [0], "values": [[0, 0, 0, 0, 0, 0, 2]]}))
    with pytest.raises(DataError, match="norm 2; expected 1"):
        open_header(header)
    with open_header(header, lenient=True) as scene:
        assert scene.sensors[0].poses.quaternions_xyzw.tolist() == [[0, 0, 0, 1]]
        assert [warning.code for warning in scene.warnings if warning.kind == "repaired"] == ["repaired"]
