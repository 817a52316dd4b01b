"""Labels made of tracks, projections, activations, counts and labelled points, as Scale's library loads them."""

import numpy as np

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.colouring.cuboid_projection import (
    count_points,
    project_cuboids,
    with_activations,
    with_counts,
    with_labeled_points,
)
from sceneloom.scene import CuboidAnnotation, Support, Track, Tracks
from sceneloom.simulate import CameraSpec, LidarSpec, TrafficSpec, simulate_street
from sceneloom.tracking.labels import label_tracks


def a_rotating_car(times_ns):
    count = len(times_ns)
    yaws = np.linspace(2.5, 3.9, count)
    return Track(
        3,
        "car",
        times_ns,
        np.column_stack([np.linspace(8.0, 14.0, count), np.full(count, 2.0), np.full(count, 0.8)]),
        np.tile([4.2, 1.8, 1.6], (count, 1)),
        (yaws + np.pi) % (2.0 * np.pi) - np.pi,
        np.tile([10.0, 0.0, 0.0], (count, 1)),
        np.zeros(count),
        np.tile(0.01 * np.eye(10), (count, 1, 1)),
        np.full(count, 0.87),
        np.full(count, Support.BOTH, np.uint8),
        {"camera0": np.tile([100.0, 80.0, 160.5, 120.0], (count, 1))},
    )


def test_labels_load_and_validate_there(read_by_scale, tmp_path):
    camera = CameraSpec(Camera("pinhole", 320, 200, 180.0, 180.0, 159.5, 99.5))
    drive = simulate_street(2, frames=4, lidar=LidarSpec(beams=16, steps=360), cameras=(camera,))
    track = a_rotating_car(drive.truth.lidar.timestamps_ns + 50_000_000)
    bare = sceneloom.scene.Scene(drive.scene.sensors, trajectories=drive.scene.trajectories)
    labelled = label_tracks(bare, Tracks((track,)))
    sceneloom.write(labelled.scene, tmp_path / "labels.sfs", profile="scale")
    found = read_by_scale(tmp_path / "labels.sfs")
    assert found["faults"] == []
    assert found["types"] == sorted(annotation.type for annotation in labelled.scene.annotations)
    (cuboid,) = found["cuboids"].values()
    # its rows are x y z yaw pitch roll dx dy dz; a car that rotations evenly needs its first state and its last
    rows = np.array(cuboid["rows"])
    assert len(rows) == 2
    assert np.diff(rows[:, 3])[0] == np.float64(rows[1, 3] - rows[0, 3])
    np.testing.assert_allclose(rows[:, :3], track.centers[[0, -1]], atol=1e-9)
    np.testing.assert_allclose(rows[:, 3], np.degrees([2.5, 3.9]), atol=1e-9)
    np.testing.assert_allclose(rows[:, 6:], track.sizes_lwh[[0, -1]], atol=1e-9)


def test_what_was_projected_and_counted_loads_and_validates_there(read_by_scale, tmp_path):
    camera = CameraSpec(Camera("pinhole", 320, 200, 180.0, 180.0, 159.5, 99.5))
    lidar = LidarSpec(beams=16, steps=360)
    drive = simulate_street(2, frames=3, lidar=lidar, cameras=(camera,), traffic=TrafficSpec()).scene
    counts = count_points(drive, moment="points", listed=True)
    scene = with_labeled_points(with_activations(with_counts(drive, counts), counts), counts)
    scene = project_cuboids(scene, lidar="lidar", activations=True)
    sceneloom.write(scene, tmp_path / "seen.sfs", profile="scale")
    found = read_by_scale(tmp_path / "seen.sfs")
    assert found["faults"] == []
    assert len(found["annotations"]) == len(scene.annotations)
    seen = [a for a in scene.annotations if isinstance(a, CuboidAnnotation) and a.projections]
    assert len(seen) > 3
    for annotation in seen:
        (theirs,) = found["cuboids"][annotation.id]["boxes"]
        for box, ours in zip(theirs, annotation.projections[0].boxes, strict=True):
            assert (box is None) == bool(np.isnan(ours).any())
            assert box is None or box == ours.tolist()
