"""Edits of real drives, and of the file that Scale's own library wrote from an Argoverse 2 log."""

from dataclasses import replace

import numpy as np
import pytest

import sceneloom
from sceneloom.editing import crop_scene, merge_scenes, thin_scene, to_ego, to_sensor, to_world
from sceneloom.editing.move_world import FrameChange, moved_world
from sceneloom.editing.references import with_ours
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import CuboidAnnotation, PointsFrame, Trajectory

FLOAT32_AT_100_M = 2e-5
"""[m] two roundings to float32 at up to 200 m."""


@pytest.fixture(scope="module", params=["pandaset", "kitti_drive"])
def scene(request, drive, tmp_path_factory):
    target = tmp_path_factory.mktemp("fused") / f"{request.param}.sfs"
    with sceneloom.open(drive(f"recordings/{request.param}")) as raw:
        sceneloom.fuse(raw, target, stop=0.25)
    with sceneloom.open(target) as fused:
        yield fused


def same_points(scene, other, *, atol=FLOAT32_AT_100_M):
    for before, after in zip(scene.lidars[0].frames, other.lidars[0].frames, strict=True):
        np.testing.assert_allclose(after.points.positions, before.points.positions, rtol=0, atol=atol)
        np.testing.assert_array_equal(after.points.colors, before.points.colors)
        np.testing.assert_array_equal(after.points.camera_index, before.points.camera_index)


@pytest.mark.few(1)
def test_a_fused_drive_seen_from_the_ego_and_back_is_the_same(scene, tmp_path):
    sceneloom.write(to_ego(scene), tmp_path / "ego.sfs")
    with sceneloom.open(tmp_path / "ego.sfs") as on_ego:
        assert on_ego.lidars[0].points_frame is PointsFrame.EGO
        again = to_world(on_ego)
        same_points(scene, again)
        for before, after in zip(scene.cameras, again.cameras, strict=True):
            # JSON holds float64 exactly; what is left is their rounding
            np.testing.assert_allclose(after.poses.positions, before.poses.positions, atol=1e-9)


def test_points_seen_from_the_sensor_are_those_that_were_measured(drive):
    with sceneloom.open(drive("recordings/pandaset")) as scene:
        same_points(scene, to_sensor(to_world(scene)))


def test_parts_and_sensors_of_a_fused_drive_are_joined_to_the_whole(scene, tmp_path):
    sceneloom.write(crop_scene(scene, stop=0.15), tmp_path / "a.sfs")
    sceneloom.write(crop_scene(scene, start=0.15), tmp_path / "b.sfs")
    with sceneloom.open(tmp_path / "a.sfs") as a, sceneloom.open(tmp_path / "b.sfs") as b:
        joined = merge_scenes([a, b], join=True)
        assert [s.id for s in joined.sensors] == [s.id for s in scene.sensors]
        same_points(scene, joined, atol=0.0)
        for before, after in zip(scene.cameras, joined.cameras, strict=True):
            assert after.images.timestamps_ns.tolist() == before.images.timestamps_ns.tolist()
    first = scene.cameras[0].id
    merged = merge_scenes([crop_scene(scene, without=[first]), crop_scene(scene, sensors=[first, "ego"])])
    assert {s.id for s in merged.sensors} == {s.id for s in scene.sensors}


def test_a_drive_with_another_origin_is_brought_into_the_world_of_the_first(scene):
    rotation = np.array([0.0, 0, np.sin(0.7), np.cos(0.7)])
    other_from_file = RigidTransform.from_quaternion(np.array([40.0, -25.0, 3.0]), rotation)
    world_from_other = np.array(scene.metadata["sceneloom"]["world_from_file"]) @ other_from_file.inverse().matrix
    moved = moved_world(scene, FrameChange.constant(other_from_file))
    merged = merge_scenes([scene, with_ours(moved, world_from_file=world_from_other.tolist())], rename=True)
    for before, after in zip(merged.lidars[0].frames, merged.lidars[1].frames, strict=True):
        np.testing.assert_allclose(after.points.positions, before.points.positions, atol=2 * FLOAT32_AT_100_M)
    first, second = merged.cameras[0], merged.sensor(f"{scene.cameras[0].id}-2")
    np.testing.assert_allclose(second.poses.positions, first.poses.positions, atol=1e-9)


def test_thinned_points_are_some_of_those_there_were(scene):
    before = scene.lidars[0].frames[0].points
    after = thin_scene(scene, voxel=0.5).lidars[0].frames[0].points
    cubes = np.floor(after.positions.astype(np.float64) / 0.5)
    assert len(np.unique(cubes, axis=0)) == len(after) < len(before) / 2
    rows = {row.tobytes() for row in before.positions}
    assert all(row.tobytes() in rows for row in after.positions)


@pytest.fixture
def cuboids(drive):
    """Cuboids and sweeps of Argoverse 2, written by Scale's library."""
    with sceneloom.open(drive("real/sfs_reference/argoverse2_2frames_cuboids.sfs")) as scene:
        yield scene


def test_cropped_cuboids_have_their_points(cuboids):
    near = crop_scene(cuboids, reach=30.0)
    kept = {annotation.id for annotation in near.annotations}
    for annotation in cuboids.annotations:
        centers = annotation.path.values[:, None, 3:6] - cuboids.lidars[0].poses.positions
        away = np.linalg.norm(centers, axis=2).min()
        # the lidar and the boxes move less than a metre between two sweeps
        assert (annotation.id in kept) == (away <= 30.0) or abs(away - 30.0) < 1.0
    assert 0 < len(kept) < 81
    assert 0 < sum(len(frame.points) for frame in near.lidars[0].frames) < 24838


def test_cuboids_of_another_library_come_back_from_the_ego(cuboids):
    poses = cuboids.lidars[0].poses
    trajectory = Trajectory("own", poses.timestamps_ns, poses.positions, poses.quaternions_xyzw)
    again = to_world(to_ego(replace(cuboids, trajectories={"own": trajectory})))
    for before, after in zip(cuboids.annotations, again.annotations, strict=True):
        np.testing.assert_allclose(after.path.values, before.path.values, atol=1e-6)


@pytest.fixture(scope="module")
def reference(drive):
    return drive("real/sfs_reference/argoverse2_2frames_cuboids.sfs")


def test_its_two_frames_and_81_cuboids_are_whole_and_come_back_from_a_file_of_ours(reference, tmp_path, decode_sfs):
    scene, raw = FORMAT.open(reference), decode_sfs(reference.read_bytes())
    assert [len(frame.points) for frame in scene.lidars[0].frames] == [12404, 12434]
    for frame, expected in zip(scene.lidars[0].frames, raw["sensors"][0]["frames"], strict=True):
        assert frame.timestamp_ns == expected["timestamp"] * 1000
        for name in ("positions", "intensities"):
            np.testing.assert_array_equal(getattr(frame.points, name), expected["points"][name])
    assert len(scene.annotations) == 81
    write_scene(scene, tmp_path / "again.sfs")
    second = FORMAT.open(tmp_path / "again.sfs")
    for read, again, expected in zip(scene.annotations, second.annotations, raw["annotations"], strict=True):
        assert isinstance(read, CuboidAnnotation)
        assert (read.id, read.extras) == (expected["id"], {})
        stated = [record["name"] for record in expected["attributes"] or []]
        assert [attribute.name for attribute in read.attributes] == stated
        for found in (read, again):
            assert found.path.timestamps_ns.tolist() == [1000 * time for time in expected["path"]["timestamps"]]
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
