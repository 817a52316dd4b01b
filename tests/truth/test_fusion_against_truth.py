"""The main job, over recordings and scene files on disk, held against what was really there."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.pipeline import iter_fused
from sceneloom.simulate import LidarSpec

MILLIMETRE = 1e-3
"""How far poses may be off: interpolation between 100 poses a second costs 0.1 mm, float32 records 0.01 mm, …"""
HUNDREDTH_DEG = np.radians(0.01)
"""… and angles: 0.001 degrees."""
NO_CAMERA = 255


def pairs(drives: list[Any]) -> Iterator[tuple[Any, str, int]]:
    """All drives, cameras and sweeps."""
    for fused in drives:
        for camera_id in fused.camera_ids:
            for sweep in fused.sweeps:
                yield fused, camera_id, sweep


def coloured_by(fused: Any, camera_id: str, sweep: int) -> np.ndarray:
    """Which points of a sweep have their colour from a camera, (N,) bool."""
    return fused.points(sweep)["camera_index"] == fused.camera_ids.index(camera_id)


def levels_outside(image: np.ndarray, pixels: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """By how many levels colours leave the range of the 3x3 pixels around locations: (M,), the worst channel."""
    column, row = np.rint(pixels).astype(int).T
    high, wide = np.array(image.shape[:2]) - 1
    around = np.stack(
        [image[(row + dy).clip(0, high), (column + dx).clip(0, wide)] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    ).astype(int)
    outside = np.maximum(around.min(axis=0) - colours, colours - around.max(axis=0))
    return outside.max(axis=1).clip(0)


def test_hidden_points_stay_without_colour_and_visible_ones_get_one(with_png: list[Any]) -> None:
    """Under 3 % of the hidden points coloured, under 3 % of the visible ones lost, away from outlines."""
    hidden = coloured = visible = lost = 0
    for fused, camera_id, sweep in pairs(with_png):
        seen, mine = fused.truths.seen(camera_id, sweep), coloured_by(fused, camera_id, sweep)
        behind, plain = seen.counted & ~seen.free, seen.counted & seen.free
        hidden += behind.sum()
        coloured += (behind & mine).sum()
        visible += plain.sum()
        lost += (plain & (fused.points(sweep)["camera_index"] == NO_CAMERA)).sum()
    assert hidden > 1000
    assert visible > 100_000
    assert coloured / hidden < 0.03
    assert lost / visible < 0.03


def depth_errors(image: np.ndarray, seen: Any) -> np.ndarray:
    """How far the depths of pixels are from the nearest true depth of a point that falls within 1.5 px [m].

    A point is so far off its true pixel at most: its range is noisy, and pixels are whole numbers.
    """
    true = np.flatnonzero(seen.counted & seen.free)
    column, row = np.rint(seen.pixels[true]).astype(int).T
    best = np.full(image.shape, np.inf)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            r, c = row + dy, column + dx
            inside = (r >= 0) & (r < image.shape[0]) & (c >= 0) & (c < image.shape[1])
            r, c, z = r[inside], c[inside], seen.depths[true][inside]
            np.minimum.at(best, (r, c), np.where(image[r, c] > 0, np.abs(image[r, c] - z), np.inf))
    found = best[np.isfinite(best)]
    # Nearly all points in plain view make a depth; two in one pixel make one.
    assert len(found) > 0.5 * len(true)
    return found


def test_depth_images_hold_the_true_depths(with_png: list[Any]) -> None:
    """Depth within 2 cm + 3 sigma at the 99th percentile, away from outlines; every depth lies on something."""
    errors = []
    for fused, camera_id, sweep in pairs(with_png):
        seen = fused.truths.seen(camera_id, sweep)
        image = np.load(fused.depth / camera_id / f"{sweep - fused.sweeps.start:06d}.npz")["depth"]
        errors.append(depth_errors(image, seen))
    bound = 0.02 + 3 * with_png[0].drive.truth.lidar.spec.range_sigma
    assert np.percentile(np.concatenate(errors), 99) < bound


@pytest.mark.parametrize("images", ["with_png", "with_h264"])
def test_colours_out_of_png_images_are_exact_and_out_of_h264_videos_close(request, images: str) -> None:
    """Colours of points in plain view are those of the true image there."""
    outside, differences, exact = [], [], images == "with_png"
    for fused, camera_id, sweep in pairs(request.getfixturevalue(images)):
        seen = fused.truths.seen(camera_id, sweep)
        chosen = seen.counted & seen.free & coloured_by(fused, camera_id, sweep)
        colours, pixels = fused.points(sweep)["colors"][chosen].astype(int), seen.pixels[chosen]
        outside.append(levels_outside(seen.truth.colors, pixels, colours))
        column, row = np.rint(pixels).astype(int).T
        differences.append(np.abs(seen.truth.colors[row, column].astype(int) - colours).max(axis=1))
    if exact:
        # Range noise of 2 cm moves a point by less than a pixel, but for a few very near ones.
        assert (np.concatenate(outside) <= 1).mean() > 0.999
        assert (np.concatenate(differences) <= 1).mean() > 0.9
    assert np.median(np.concatenate(differences)) <= (1 if exact else 4)


def test_points_are_where_the_laser_hit_with_their_times_strengths_and_rings(with_png):
    for fused in with_png:
        for sweep in fused.sweeps:
            measured, true = fused.drive.truth.sweep(sweep), fused.truths.clean(sweep)
            found = fused.to_world(fused.points(sweep)["positions"])
            rays = true.positions_world - measured.origins_world
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            reported = np.linalg.norm(measured.frame.points.positions.astype(float), axis=1)
            expected = true.positions_world + rays * (reported - true.ranges)[:, None]
            assert np.abs(found - expected).max() < MILLIMETRE
            apart = np.linalg.norm(found - true.positions_world, axis=1)
            # 2.58 sigma hold 99 % of a normal distribution; the rest allows for the millimetre and for chance.
            assert np.percentile(apart, 99) < 3 * fused.drive.truth.lidar.spec.range_sigma
    for fused in with_png:
        for sweep, frame in zip(fused.sweeps, fused.sensor("lidar")["frames"], strict=True):
            ours, true = frame["points"], fused.drive.truth.sweep(sweep).frame.points
            times = fused.time_ns(ours["timestamps"])
            # Microseconds of the file, and seconds as float64 in the recording.
            assert np.abs(times - true.timestamps_ns).max() <= 501
            assert fused.time_ns(frame["timestamp"]) == times.min()
            np.testing.assert_array_equal(ours["intensities"], true.intensities)
            np.testing.assert_array_equal(ours["ring"], true.rings)


def expected_poses(fused: Any, sensor_id: str, times_ns: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """True positions (M, 3) and rotations of a sensor in the world."""
    truth = fused.drive.truth
    ego = truth.path.at(times_ns)
    rotations = Rotation.from_matrix(ego.rotations)
    if sensor_id == "ego":
        return ego.positions, rotations
    mount = (truth.lidar if sensor_id == "lidar" else truth.cameras[sensor_id]).spec.mount
    positions = ego.positions + rotations.apply(mount.translation.copy())
    return positions, rotations * Rotation.from_matrix(mount.rotation.copy())


def test_poses_are_the_true_ones_of_every_sweep_and_image_from_the_first_position_of_the_ego_on(with_png):
    for fused in with_png:
        for sensor_id in ("ego", "lidar", *fused.camera_ids):
            path = fused.sensor(sensor_id)["poses"]
            timestamps, rows = fused.time_ns(path["timestamps"]), np.array(path["values"])
            positions, rotations = expected_poses(fused, sensor_id, timestamps)
            assert np.abs(fused.to_world(rows[:, :3]) - positions).max() < MILLIMETRE
            rotated = Rotation.from_matrix(fused.world_from_file[:3, :3]) * Rotation.from_quat(rows[:, 3:])
            assert (rotated.inv() * rotations).magnitude().max() < HUNDREDTH_DEG
            times = np.linspace(timestamps[0], timestamps[-1], 200).astype(np.int64)
            positions, _ = expected_poses(fused, sensor_id, times)
            between = np.column_stack([np.interp(times, timestamps, rows[:, k]) for k in range(3)])
            # The file leaves out poses that interpolation gives within 1 mm.
            assert np.abs(fused.to_world(between) - positions).max() < 2 * MILLIMETRE
    for fused in with_png:
        posed = set(fused.sensor("lidar")["poses"]["timestamps"])
        assert posed >= {frame["timestamp"] for frame in fused.sensor("lidar")["frames"]}
        for camera_id in fused.camera_ids:
            posed = fused.time_ns(fused.sensor(camera_id)["poses"]["timestamps"])
            taken = fused.drive.truth.cameras[camera_id].timestamps_ns[fused.sweeps.start : fused.sweeps.stop]
            assert all(np.abs(posed - time).min() <= 500 for time in taken)
    for fused in with_png:
        matrix, path = fused.world_from_file, fused.sensor("ego")["poses"]
        np.testing.assert_array_equal(matrix[:3, :3], np.eye(3))
        np.testing.assert_allclose(path["values"][0][:3], 0.0, atol=1e-9)
        first = fused.drive.truth.path.at(fused.time_ns(path["timestamps"][:1])).positions[0]
        np.testing.assert_allclose(matrix[:3, 3], first, atol=MILLIMETRE)


def test_sweeps_are_paired_with_the_image_nearest_to_the_median_time_of_their_points(with_png: list[Any]) -> None:
    before = 0
    for fused in with_png:
        with sceneloom.open(fused.recording) as scene:
            for sweep, frame in zip(fused.sweeps, iter_fused(scene), strict=True):
                assert [view.camera_id for view in frame.views] == fused.camera_ids
                for view in frame.views:
                    image = fused.truths.nearest_image(view.camera_id, sweep)
                    time_ns = fused.drive.truth.cameras[view.camera_id].timestamps_ns[image]
                    assert abs(view.timestamp_ns - time_ns) <= 1
                    before += image < sweep
    assert before > 0


def test_points_are_coloured_by_the_image_that_shows_them_most_centrally(with_png: list[Any]) -> None:
    overlapping = 0
    for fused in with_png:
        for sweep in fused.sweeps:
            index = fused.points(sweep)["camera_index"]
            distances = np.full((len(fused.camera_ids), len(index)), np.inf)
            doubtful = np.zeros(len(index), bool)
            for number, camera_id in enumerate(fused.camera_ids):
                seen, camera = fused.truths.seen(camera_id, sweep), fused.drive.truth.cameras[camera_id].spec.camera
                size = np.array([camera.width, camera.height])
                radii = np.linalg.norm(seen.pixels - (size - 1) / 2, axis=1) / np.linalg.norm(size)
                in_plain_view = seen.counted & seen.free
                distances[number, in_plain_view] = radii[in_plain_view]
                on_border = ((seen.pixels > -2) & (seen.pixels < size + 1)).all(axis=1) & ~seen.counted
                doubtful |= on_border | (seen.counted & ~seen.free)
            ordered = np.sort(distances, axis=0)
            two = ordered[1] < np.inf
            clear = two & (ordered[1] > ordered[0] + 0.02) & ~doubtful & (index < NO_CAMERA)
            overlapping += clear.sum()
            # A visible point may be lost in one image and coloured by the other: 3 % may.
            assert (index[clear] == distances.argmin(axis=0)[clear]).mean() > 0.97
            in_view = np.isfinite(ordered[0])
            assert (index[~in_view & ~doubtful] == NO_CAMERA).all()
            assert (fused.points(sweep)["colors"][index == NO_CAMERA] == 255).all()
    assert overlapping > 5000


def test_boxes_hold_the_points_of_their_objects(with_png: list[Any]) -> None:
    # Range noise, and corners that stand out of boxes by rounding.
    slack, held = 5 * LidarSpec().range_sigma, 0
    for fused in with_png:
        points = np.concatenate([fused.to_world(fused.points(sweep)["positions"]) for sweep in fused.sweeps])
        instances = np.concatenate([fused.truths.clean(sweep).instances for sweep in fused.sweeps])
        truth = {f"{thing.label}-{thing.instance}": thing for thing in fused.drive.truth.objects}
        assert fused.content["annotations"]
        for annotation in fused.content["annotations"]:
            row = np.array(annotation["path"]["values"][0])
            rotation = Rotation.from_euler("XYZ", row[6:9], degrees=True)
            center, inside = fused.to_world(row[3:6]), np.zeros(len(points), bool)
            reach = np.linalg.norm(row[:3] / 2 + slack)
            near = np.flatnonzero(np.abs(points[:, 0] - center[0]) < reach)
            inside[near] = (np.abs(rotation.inv().apply(points[near] - center)) < row[:3] / 2 + slack).all(axis=1)
            own = instances == truth[annotation["id"]].instance
            assert inside[own].all()
            if annotation["label"] in {"car", "bin"}:
                # Nothing else is in a compact box but the ground under it; crowns and lamps hang over others.
                assert (points[inside & ~own][:, 2] < slack).all()
            held += own.sum()
    assert held > 10_000


def test_images_change_nothing_but_colours(with_png: list[Any], with_h264: list[Any]) -> None:
    for png, h264 in zip(with_png, with_h264, strict=True):
        assert png.world_from_file.tolist() == h264.world_from_file.tolist()
        for sweep in png.sweeps:
            for name in ("positions", "timestamps", "camera_index"):
                np.testing.assert_array_equal(png.points(sweep)[name], h264.points(sweep)[name])
