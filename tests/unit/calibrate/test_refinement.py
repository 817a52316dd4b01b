"""Frames of a calibration and its refinement on simulated drives, whose truth is exact."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from scipy.ndimage import map_coordinates

from sceneloom.calibrate import refinement
from sceneloom.calibrate.extrinsics import step_between
from sceneloom.calibrate.frames import CalibrationFrame, calibration_frames, find_scan_order
from sceneloom.calibrate.measures import UNITS, Change, fill_histogram, find_depth_edges, sum_edges
from sceneloom.calibrate.refinement import Refinement, RefinementVerdict, find_cues, moving_pixels, refine, sum_maps
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.frames import LazyFrames
from sceneloom.simulate import CameraSpec, LidarSpec, PathSpec, simulate_street
from sceneloom.simulate.lidar_radar import directions_at

Frames = tuple[CalibrationFrame, ...]
CAMERA_MODEL = Camera("pinhole", 621, 188, 360.0, 360.0, 310.0, 93.5)


@pytest.fixture(scope="module")
def frames():
    """Six frames of a small drive, rightly calibrated."""
    lidar, path = LidarSpec(beams=48, steps=1200), PathSpec(speeds=(6.0, 12.0))
    drive = simulate_street(5, frames=18, cameras=[CameraSpec(CAMERA_MODEL)], lidar=lidar, path=path)
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


def test_errors_of_five_degrees_are_taken_out_and_covariances_have_what_translations_leave_open(frames):
    error = Change.of(np.array([0.05, -0.06, 0.03, 0, 0, 0, 0, 0]))
    wrong = error.camera_from_lidar(frames[0].camera_from_lidar.matrix)
    found = refine(stated(frames, RigidTransform.nearest(wrong)[0]))
    assert found.verdict is RefinementVerdict.REFINED
    assert degrees_off(frames, found) < 0.2
    assert found.sigmas.keys() == {"pitch", "yaw", "roll", "right", "down", "ahead", "later"}
    shift = Change.of(np.array([0, 0, 0, 0.1, -0.1, 0, 0, 0]))
    shifted = stated(frames, RigidTransform.nearest(shift.camera_from_lidar(frames[0].camera_from_lidar.matrix))[0])
    found = refine(shifted, parameters=("rotation",))
    step = step_between(frames[0].camera_from_lidar, found.camera_from_lidar)
    # rotations that make up for a translation that stays: their uncertainty says so
    if found.verdict is RefinementVerdict.REFINED:
        assert (np.abs(step[:3]) < 3.0 * np.array(list(found.sigmas.values()))).all()
    assert found.change.numbers[3:] == (0.0,) * 5


@pytest.mark.parametrize(("degrees", "again"), [(5.0, "cannot determine"), (5.0, "kept"), (1.0, "cannot determine")])
def test_what_is_found_far_away_is_taken_only_if_it_is_determined_from_there_too(frames, degrees, again, monkeypatch):
    change = Change.of(np.array([np.radians(degrees), 0, 0, 0, 0, 0, 0, 0]))
    there = RigidTransform.nearest(change.camera_from_lidar(frames[0].camera_from_lidar.matrix))[0]
    first = Refinement(RefinementVerdict.REFINED, "", there, frames[0].camera, time_offset=0.01, change=change)
    begun = []

    def refined(chosen, *_):
        begun.append(chosen[0].camera_from_lidar)
        return first if len(begun) == 1 else replace(first, verdict=RefinementVerdict(again), reason="too little")

    monkeypatch.setattr(refinement, "_refined", refined)
    found = refine(frames)
    if (degrees, again) == (5.0, "cannot determine"):
        assert (found.verdict, found.time_offset) == (RefinementVerdict.UNDETERMINED, 0.0)
        assert found.camera_from_lidar is frames[0].camera_from_lidar
        assert found.reason.endswith("not again from there: too little")
    else:
        assert found is first
    assert begun == [frames[0].camera_from_lidar, there][: 1 + (degrees > 2)]


@pytest.mark.parametrize(
    "levels", [pytest.param(256, id="as it is"), pytest.param(4, id="images of the night", marks=pytest.mark.slow)]
)
def test_the_right_calibration_stays_what_it_is_within_what_is_known(frames, levels):
    seen = tuple(replace(frame, grey=np.floor(frame.grey / (256 / levels))) for frame in frames)
    found = refine(frames if levels == 256 else seen, parameters=("rotation",))
    assert degrees_off(frames, found) < 0.1
    if levels == 256:
        assert found.verdict is RefinementVerdict.KEPT


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
    wider = replace(frames[-1].camera, fx=0.5 * frames[-1].camera.fx)
    point = tuple(replace(frame, points_lidar=frame.points_lidar[:1], **bare) for frame in frames)
    for seen, reason in (
        (stated(frames, up), ""),
        (point, "does it look where the calibration says"),
        (frames[:2], "2 frames; expected"),
        ((*frames[:-1], replace(frames[-1], camera=wider)), "differs from image to image"),
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


def test_pixels_move_as_their_derivatives_state(frames):
    cues = find_cues(frames[2], frames[2].camera)
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


def test_edges_are_summed_by_cell_and_direction_and_histograms_are_bilinear(placed):
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
    levels = generator.uniform(0, 7, 40).astype(np.float32)
    image = generator.uniform(0, 7, SIZE).astype(np.float32)
    histogram, shown = np.zeros((8, 8)), interpolated(image, pixels)
    fill_histogram(ids, pixels, levels, image, histogram)
    own, other = (np.maximum(0.0, 1.0 - np.abs(np.arange(8) - v[:, None])) for v in (levels[ids], shown))
    np.testing.assert_allclose(histogram, own.T @ other, atol=1e-4)  # float32 levels
    assert histogram.sum() == pytest.approx(len(ids))


AHEAD = Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5)


@pytest.fixture(scope="module")
def drive():
    """Four sweeps from a moving car, without noise."""
    exact = LidarSpec(beams=12, steps=180, range_sigma=0.0)
    return simulate_street(5, frames=4, lidar=exact, cameras=(CameraSpec(AHEAD),))


def test_points_and_motion_of_frames_spread_over_the_drive_are_the_true_ones_and_what_does_not_fit_is_refused(drive):
    frame = calibration_frames(drive.scene, most=2)[1]
    sweep = next(k for k, lidar in enumerate(drive.scene.lidars[0].frames) if lidar.reference_ns == frame.sweep_ns)
    truth_world = drive.truth.clean_points_world(sweep).positions_world
    assert frame.world_from_lidar is not None
    # float32 positions and a trajectory of 100 Hz: millimetres
    np.testing.assert_allclose(frame.world_from_lidar.apply(frame.points_lidar), truth_world, atol=0.01)
    ego = drive.truth.path.at(np.array([frame.image_ns]))
    assert frame.twist_lidar is not None
    # the lidar's mounting rotates with the ego, so that speeds differ by a lever of 2 m times the yaw rate
    assert np.linalg.norm(frame.twist_lidar[3:]) == pytest.approx(float(np.linalg.norm(ego.velocities[0])), abs=0.5)
    assert frame.scan is not None
    assert frame.scan.count == 12  # lines are the rings of the sensor
    assert (np.diff(frame.scan.lines) >= 0).all()
    frame = calibration_frames(drive.scene, most=1)[0]
    assert frame.world_from_lidar is not None
    stated = frame.camera_from_lidar.matrix
    later = Change((*(0.0,) * 7, 0.05)).camera_from_points(frame)
    poses = drive.scene.trajectories["groundTruth"].poses.interpolate(
        np.array([frame.image_ns, frame.image_ns + 50_000_000])
    )
    moved = float(np.linalg.norm(np.diff(poses.positions, axis=0)))
    shift = np.linalg.inv(stated) @ later
    # a straight trajectory for 50 ms: within 2 cm of the curved one
    assert float(np.linalg.norm(shift[:3, 3])) == pytest.approx(moved, abs=0.02)
    moved = Change((0.0, 0.0, np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0, 0.0)).camera_from_lidar(np.eye(4))
    np.testing.assert_allclose(moved[:3, 3], [1.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(moved[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)
    assert [frame.index for frame in calibration_frames(drive.scene, most=2)] == [0, 3]
    assert len(calibration_frames(drive.scene, most=100)) == 4
    with pytest.raises(OptionError, match="0 frames"):
        calibration_frames(drive.scene, most=0)
    with pytest.raises(OptionError, match=r"'left'.*'camera0'"):
        calibration_frames(drive.scene, "left")
    with pytest.raises(OptionError, match=r"'roof'.*'lidar'"):
        calibration_frames(drive.scene, None, "roof")
    first = drive.scene.cameras[0].images[0]
    small = CameraImage(first.timestamp_ns, AHEAD, lambda: np.zeros((32, 48, 3), np.uint8))
    late = replace(first, timestamp_ns=first.timestamp_ns + 60_000_000_000)
    for image, problem in ((small, "48x32 pixels; expected 96x64"), (late, "none with a sweep")):
        with pytest.raises(DataError, match=problem):
            calibration_frames(with_camera(drive.scene, images=LazyFrames.of([image], [image.timestamp_ns])))
    with pytest.raises(PoseError, match="not known"):
        calibration_frames(with_camera(drive.scene, mount=None, poses=None))
    first = drive.scene.lidars[0].frames[0]
    stationary = replace(drive.scene.lidars[0], frames=LazyFrames.of([first], [first.timestamp_ns]))
    sensors = tuple(stationary if s.id == "lidar" else s for s in drive.scene.sensors)
    scene = replace(drive.scene, sensors=sensors, trajectories={})
    frame = calibration_frames(scene, most=1)[0]
    assert len(frame.points_lidar) == len(first.points)


def with_camera(scene, **changes):
    sensors = [replace(s, **changes) if s.id == "camera0" else s for s in scene.sensors]
    return replace(scene, sensors=tuple(sensors))


def scanned(lines=16, steps=360):
    """Points on a round wall, line after line from below, each a full rotation from the front."""
    rings = np.repeat(np.arange(lines), steps)
    azimuths = np.tile(np.linspace(0.001, 2 * np.pi - 0.001, steps), lines)
    elevations, ranges = np.radians(-15.0 + 2.0 * rings), 10.0 + 0.3 * np.sin(7 * azimuths)
    directions = [np.cos(elevations) * np.cos(azimuths), np.cos(elevations) * np.sin(azimuths), np.sin(elevations)]
    return (ranges * np.array(directions)).T.copy(), rings


def test_lines_are_reported_by_rings_by_the_order_of_the_file_or_by_elevations_if_there_are_any():
    points, rings = scanned()
    shuffled, plain = np.random.default_rng(1).permutation(len(points)), np.arange(len(points))
    for order, known in ((plain, rings.astype(np.uint16)), (plain, None), (shuffled, None)):
        scan = find_scan_order(points[order], known)
        assert scan is not None
        assert scan.count == 16
        assert (rings[order][scan.order] == scan.lines).all()
        assert np.degrees([scan.spacing, scan.step]) == pytest.approx([2.0, 1.0], abs=0.01)
    scan = find_scan_order(points, None)
    assert scan is not None
    same = np.diff(scan.lines) == 0
    assert (np.diff(scan.azimuths)[same] > 0).all()
    assert find_scan_order(np.random.default_rng(2).normal(size=(5000, 3)) * 10.0, None) is None
    assert find_scan_order(scanned()[0][:20], None) is None
    assert find_scan_order(np.zeros((500, 3)), None) is None


CAMERA_FROM_LIDAR = RigidTransform(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.zeros(3))
STEP = np.radians(0.5)
AZIMUTHS = STEP * (np.arange(80) - 39.5)
ELEVATIONS = np.radians(-4.0 + 1.0 * np.arange(9))


def frame_of(ranges, intensities=None):
    """A sweep of (9, 80) ranges, lowest line first, before a dark image."""
    rotations, heights = np.meshgrid(AZIMUTHS, ELEVATIONS)
    points = directions_at(rotations.ravel(), heights.ravel()) * ranges.reshape(-1, 1)
    rings = np.repeat(np.arange(9, dtype=np.uint16), 80)
    images = {"grey": np.zeros((32, 64), np.float32), "rgb": np.zeros((32, 64, 3), np.uint8)}
    return CalibrationFrame(
        **{"camera_id": "camera0", "lidar_id": "lidar", "index": 0, "image_ns": 0, "sweep_ns": 0, **images},
        camera=Camera("pinhole", 64, 32, 40.0, 40.0, 31.5, 15.5), camera_from_lidar=CAMERA_FROM_LIDAR,
        points_lidar=points, intensities=intensities, seconds=None, scan=find_scan_order(points, rings),
    )  # fmt: skip


def edges_of(ranges):
    return find_depth_edges(frame_of(ranges), np.arange(720))


def test_contrasts_are_those_of_points_between_two_of_the_same_surface():
    levels = np.array([10, 40, 20, 90, 30, 60, 200, 10, 50], np.uint8)
    frame = frame_of(np.full((9, 80), 20.0), np.repeat(levels, 80))
    cues = find_cues(frame, frame.camera)
    points, contrasts = cues.points_lidar[cues.maps == 4], cues.weights[cues.maps == 4]
    lines = np.rint(np.degrees(np.arcsin(points[:, 2] / 20.0)) + 4.0).astype(int)
    expected = 2.0 * levels.astype(float)
    expected[1:-1] -= levels[:-2].astype(float) + levels[2:]
    expected[[0, -1]] = 0.0  # nothing is below, above
    scale = np.abs(contrasts).max() / np.abs(expected).max()
    np.testing.assert_allclose(contrasts, scale * expected[lines], rtol=1e-5)
    assert set(lines) == set(range(9))


def test_edges_lie_halfway_between_a_board_and_a_wall_and_on_walls_that_recede_but_not_on_steep_planes():
    ranges = np.full((9, 80), 20.0)
    ranges[:, 30:50] = 5.0
    edges = edges_of(ranges)
    azimuths = np.arctan2(edges.points_lidar[:, 1], edges.points_lidar[:, 0])
    assert len(azimuths) == 18  # on the left and on the right of each line
    np.testing.assert_allclose(np.sort(np.abs(azimuths)), 10 * STEP, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(edges.points_lidar, axis=1), 5.0, rtol=1e-9)
    ranges = np.full(80, 60.0)
    ranges[20:] = (6.0 / np.cos(AZIMUTHS - 1.0))[20:]
    edges = edges_of(ranges / np.cos(ELEVATIONS)[:, None])
    assert len(edges.weights) == 9
    azimuths = np.arctan2(edges.points_lidar[:, 1], edges.points_lidar[:, 0])
    np.testing.assert_allclose(azimuths, 0.5 * (AZIMUTHS[19] + AZIMUTHS[20]), atol=1e-9)
    # the last point is 0.2 m nearer; chords between a plane's points leave millimetres
    there = 6.0 / np.cos(azimuths - 1.0)
    np.testing.assert_allclose(np.linalg.norm(edges.points_lidar[:, :2], axis=1), there, rtol=1e-3)
    # a roof half a metre below: from line to line the range grows by metres
    heights = np.append(0.5 / np.sin(-ELEVATIONS[:4]), np.full(5, 100.0))
    assert len(edges_of(np.repeat(heights[:, None], 80, axis=1)).weights) == 0
    # nothing reports how far it goes on: a roof whose far end lies behind its near one
    ranges = np.full((9, 80), 50.0)
    ranges[:4], ranges[4] = 8.0, 11.0
    edges = edges_of(ranges)
    np.testing.assert_allclose(np.linalg.norm(edges.points_lidar, axis=1), 8.0, rtol=1e-9)
