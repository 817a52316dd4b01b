"""What lies in and behind annotated boxes of real drives, against the numbers that come with the data."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.scene import (
    CuboidAnnotation,
    CuboidPath,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsFrame,
    PosePath,
    Scene,
)
from sceneloom.visibility.points import count_points

ARGOVERSE_LOG = "real/argoverse2/7fab2350-7eaf-3b7e-a39d-6937a4c1bede"


def read_feather(path: Path) -> dict[str, np.ndarray]:
    """The columns of a feather file."""
    feather = pytest.importorskip("pyarrow.feather", reason="pyarrow is not installed")
    table = feather.read_table(path)
    return {name: np.asarray(table[name].to_pylist()) for name in table.column_names}


def test_points_in_the_cuboids_of_argoverse_are_as_many_as_its_annotations_say(data_dir):
    log = data_dir / ARGOVERSE_LOG
    rows, ways = read_feather(log / "annotations.feather"), read_feather(log / "city_SE3_egovehicle.feather")
    sweeps = sorted((log / "sensors" / "lidar").glob("*.feather"))
    times = np.array([int(path.stem) for path in sweeps])
    frames = []
    for time_ns, path in zip(times, sweeps, strict=True):
        columns = read_feather(path)
        positions = np.column_stack([columns[axis] for axis in "xyz"]).astype(np.float32)
        frames.append(LidarFrame(int(time_ns), LidarPoints(positions)))
    order = np.argsort(ways["timestamp_ns"])
    path = PosePath(
        ways["timestamp_ns"][order].astype(np.int64),
        np.column_stack([ways[f"t{axis}_m"] for axis in "xyz"])[order],
        np.column_stack([ways[f"q{axis}"] for axis in "xyzw"])[order],
    )
    lidar = LidarSensor("lidar", LazyFrames.of(frames, times), poses=path, points_frame=PointsFrame.SENSOR)
    cuboids, said = [], {}
    for k in np.flatnonzero(np.isin(rows["timestamp_ns"], times)):
        time_ns = int(rows["timestamp_ns"][k])
        pose = path.interpolate(np.array([time_ns]))
        world_from_ego = Rotation.from_quat(pose.quaternions_xyzw[0])
        ego_from_box = Rotation.from_quat([rows[f"q{axis}"][k] for axis in "xyzw"])
        center = world_from_ego.apply([rows[f"t{axis}_m"][k] for axis in "xyz"]) + pose.positions[0]
        angles = (world_from_ego * ego_from_box).as_euler("XYZ", degrees=True)
        size = [rows[f"{name}_m"][k] for name in ("length", "width", "height")]
        values = np.array([[*size, *center, *angles]])
        cuboids.append(CuboidAnnotation(int(k), CuboidPath(np.array([time_ns]), values)))
        said[int(k)] = (int(np.flatnonzero(times == time_ns)[0]), int(rows["num_interior_pts"][k]))
    assert len(cuboids) > 100
    found = count_points(Scene((lidar,), tuple(cuboids))).lidars[0]
    away = [
        abs(int(found.counts[said[cuboid.id][0], column]) - said[cuboid.id][1])
        for column, cuboid in enumerate(cuboids)
    ]
    assert max(away) <= 2  # points on a face, which float32 coordinates put on one side or the other
    assert np.mean(np.array(away) == 0) > 0.9


def test_the_points_of_a_scene_of_another_writer_lie_in_its_cuboids(data_dir):
    with sceneloom.open(data_dir / "real/sfs_reference/argoverse2_2frames_cuboids.sfs") as scene:
        found = count_points(scene).lidars[0]
    assert found.there.all()
    # one point in eight was kept, so that small and far things may have lost all of theirs
    assert (found.counts > 0).any(axis=0).mean() > 0.5
