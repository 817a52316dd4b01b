"""Cuboids as sensors see them: "active for S at t", and the own computed cuboids of activations, against formulas."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import (
    Activation,
    CameraSensor,
    Coordinates,
    CuboidAnnotation,
    CuboidPath,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsFrame,
    Poses,
    Scene,
)
from sceneloom.scene.annotations_at import BoxTable, active_at, cuboid_at, cuboid_poses
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street
from sceneloom.visualization.annotations import figures_in_world

MS = 1_000_000
SPEED = 5.0
"""Of the cuboid along x [m/s]: at 10 m at time 0."""
OWN = np.array([4.0, 2.0, 2.0, 10.0, 3.0, 1.0, 0.0, 0.0, 90.0])
"""What lidar `near` computed at 200 ms: 3 m beside the path, longer, rotated by 90 degrees."""


def row(time_ms: float) -> np.ndarray:
    return np.array([3.0, 2.0, 1.5, 10.0 + SPEED * time_ms / 1e3, 0.0, 1.0, 0.0, 0.0, 0.0])


def cuboid(*activations: Activation, **changed: Any) -> CuboidAnnotation:
    times = np.array([0, 1000])
    path = CuboidPath(times * MS, np.stack([row(t) for t in times]))
    return CuboidAnnotation("box", path, label="car", activations=activations, **changed)


def activation(sensor: str, *spans_ms: tuple[int, int], cuboids: Any = None) -> Activation:
    starts = np.array([start for start, _ in spans_ms], np.int64) * MS
    own = None if cuboids is None else np.array(cuboids, np.float64)
    return Activation(sensor, starts, tuple((stop - start) * MS for start, stop in spans_ms), own)


SEEN = cuboid(activation("front", (300, 600)), activation("near", (200, 500), cuboids=[OWN]))


def test_an_activation_lasts_from_its_timestamp_until_its_end_which_no_longer_counts() -> None:
    times = np.array([299, 300, 599, 600]) * MS
    assert active_at(SEEN, "front", times).tolist() == [False, True, True, False]
    assert cuboid_poses(SEEN, times, sensor_id="front").there.tolist() == [False, True, True, False]
    assert active_at(SEEN, "rear", times).all(), "nothing is stated for it"
    assert cuboid_poses(SEEN, times).there.all(), "the object itself is there all the time"
    moment = cuboid(activation("front", (300, 300)))
    assert active_at(moment, "front", [300 * MS - 1, 300 * MS, 300 * MS + 1]).tolist() == [False, True, False]
    static = cuboid(Activation("front", np.array([300 * MS])))
    assert active_at(static, "front", times).tolist() == [False, True, True, True]
    never = cuboid(Activation("front", np.zeros(0, np.int64)))
    assert not active_at(never, "front", times).any()


def test_a_frame_sees_what_is_active_at_any_time_of_it() -> None:
    begun = np.array([150, 250, 550, 600, 650]) * MS
    found = active_at(SEEN, "front", begun + 100 * MS, since_ns=begun)
    assert found.tolist() == [False, True, True, False, False]


def test_an_own_cuboid_holds_at_its_timestamp_and_moves_on_as_the_path_does() -> None:
    rows, there = cuboid_at(SEEN, [100 * MS, 200 * MS, 400 * MS], sensor_id="near")
    assert there.tolist() == [False, True, True]
    np.testing.assert_array_equal(rows[1], OWN)
    expected = OWN + np.array([0, 0, 0, SPEED * 0.2, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(rows[2], expected, atol=1e-12)
    assert np.isnan(rows[0]).all()
    beside, _ = cuboid_at(SEEN, [400 * MS], sensor_id="rear")
    np.testing.assert_allclose(beside[0], row(400), atol=1e-12)


def test_an_own_cuboid_that_is_null_leaves_the_path_and_one_beyond_the_path_stays() -> None:
    null = cuboid(activation("near", (200, 500), cuboids=[np.full(9, np.nan)]))
    np.testing.assert_allclose(cuboid_at(null, [300 * MS], sensor_id="near")[0][0], row(300), atol=1e-12)
    late = cuboid(activation("near", (2000, 2500), cuboids=[OWN]))
    rows, there = cuboid_at(late, [300 * MS, 2200 * MS], sensor_id="near")
    assert there.tolist() == [False, True]
    np.testing.assert_allclose(rows[1], OWN, atol=1e-12)


def still_scene(*annotations: CuboidAnnotation) -> Scene:
    """Two lidars in the world with a point in the path's box and one in the own cuboid's, and a camera, at rest."""
    times = np.arange(0, 1000, 100) * MS

    def lidar(name: str) -> LidarSensor:
        frames = []
        for t in times.tolist():
            drift = SPEED * (t / 1e9 - 0.2)
            points = np.array([row(t / MS)[3:6], OWN[3:6] + np.array([drift, 1.5, 0.0])], np.float32)
            frames.append(LidarFrame(t, LidarPoints(points)))
        return LidarSensor(
            name, LazyFrames.of(frames, times), poses=Poses.identity(), points_frame=PointsFrame.WORLD
        )

    optical = RigidTransform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
    poses = Poses(
        np.zeros(1, np.int64), optical.translation[None], optical.quaternion_xyzw[None], static=True
    )
    camera_model = Camera("pinhole", 200, 100, 100.0, 100.0, 99.5, 49.5)
    drive = simulate_street(
        0, frames=10, lidar=LidarSpec(beams=2, steps=8), cameras=(CameraSpec(camera_model),)
    ).scene
    images = [replace(drive.cameras[0].images[k], timestamp_ns=int(t)) for k, t in enumerate(times)]
    camera = CameraSensor(
        "front", camera_model, LazyFrames.of(images, times), poses=poses, coordinates=Coordinates.WORLD
    )
    return Scene((lidar("near"), lidar("other"), camera), annotations)


def test_points_are_counted_while_a_cuboid_is_active_for_their_lidar_and_in_its_own_cuboid() -> None:
    counts = sceneloom.count_points(still_scene(SEEN))
    near, other = counts.lidars
    # the point at +1.5 m beside the own centre is inside, since that is rotated by 90 degrees and 4 m long
    assert near.there[:, 0].tolist() == [False, False, True, True, True, *[False] * 5]
    assert near.counts[:, 0].tolist() == [0, 0, 1, 1, 1, 0, 0, 0, 0, 0]
    assert other.there[:, 0].all()
    assert other.counts[:, 0].tolist() == [1] * 10
    anew = sceneloom.count_points(still_scene(SEEN), activations=False).lidars[0]
    assert anew.there[:, 0].all()


def test_samples_have_the_boxes_of_their_sensors() -> None:
    samples = still_scene(SEEN).samples(reference="near", cameras="front", lidars=["near", "other"])
    assert [len(sample.boxes) for sample in samples] == [0, 0, 1, 1, 1, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(samples[4].boxes.centers_world[0], [11.0, 3.0, 1.0])
    np.testing.assert_allclose(samples[4].boxes.yaws_world, np.pi / 2)
    assert [len(sample.boxes_for("front")) for sample in samples] == [0, 0, 0, 1, 1, 1, 0, 0, 0, 0]
    assert all(len(sample.boxes_for("other")) == 1 for sample in samples)
    np.testing.assert_allclose(samples[4].boxes_for("other").centers_world[0], row(400)[3:6])
    with pytest.raises(OptionError, match="no frame in this sample"):
        samples[0].boxes_for("rear")


def test_cameras_see_what_is_active_for_them_unless_activations_are_found_anew() -> None:
    own = cuboid(activation("front", (300, 600), cuboids=[OWN]))
    (seen,) = sceneloom.project_cuboids(still_scene(own)).annotations
    (projection,) = seen.projections
    shown = projection.timestamps_ns[np.isfinite(projection.boxes[:, 0])]
    assert (shown // MS).tolist() == [300, 400, 500]
    np.testing.assert_array_equal(projection.cuboids[projection.timestamps_ns == 300 * MS][0], OWN)
    (anew,) = sceneloom.project_cuboids(still_scene(own), activations=True).annotations
    assert np.isfinite(anew.projections[0].boxes[:, 0]).sum() == 10
    assert (anew.activations[0].timestamps_ns // MS).tolist() == [0]


def test_plots_show_what_is_active_for_the_sensor() -> None:
    scene = still_scene(SEEN)

    def drawn(sensor: str | None, time_ms: int) -> int:
        return len(list(figures_in_world(scene, time_ms * MS, sensor_id=sensor)))

    assert [drawn("front", t) for t in (200, 300, 500, 600)] == [0, 1, 1, 0]
    assert [drawn(None, t) for t in (200, 300, 500, 600)] == [1, 1, 1, 1]


@pytest.mark.parametrize(
    ("to", "sensor", "least", "frames"),
    [("nuscenes", "lidar", 1, 0), ("kitti-tracking", "camera0", 5, 2), ("kitti-raw", "lidar", 5, 2)],
)
def test_exports_write_boxes_while_they_are_active_and_list_what_they_cannot_carry(
    to: str, sensor: str, least: int, frames: int, tmp_path: Path
) -> None:
    camera_model = Camera("pinhole", 200, 100, 100.0, 100.0, 99.5, 49.5)
    scene = simulate_street(
        1, frames=5, lidar=LidarSpec(beams=8, steps=90), cameras=(CameraSpec(camera_model),)
    ).scene
    ego = next(iter(scene.trajectories.values()))
    times = (scene.lidars if sensor == "lidar" else scene.cameras)[0]
    timestamps = times.frames.timestamps_ns if sensor == "lidar" else times.images.timestamps_ns
    world = RigidTransform.from_quaternion(ego.positions[40], ego.quaternions_xyzw[40]).apply(
        np.array([[15.0, 0.0, 1.0]])
    )[0]
    span = np.array([0, 10_000_000_000])
    path = CuboidPath(span, np.tile([3.0, 2.0, 2.0, *world, 0.0, 0.0, 0.0], (2, 1)))
    lasting = int(timestamps[3] - timestamps[1])
    part = Activation(sensor, timestamps[1:2], (lasting,))
    whole = CuboidAnnotation("box", path, label="car")

    def written(name: str, box: CuboidAnnotation) -> tuple[int, Any]:
        losses = sceneloom.write(replace(scene, annotations=(box,)), tmp_path / name, format=to)
        with sceneloom.open(tmp_path / name) as found:
            boxes = [a for a in found.annotations if isinstance(a, CuboidAnnotation)]
            return sum(len(a.path.timestamps_ns) for a in boxes), losses

    assert written("all", whole)[0] >= least
    count, losses = written("some", replace(whole, activations=(part,)))
    assert count == frames
    assert any(loss.field.endswith("cuboid.activations") for loss in losses)


@pytest.mark.parametrize("to", ["kitti-object", "kitti-tracking", "kitti-raw"])
def test_labels_of_sweeps_hold_what_is_active_at_any_time_of_them(to: str, tmp_path: Path) -> None:
    scene = simulate_street(1, frames=4, lidar=LidarSpec(beams=8, steps=90), cameras=()).scene
    timestamps = scene.lidars[0].frames.timestamps_ns
    path = CuboidPath(np.array([0, 10**10]), np.tile([3.0, 2.0, 2.0, 15.0, 0.0, 1.0, 0.0, 0.0, 0.0], (2, 1)))
    early = Activation("lidar", timestamps[1:2], (10 * MS,))
    box = CuboidAnnotation("box", path, label="car", activations=(early,))
    sceneloom.write(replace(scene, annotations=(box,)), tmp_path / "out", format=to)
    with sceneloom.open(tmp_path / "out") as found:
        boxes = [a for a in found.annotations if isinstance(a, CuboidAnnotation)]
        assert sum(len(a.path.timestamps_ns) for a in boxes) == 1


def test_a_table_of_boxes_asks_only_the_sensor_that_is_named() -> None:
    table = BoxTable(still_scene(SEEN))
    rows, boxes = table.find(800 * MS)
    assert rows.tolist() == [0]
    np.testing.assert_allclose(boxes.centers_world[0], row(800)[3:6])
    assert table.find(800 * MS, sensor_id="near")[0].tolist() == []
    assert len(table.at(800 * MS, sensor_id="front", window_ns=(550 * MS, 800 * MS))) == 1
