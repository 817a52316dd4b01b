"""Refinement of a calibration on simulated drives, whose truth is exact."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from scipy.ndimage import map_coordinates

from sceneloom.calibrate.extrinsics import step_between
from sceneloom.calibrate.frames import CalibrationFrame, calibration_frames
from sceneloom.calibrate.measures import UNITS, Change, fill_histogram, sum_by_table, sum_edges
from sceneloom.calibrate.refinement import RefinementVerdict, find_cues, moving_pixels, refine, sum_maps, views_of
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import CameraSpec, LidarSpec, PathSpec, simulate_street

Frames = tuple[CalibrationFrame, ...]
CAMERA_MODEL = Camera("pinhole", 621, 188, 360.0, 360.0, 310.0, 93.5)


@pytest.fixture(scope="module")
def frames():
    """Six frames of a small drive, rightly calibrated."""
    drive = simulate_street(
        5,
        frames=18,
        cameras=[CameraSpec(CAMERA_MODEL)],
        lidar=LidarSpec(beams=48, steps=1200),
        path=PathSpec(speeds=(6.0, 12.0)),
    )
    return calibration_frames(drive.scene, most=6)


def stated(frames, camera_from_lidar):
    return tuple(replace(frame, camera_from_lidar=camera_from_lidar) for frame in frames)


def degrees_off(frames, found):
    step = step_between(frames[0].camera_from_lidar, found.camera_from_lidar)
    return float(np.degrees(np.linalg.norm(step[:3])))


def test_an_injected_error_is_taken_out_again(frames):
    error = Change.of(np.array([0.008, -0.006, 0.004, 0, 0, 0, 0, 0]))
    wrong = error.camera_from_lidar(frames[0].camera_from_lidar.matrix)
    found = refine(stated(frames, RigidTransform.nearest(wrong)[0]), parameters=("rotation",))
    assert found.verdict is RefinementVerdict.REFINED
    assert degrees_off(frames, found) < 0.1  # a pixel is 0.16 degrees here
    assert found.sigmas.keys() == {"pitch", "yaw", "roll"}
    assert min(found.gains) > 0


@pytest.mark.parametrize(
    "levels", [pytest.param(256, id="as it is"), pytest.param(4, id="images of the night", marks=pytest.mark.slow)]
)
def test_the_right_calibration_stays_what_it_is_within_what_is_known(frames, levels):
    seen = tuple(replace(frame, grey=np.floor(frame.grey / (256 / levels))) for frame in frames)
    assert degrees_off(frames, refine(frames if levels == 256 else seen, parameters=("rotation",))) < 0.1


@pytest.mark.slow
def test_images_seconds_late_and_an_extrinsic_upside_down_are_never_refined(frames):
    half = len(frames) // 2
    late = tuple(replace(frame, grey=frames[(k + half) % len(frames)].grey) for k, frame in enumerate(frames))
    over = RigidTransform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3)) @ frames[0].camera_from_lidar
    for wrong in (late, stated(frames, over)):
        assert refine(wrong, parameters=("rotation",)).verdict is not RefinementVerdict.REFINED


def test_images_or_clouds_that_show_too_little_are_undetermined_and_say_why(frames):
    for paint in [np.zeros_like, lambda grey: np.full_like(grey, 120.0)]:
        found = refine(tuple(replace(frame, grey=paint(frame.grey)) for frame in frames))
        assert found.verdict is RefinementVerdict.UNDETERMINED
        assert "show next to nothing" in found.reason
        assert found.camera_from_lidar is frames[0].camera_from_lidar
    filled = []
    for frame in frames:
        points = frame.camera_from_lidar.apply(frame.points_lidar)
        ahead = points[:, 2] > 3.0
        points[ahead] *= 3.0 / points[ahead, 2:]
        moved, grey = frame.camera_from_lidar.inverse().apply(points), np.full_like(frame.grey, 90.0)
        filled.append(replace(frame, points_lidar=moved, grey=grey, scan=None))
    assert refine(filled).verdict is RefinementVerdict.UNDETERMINED
    up = RigidTransform(np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]), np.zeros(3)) @ frames[0].camera_from_lidar
    bare = {"intensities": None, "seconds": None, "scan": None}
    point = tuple(replace(frame, points_lidar=frame.points_lidar[:1], **bare) for frame in frames)
    for seen, reason in (
        (stated(frames, up), ""),
        (point, "does it look where the calibration says"),
        (frames[:2], "2 frames; expected"),
    ):
        found = refine(seen)
        assert found.verdict is RefinementVerdict.UNDETERMINED
        assert reason in found.reason
    for parameters in [("shear",), (), ("rotation", "")]:
        with pytest.raises(OptionError, match="expected some of rotation, translation, time, focal"):
            refine(frames, parameters=parameters)


def test_sums_over_maps_are_those_of_scipy():
    rng = np.random.default_rng(1)
    maps = rng.normal(size=(2, 20, 30)).astype(np.float32)
    pixels = rng.uniform([1, 1], [27, 17], (50, 2)).astype(np.float32)
    pixels[0] = np.nan
    slopes = rng.normal(0, 0.1, (50, 2, 3)).astype(np.float32)
    weights, rows = rng.normal(size=50).astype(np.float32), rng.integers(0, 2, 50).astype(np.int32)
    groups, step = rng.integers(0, 4, 50).astype(np.int32), np.array([0.3, -0.2, 0.1])
    sums, squares, gradients = np.zeros(4), np.zeros(4), np.zeros((4, 3))
    sum_maps(pixels, slopes, step, weights, rows, groups, maps, sums, squares, gradients)
    moved = pixels[1:] + slopes[1:] @ step
    values = np.array(
        [map_coordinates(maps[row], [[v], [u]], order=1)[0] for (u, v), row in zip(moved, rows[1:], strict=True)]
    )
    for group in range(4):
        own = groups[1:] == group
        assert sums[group] == pytest.approx((weights[1:] * values)[own].sum(), abs=1e-4)
        assert squares[group] == pytest.approx((values**2)[own].sum(), abs=1e-4)
    nudged = [np.zeros(4), np.zeros(4)]
    for k, sign in ((0, 1), (1, -1)):
        sum_maps(
            pixels, slopes, step + sign * np.array([1e-4, 0, 0]), weights, rows, groups, maps,
            nudged[k], np.zeros(4), np.zeros((4, 3)),
        )  # fmt: skip
    np.testing.assert_allclose(gradients[:, 0], (nudged[0] - nudged[1]) / 2e-4, atol=2e-3)


def test_frames_of_a_stationary_vehicle_are_one_view_and_pixels_move_as_their_derivatives_state(frames):
    cues = find_cues(frames[2])
    chosen, free = np.arange(0, len(cues.weights), 50), np.arange(8)
    numbers = np.array([0.01, -0.02, 0.005, 0.02, -0.01, 0.03, 0.01, 0.02])
    _, slopes = moving_pixels(cues, chosen, numbers, free)
    for k in free.tolist():
        step = np.zeros(8)
        step[k] = 1e-4 * UNITS[k]
        ahead, _ = moving_pixels(cues, chosen, numbers + step, free)
        behind, _ = moving_pixels(cues, chosen, numbers - step, free)
        numeric = (ahead - behind) / 2e-4
        known = np.isfinite(numeric).all(axis=1) & np.isfinite(slopes[:, :, k]).all(axis=1)
        # rotates are composed, so derivatives at a candidate that is rotated already differ by that rotation: 2 %
        scale = np.abs(numeric[known]).max() + 1e-9
        assert np.abs(slopes[known, :, k] - numeric[known]).max() < 0.03 * scale
    still = tuple(replace(frame, twist_lidar=np.zeros(6)) for frame in frames)
    assert views_of(still).tolist() == [0] * len(frames)
    assert views_of(frames)[-1] >= 3


SIZE = (20, 30)


@pytest.fixture
def placed():
    """Forty points, thirty of them in the image."""
    generator = np.random.default_rng(2)
    ids = np.sort(generator.choice(40, 30, replace=False)).astype(np.int64)
    pixels = generator.uniform((0.0, 0.0), (SIZE[1] - 1, SIZE[0] - 1), (30, 2)).astype(np.float32)
    return generator, ids, pixels


def interpolated(image, pixels):
    """Bilinear values by scipy."""
    return ndimage.map_coordinates(np.asarray(image, np.float64), pixels[:, ::-1].T.astype(np.float64), order=1)


def test_edges_are_summed_by_cell_and_direction_and_beyond_the_outer_centres_the_border_holds(placed):
    generator, ids, pixels = placed
    kinds, cells = generator.integers(0, 4, 40).astype(np.uint8), generator.integers(0, 5, 40).astype(np.int16)
    weights, edges = generator.random(40).astype(np.float32), generator.random((4, *SIZE)).astype(np.float32)
    sums, totals = np.zeros(5), np.zeros(5)
    sum_edges(ids, pixels, kinds, weights, cells, edges, sums, totals)
    values = np.array([interpolated(edges[k], p[None])[0] for k, p in zip(kinds[ids], pixels, strict=True)])
    expected = np.bincount(cells[ids], weights[ids] * values, minlength=5)
    np.testing.assert_allclose(sums, expected, rtol=1e-5)  # float32 pixels
    np.testing.assert_allclose(totals, np.bincount(cells[ids], weights[ids], minlength=5), rtol=1e-6)
    sums, outside = np.zeros(1), np.array([[-0.5, -0.5], [29.4, 19.4]], np.float32)
    same = np.zeros(2, np.uint8), np.ones(2, np.float32), np.zeros(2, np.int16)
    sum_edges(np.arange(2), outside, *same, edges, sums, np.zeros(1))
    assert sums[0] == pytest.approx(edges[0, 0, 0] + edges[0, -1, -1], rel=1e-6)


def test_a_histogram_shares_each_point_among_four_bins_and_a_table_is_looked_up_between_its_numbers(placed):
    generator, ids, pixels = placed
    levels, cells = generator.uniform(0, 7, 40).astype(np.float32), generator.integers(0, 3, 40).astype(np.int16)
    image, table = generator.uniform(0, 7, SIZE).astype(np.float32), generator.normal(size=(8, 8))
    histogram, sums, totals, shown = np.zeros((8, 8)), np.zeros(3), np.zeros(3), interpolated(image, pixels)
    fill_histogram(ids, pixels, levels, image, histogram)
    own, other = (np.maximum(0.0, 1.0 - np.abs(np.arange(8) - v[:, None])) for v in (levels[ids], shown))
    np.testing.assert_allclose(histogram, own.T @ other, atol=1e-4)  # float32 levels
    assert histogram.sum() == pytest.approx(len(ids))
    sum_by_table(ids, pixels, levels, cells, image, table, sums, totals)
    looked_up = interpolated(table, np.column_stack([shown, levels[ids]]))
    np.testing.assert_allclose(sums, np.bincount(cells[ids], looked_up, minlength=3), atol=1e-4)
    assert totals.tolist() == np.bincount(cells[ids], minlength=3).tolist()
