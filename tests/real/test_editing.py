"""Edits of real drives: fused, changed, written, read again, and compared with what they were."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sceneloom
from sceneloom.editing import crop_scene, merge_scenes, thin_scene, to_ego, to_sensor, to_world
from sceneloom.editing.move_world import FrameChange, moved_world
from sceneloom.editing.references import with_ours
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import PointsFrame, Trajectory

FLOAT32_AT_100_M = 2e-5
"""[m] two roundings to float32 at up to 200 m."""


@pytest.fixture(scope="module", params=["pandaset", "kitti_drive"])
def fused(request: pytest.FixtureRequest, data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real drive, fused."""
    target = tmp_path_factory.mktemp("fused") / f"{request.param}.sfs"
    with sceneloom.open(data_dir / "recordings" / request.param) as scene:
        sceneloom.fuse(scene, target, stop=0.25)
    return target


@pytest.fixture
def reference(data_dir: Path) -> Path:
    """Cuboids and sweeps of Argoverse 2, written by Scale's library."""
    return data_dir / "real" / "sfs_reference" / "argoverse2_2frames_cuboids.sfs"


@pytest.mark.few(1)
def test_a_fused_drive_seen_from_the_ego_and_back_is_the_same(fused: Path, tmp_path: Path) -> None:
    with sceneloom.open(fused) as scene:
        sceneloom.write(to_ego(scene), tmp_path / "ego.sfs")
        with sceneloom.open(tmp_path / "ego.sfs") as on_ego:
            again = to_world(on_ego)
            assert on_ego.lidars[0].points_frame is PointsFrame.EGO
            for before, after in zip(scene.lidars[0].frames, again.lidars[0].frames, strict=True):
                np.testing.assert_allclose(after.points.positions, before.points.positions, atol=FLOAT32_AT_100_M)
                np.testing.assert_array_equal(after.points.colors, before.points.colors)
            for before, after in zip(scene.cameras, again.cameras, strict=True):
                # JSON holds float64 exactly; what is left is their rounding
                np.testing.assert_allclose(after.poses.positions, before.poses.positions, atol=1e-9)


def test_points_seen_from_the_sensor_are_those_that_were_measured(data_dir: Path) -> None:
    with sceneloom.open(data_dir / "recordings" / "pandaset") as scene:
        back = to_sensor(to_world(scene)).lidars[0].frames
        for measured, after in zip(scene.lidars[0].frames, back, strict=True):
            np.testing.assert_allclose(after.points.positions, measured.points.positions, atol=FLOAT32_AT_100_M)


def test_parts_of_a_fused_drive_are_joined_to_the_whole(fused: Path, tmp_path: Path) -> None:
    with sceneloom.open(fused) as scene:
        sceneloom.write(crop_scene(scene, stop=0.15), tmp_path / "a.sfs")
        sceneloom.write(crop_scene(scene, start=0.15), tmp_path / "b.sfs")
        with sceneloom.open(tmp_path / "a.sfs") as a, sceneloom.open(tmp_path / "b.sfs") as b:
            joined = merge_scenes([a, b], join=True)
            assert [s.id for s in joined.sensors] == [s.id for s in scene.sensors]
            for before, after in zip(scene.lidars[0].frames, joined.lidars[0].frames, strict=True):
                np.testing.assert_array_equal(after.points.positions, before.points.positions)
                np.testing.assert_array_equal(after.points.camera_index, before.points.camera_index)
            for before, after in zip(scene.cameras, joined.cameras, strict=True):
                assert after.images.timestamps_ns.tolist() == before.images.timestamps_ns.tolist()


def test_sensors_parted_and_merged_are_the_whole(fused: Path) -> None:
    with sceneloom.open(fused) as scene:
        first = scene.cameras[0].id
        merged = merge_scenes([crop_scene(scene, without=[first]), crop_scene(scene, sensors=[first, "ego"])])
        assert {s.id for s in merged.sensors} == {s.id for s in scene.sensors}


def test_a_drive_with_another_origin_is_brought_into_the_world_of_the_first(fused: Path) -> None:
    other_from_file = RigidTransform.from_quaternion(
        np.array([40.0, -25.0, 3.0]), np.array([0.0, 0, np.sin(0.7), np.cos(0.7)])
    )
    with sceneloom.open(fused) as scene:
        world_from_file = np.array(scene.metadata["sceneloom"]["world_from_file"])
        rotated = with_ours(
            moved_world(scene, FrameChange.constant(other_from_file)),
            world_from_file=(world_from_file @ other_from_file.inverse().matrix).tolist(),
        )
        merged = merge_scenes([scene, rotated], rename=True)
        for before, after in zip(merged.lidars[0].frames, merged.lidars[1].frames, strict=True):
            np.testing.assert_allclose(after.points.positions, before.points.positions, atol=2 * FLOAT32_AT_100_M)
        first, second = merged.cameras[0], merged.sensor(f"{scene.cameras[0].id}-2")
        np.testing.assert_allclose(second.poses.positions, first.poses.positions, atol=1e-9)


def test_thinned_points_are_some_of_those_there_were(fused: Path) -> None:
    with sceneloom.open(fused) as scene:
        before = scene.lidars[0].frames[0].points
        after = thin_scene(scene, voxel=0.5).lidars[0].frames[0].points
    cubes = np.floor(after.positions.astype(np.float64) / 0.5)
    assert len(np.unique(cubes, axis=0)) == len(after) < len(before) / 2
    rows = {row.tobytes() for row in before.positions}
    assert all(row.tobytes() in rows for row in after.positions)


def test_cropped_cuboids_have_their_points(reference: Path) -> None:
    with sceneloom.open(reference) as scene:
        near = crop_scene(scene, reach=30.0)
        locations = scene.lidars[0].poses.positions
        kept = {annotation.id for annotation in near.annotations}
        for annotation in scene.annotations:
            centers = annotation.path.values[:, None, 3:6] - locations
            away = np.linalg.norm(centers, axis=2).min()
            # the lidar and the boxes move less than a metre between two sweeps
            assert (annotation.id in kept) == (away <= 30.0) or abs(away - 30.0) < 1.0
        total = sum(len(frame.points) for frame in near.lidars[0].frames)
    assert 0 < len(kept) < 81
    assert 0 < total < 24838


def test_cuboids_of_another_library_come_back_from_the_ego(reference: Path) -> None:
    with sceneloom.open(reference) as scene:
        lidar = scene.lidars[0]
        trajectory = Trajectory("own", lidar.poses.timestamps_ns, lidar.poses.positions, lidar.poses.quaternions_xyzw)
        reported = replace(scene, trajectories={"own": trajectory})
        again = to_world(to_ego(reported))
        for before, after in zip(scene.annotations, again.annotations, strict=True):
            np.testing.assert_allclose(after.path.values, before.path.values, atol=1e-6)
