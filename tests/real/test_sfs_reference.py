"""The file that Scale's own library wrote from an Argoverse 2 log."""

import numpy as np
import pytest

from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.scene import CuboidAnnotation


@pytest.fixture(scope="module")
def reference(data_dir):
    return data_dir / "real" / "sfs_reference" / "argoverse2_2frames_cuboids.sfs"


def test_it_holds_two_frames_and_81_cuboid_tracks(reference, decode_sfs):
    scene = FORMAT.open(reference)
    raw = decode_sfs(reference.read_bytes())
    assert [len(frame.points) for frame in scene.lidars[0].frames] == [12404, 12434]
    assert len(scene.annotations) == 81
    for index, frame in enumerate(scene.lidars[0].frames):
        expected = raw["sensors"][0]["frames"][index]
        assert frame.timestamp_ns == expected["timestamp"] * 1000
        np.testing.assert_array_equal(frame.points.positions, expected["points"]["positions"])
        np.testing.assert_array_equal(frame.points.intensities, expected["points"]["intensities"])
    for annotation, expected in zip(scene.annotations, raw["annotations"], strict=True):
        assert (annotation.id, annotation.label) == (expected["id"], expected["label"])
        np.testing.assert_array_equal(annotation.path.values, expected["path"]["values"])


def test_its_cuboids_are_whole_and_come_back_from_a_file_of_ours(reference, tmp_path, decode_sfs):
    raw = decode_sfs(reference.read_bytes())["annotations"]
    write_scene(FORMAT.open(reference), tmp_path / "again.sfs")
    first, second = FORMAT.open(reference), FORMAT.open(tmp_path / "again.sfs")
    for read, again, expected in zip(first.annotations, second.annotations, raw, strict=True):
        assert isinstance(read, CuboidAnnotation)
        assert read.extras == {}
        stated = expected["attributes"] or []
        assert [attribute.name for attribute in read.attributes] == [record["name"] for record in stated]
        for found in (read, again):
            timestamps = [1000 * timestamp for timestamp in expected["path"]["timestamps"]]
            assert found.path.timestamps_ns.tolist() == timestamps
            np.testing.assert_array_equal(found.path.values, expected["path"]["values"])
            assert (found.label, bool(found.stationary)) == (expected["label"], bool(expected["stationary"]))


@pytest.mark.parametrize("profile", ["sfs", "scale"])
def test_it_survives_reading_and_writing(reference, tmp_path, decode_sfs, profile):
    target = tmp_path / "again.sfs"
    report = write_scene(FORMAT.open(reference), target, profile=profile)
    before, after = decode_sfs(reference.read_bytes()), decode_sfs(target.read_bytes())
    assert len(report) == 0
    for key in ("version", "time_unit", "time_offset"):
        assert after[key] == before[key]
    assert after["metadata"]["source"] == before["metadata"]["source"]
    assert after["sensors"][0]["poses"] == before["sensors"][0]["poses"]
    for read, original in zip(after["sensors"][0]["frames"], before["sensors"][0]["frames"], strict=True):
        assert read["timestamp"] == original["timestamp"]
        for name in ("positions", "intensities"):
            np.testing.assert_array_equal(read["points"][name], original["points"][name])
    for read, original in zip(after["annotations"], before["annotations"], strict=True):
        assert read == {name: value for name, value in original.items() if value is not None}


def test_most_points_in_each_cuboid_are_near_its_middle_height(reference):
    """Points and boxes are in one frame: the boxes of the first frame hold points, as annotated boxes do."""
    scene = FORMAT.open(reference)
    positions = scene.lidars[0].frames[0].points.positions.astype(np.float64)
    holding = 0
    for annotation in scene.annotations:
        size, centre, yaw = (
            annotation.path.values[0, :3],
            annotation.path.values[0, 3:6],
            annotation.path.values[0, 8],
        )
        cos, sin = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
        local = (positions - centre) @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        holding += bool((np.abs(local) <= size / 2).all(axis=1).any())
    # one point in eight is in the file: far and hidden objects have none
    assert holding >= 30
