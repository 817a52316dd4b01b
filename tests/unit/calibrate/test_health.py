"""The check of a camera-lidar calibration."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import logm
from scipy.spatial.transform import Rotation

from sceneloom.calibrate import health as ch
from sceneloom.calibrate.frames import CalibrationFrame, calibration_frames
from sceneloom.calibrate.health import PARTS, CalibrationHealth, Item, Verdict, check_frames, judge
from sceneloom.calibrate.measures import Change
from sceneloom.cameras.camera import Camera
from sceneloom.detections.results import BoxFrame, BoxRotation
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

GOOD, DRIFTING, WRONG, UNTOLD = Verdict.GOOD, Verdict.DRIFTING, Verdict.WRONG, Verdict.UNDETERMINED


def test_a_rotation_is_judged_by_its_size_and_by_how_sure_it_is_in_the_units_that_it_names():
    for rotation_deg, sigma_deg, verdict in [
        *((0.0, 0.05, GOOD), (0.25, 0.05, GOOD), (0.32, 0.08, UNTOLD), (0.4, 0.05, DRIFTING), (0.7, 0.3, UNTOLD)),
        *((1.5, 0.05, WRONG), (0.0, 0.5, UNTOLD), (1.5, 0.7, UNTOLD), (1.5, 0.4, WRONG)),
    ]:
        item = judge("rotation", np.radians([rotation_deg, 0.0, 0.0]), np.radians(sigma_deg) ** 2 * np.eye(3))
        assert item.verdict is verdict
        assert bool(item.reason) is (verdict is not GOOD)
    item = judge("time_offset", np.array([0.03]), np.array([[0.003**2]]))
    # the deviation: 3 ms among replicates and 4 ms that the measures get wrong by themselves
    assert (item.unit, item.values, item.sigmas) == ("ms", (pytest.approx(30.0),), (pytest.approx(5.0),))
    assert item.verdict is DRIFTING
    spread = 4 * np.diag([0.05, 0.05, 0.05]) ** 2
    assert not judge("translation", np.zeros(3), spread).suspected
    assert judge("translation", np.array([0.27, 0.0, 0.0]), spread).suspected
    # 10 cm along each axis and 2 cm of the measures: 2 cm that calibrations are known to, and 3.5 deviations
    assert "less than 0.38 m would not be seen" in judge("translation", np.zeros(3), spread).reason


def test_the_numbers_of_a_change_are_those_of_the_logarithm_of_its_transform():
    rotation, translation = np.array([0.08, -0.05, 0.11]), np.array([0.3, -0.2, 0.4])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(rotation).as_matrix(), translation
    logarithm = logm(matrix).real
    expected = [logarithm[2, 1], logarithm[0, 2], logarithm[1, 0], *logarithm[:3, 3]]
    np.testing.assert_allclose(ch._screw(matrix), expected, atol=1e-9)


Frames = tuple[CalibrationFrame, ...]
AHEAD = Camera("pinhole", 620, 188, 360.0, 360.0, 309.5, 93.5)


@pytest.fixture(scope="module")
def frames():
    """Four images, more than half a second apart, of two seconds through a street, of half the usual size."""
    drive = simulate_street(31, frames=25, lidar=LidarSpec(beams=48, steps=1000), cameras=(CameraSpec(AHEAD),))
    return calibration_frames(drive.scene, most=4)


def stated(frames, camera_from_stated):
    return tuple(replace(frame, camera_from_lidar=camera_from_stated @ frame.camera_from_lidar) for frame in frames)


def rotated(frames, *rotation_deg):
    error = Change.rotation(np.radians(rotation_deg)).camera_from_lidar(np.eye(4))
    return stated(frames, RigidTransform.nearest(error)[0])


def repainted(frames, paint):
    painted = [paint(frame.rgb).astype(np.uint8) for frame in frames]
    greys = [rgb.mean(axis=2, dtype=np.float32) for rgb in painted]
    return tuple(replace(f, rgb=rgb, grey=grey) for f, rgb, grey in zip(frames, painted, greys, strict=True))


def thinned(frame, count):
    """A frame with its first points only, whose order is not known."""
    given = {name: getattr(frame, name) for name in ("points_lidar", "intensities", "seconds")}
    kept = {name: None if values is None else np.ascontiguousarray(values[:count]) for name, values in given.items()}
    return replace(frame, **kept, scan=None)


def test_a_true_calibration_is_good_and_a_camera_rotated_by_a_degree_is_not_and_the_rotation_is_found(frames):
    good = check_frames(frames)
    assert good.verdict is GOOD
    rotation = good.item("rotation")
    # what is found lies within what is stated for its uncertainty
    assert np.linalg.norm(np.array(rotation.values) / rotation.sigmas) < 3.0
    assert good.stated_distinctness > 4.5
    of_parts = {name for name in good.extent.removeprefix("in ").split(", ") if name}
    assert of_parts == {item.name.replace("_", " ") for item in good.items if item.verdict is GOOD} >= {"rotation"}
    injected = np.array([0.7, -0.5, 0.5])
    health = check_frames(rotated(frames, *injected))
    assert (health.verdict in {DRIFTING, WRONG}, health.extent) == (True, "")
    # 0.3 degrees: twice the uncertainty of each axis
    assert np.linalg.norm(np.array(health.item("rotation").values) + injected) < 0.3


@pytest.mark.parametrize("rotation_deg", [(0.0, 0.0, 180.0), (0.0, 180.0, 0.0), (25.0, 0.0, 0.0)])
@pytest.mark.few(1)
def test_a_camera_that_looks_elsewhere_is_never_good(frames, rotation_deg):
    assert check_frames(rotated(frames, *rotation_deg)).verdict in {WRONG, UNTOLD}


def test_images_or_clouds_that_show_nothing_of_the_street_state_nothing(frames):
    for paint, word in [
        (np.zeros_like, "dark"),
        (lambda rgb: rgb // 64, "dark"),
        (lambda rgb: np.full_like(rgb, 120), "covered"),
        (lambda rgb: np.random.default_rng(1).integers(0, 256, rgb.shape), ""),
        # another street
        (lambda rgb: np.roll(rgb[:, ::-1], 97, axis=1), ""),
    ]:
        health = check_frames(repainted(frames, paint))
        assert health.verdict is UNTOLD
        assert word in health.item("rotation").reason
        assert not word or {item.verdict for item in health.items} == {UNTOLD}
    filled = []
    for frame in repainted(frames, lambda rgb: np.full_like(rgb, 90)):
        points = frame.camera_from_lidar.apply(frame.points_lidar)
        ahead = points[:, 2] > 3.0
        points[ahead] *= 3.0 / points[ahead, 2:]
        filled.append(replace(frame, points_lidar=frame.camera_from_lidar.inverse().apply(points), scan=None))
    assert check_frames(filled).verdict is UNTOLD
    for count in [0, 1, 20]:
        health = check_frames(tuple(thinned(frame, count) for frame in frames))
        assert health.verdict is UNTOLD
        assert "points fall into" in health.item("rotation").reason
        if count == 0:  # as where the camera sees no point
            lifted = tuple(replace(f, points_lidar=f.points_lidar + np.array([0.0, 0.0, 500.0])) for f in frames)
            health = check_frames(lifted)
            assert health.verdict is UNTOLD
            assert health.item("rotation").reason.startswith("0 points")


def test_images_seconds_late_are_never_good_and_frames_from_one_location_are_one_view(frames):
    late = tuple(replace(f, rgb=later.rgb, grey=later.grey) for f, later in zip(frames[:-2], frames[2:], strict=True))
    assert (frames[2].image_ns - frames[0].image_ns) > 1_000_000_000
    assert check_frames(late).verdict in {WRONG, UNTOLD}
    assert ch.views_of((frames[0],) * 3).tolist() == [0, 0, 0]
    assert ch.views_of(frames).max() >= 1
    unplaced = tuple(replace(frame, world_from_lidar=None) for frame in frames)
    assert ch.views_of(unplaced).tolist() == [0] * len(frames)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(40, 52))
def test_over_many_streets_truth_is_good_and_what_is_off_is_not(seed):
    drive = simulate_street(seed, frames=60)
    frames = calibration_frames(drive.scene, most=8)
    assert check_frames(frames).verdict is not WRONG
    direction = np.random.default_rng(seed).normal(size=3)
    injected = direction / np.linalg.norm(direction)
    assert check_frames(rotated(frames, *injected)).verdict in {DRIFTING, WRONG}


PINHOLE = Camera("pinhole", 1242, 375, 720.0, 700.0, 620.5, 187.0)
FISHEYE = Camera("fisheye", 1280, 960, 400.0, 400.0, 639.5, 479.5, (0.03, -0.008, 0.002, -0.0004))


def fitted(shift):
    """Least squares by the derivatives of x/z and y/z by a rotation, in closed form: the rotation.

    And what is left [px].
    """
    u, v = np.meshgrid(np.linspace(-0.5, 1241.5, 41), np.linspace(-0.5, 374.5, 25))
    x, y = (u.ravel() - 620.5) / 720.0, (v.ravel() - 187.0) / 700.0
    pitch = np.column_stack([-720 * x * y, -700 * (1 + y * y)])
    yaw, roll = np.column_stack([720 * (1 + x * x), 700 * x * y]), np.column_stack([-720 * y, 700 * x])
    focal = np.column_stack([720 * x, 700 * y])
    columns = np.stack([part.ravel() for part in (pitch, yaw, roll, focal)], axis=1)
    wanted = np.tile(shift, len(x))
    found = np.linalg.lstsq(columns, wanted, rcond=None)[0]
    return found[:3], np.sqrt(((wanted - columns @ found) ** 2).sum() / len(x))


def test_a_rotation_looks_like_another_principal_point_as_the_formulas_of_a_pinhole_state():
    rotations, left = ch.look_alikes(PINHOLE)
    for row, shift in enumerate(([1.0, 0.0], [0.0, 1.0])):
        rotation, rest = fitted(shift)
        np.testing.assert_allclose(rotations[row], rotation, atol=1e-9)
        assert left[row] == pytest.approx(rest, rel=1e-5)
    # A pixel sideways is nearly 1/720 rad about y; tan² θ runs up to 0.74 and leaves a fifth of it.
    assert rotations[0, 1] * 720 == pytest.approx(0.8, abs=0.1)
    assert 0.15 < left[0] < 0.25
    long = Camera("pinhole", 1242, 375, 2880.0, 2800.0, 620.5, 187.0)
    assert (ch.look_alikes(long)[1] < 0.1 * ch.look_alikes(PINHOLE)[1]).all()
    assert (ch.look_alikes(FISHEYE)[1] > ch.look_alikes(PINHOLE)[1]).all()
    stated = ch.instead_of_rotation(PINHOLE, np.radians([0.0, 1.0, 0.0]))
    trajectory = np.radians(1.0) / rotations[0, 1]
    assert stated == f"its principal point {trajectory:.2g} px off looks the same within {trajectory * left[0]:.2g} px"
    assert ch.instead_of_rotation(PINHOLE, np.radians([0.1, 0.1, 1.0])) == ""
    assert f"by {trajectory:.3g} px to the side" in ch.why_untold(PINHOLE)
    # a camera model that sees nothing promises nothing
    blind = Camera("pinhole", 1, 1, 1e-9, 1e-9, 1e12, 1e12)
    assert ch.why_untold(blind).startswith("moving it")
    assert isinstance(ch.instead_of_rotation(blind, np.ones(3)), str)


AXES = Rotation.from_matrix([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def rotations(injected, *, rate_deg=1.5, count=60, noise_deg=0.02, seed=0):
    """A vehicle that rotates about its z axis; the camera is really rotated from where it is stated to be."""
    generator = np.random.default_rng(seed)
    lidar = np.radians(rate_deg) * np.array([0.0, 0.0, 1.0]) * generator.uniform(0.5, 1.0, (count, 1))
    lidar = lidar + np.radians(0.02) * generator.normal(size=(count, 3))
    camera = (injected * AXES).apply(lidar) + np.radians(noise_deg) * generator.normal(size=(count, 3))
    return camera, lidar, AXES.as_matrix()


def test_a_rotation_across_the_axis_is_found_however_large_a_small_one_or_along_it_is_not():
    for size_deg in [4.0, 20.0, 90.0, 150.0]:
        injected = Rotation.from_rotvec([size_deg, 0.0, 0.0], degrees=True)
        item = ch.judge_motion(*rotations(injected))
        # 0.02 degrees against a degree, sixty times: 0.15 degrees
        assert (item.verdict, abs(item.values[0])) == (WRONG, pytest.approx(size_deg, abs=0.6))
        assert abs(item.values[1]) < 0.6
    for injected_deg, more, verdict in [
        # none, small, along the axis, upside down
        ((0.0, 0.0, 0.0), {}, GOOD),
        ((0.5, 0.0, 0.5), {}, GOOD),
        ((0.0, 30.0, 0.0), {}, GOOD),
        ((0.0, 0.0, 180.0), {}, WRONG),
        # a drive that hardly rotates or is hardly seen
        ((4.0, 0.0, 0.0), {"rate_deg": 0.05}, UNTOLD),
        ((4.0, 0.0, 0.0), {"count": 10}, UNTOLD),
        ((4.0, 0.0, 0.0), {"noise_deg": 2.0}, UNTOLD),
    ]:
        assert ch.judge_motion(*rotations(Rotation.from_rotvec(injected_deg, degrees=True), **more)).verdict is verdict


SURE = np.radians(0.05) ** 2 * np.eye(3)


def rotation(*rotation_deg, sigma_deg=0.05, agreeing=200, by_chance=10, images=50):
    covariance = np.radians(sigma_deg) ** 2 * np.eye(3)
    return BoxRotation(np.radians(rotation_deg), covariance, agreeing, by_chance, images)


LIDAR = (BoxFrame.LIDAR,)


def images_state(rotation_deg, *, stated=8.0):
    """What images and points state: a rotation about x, or nothing."""
    rotation = Item.unknown("rotation", "dark")
    if rotation_deg is not None:
        rotation = judge("rotation", np.radians([rotation_deg, 0.0, 0.0]), SURE)
    items = rotation, *(Item.unknown(name, "dark") for name in PARTS[1:])
    about = {"source": "made up", "camera_id": "camera", "lidar_id": "lidar", "verdict": rotation.verdict}
    standing = {"frames": 4, "views": 2, "distinctness": 8.0, "stated_distinctness": stated}
    return CalibrationHealth(**about, items=items, **standing)


def test_boxes_are_judged_by_their_rotation_join_decide_or_contradict_what_images_state():
    for found, verdicts in [
        (rotation(0.1, -0.1, 0.3), (GOOD, GOOD)),
        (rotation(0.8, 0.0, 0.0), (DRIFTING, GOOD)),
        (rotation(0.0, 3.0, 0.5), (WRONG, GOOD)),
        (rotation(0.0, 0.0, 2.5), (GOOD, WRONG)),
        # its own 0.4 degrees make 1.05 degrees about the axis of visibility chance
        (rotation(0.0, 0.0, 1.05), (GOOD, UNTOLD)),
        (rotation(3.0, 0.0, 0.0, sigma_deg=1.3), (UNTOLD, UNTOLD)),
        (rotation(3.0, 0.0, 0.0, agreeing=30), (UNTOLD, UNTOLD)),
        (rotation(3.0, 0.0, 0.0, images=6), (UNTOLD, UNTOLD)),
        (rotation(3.0, 0.0, 0.0, by_chance=120), (UNTOLD, UNTOLD)),
        (None, (UNTOLD, UNTOLD)),
    ]:
        items = ch.judge_boxes(found, LIDAR)
        assert tuple(item.verdict for item in items) == verdicts
        assert all(bool(item.reason) is (item.verdict is not GOOD) for item in items)
    for images_deg, found, verdict in [
        (None, rotation(0.1, 0.0, 0.0), GOOD),
        (None, rotation(3.0, 0.0, 0.0), WRONG),
        (None, rotation(0.0, 0.0, 2.5), WRONG),
        (None, None, UNTOLD),
        (0.0, None, GOOD),
        (0.0, rotation(0.1, 0.0, 0.0), GOOD),
        (0.6, rotation(0.3, 0.0, 0.0), DRIFTING),
        (1.5, rotation(1.3, 0.0, 0.0), WRONG),
        (1.5, None, WRONG),
    ]:
        health = images_state(images_deg).with_boxes(found, LIDAR)
        assert health.verdict is verdict
        assert [item.name for item in health.items] == [*PARTS, "boxes", "boxes_roll"]
    untold = CalibrationHealth.of_boxes(None, LIDAR, source="made up", camera_id=0, lidar_id=0, frames=0)
    good, wrong = (judge("motion", np.radians([d, 0.0]), np.zeros((2, 2))) for d in (0.0, 9.0))
    assert untold.with_coarse(good).verdict is UNTOLD
    assert untold.with_coarse(wrong).verdict is WRONG
    right = type(untold)(**{f: getattr(untold, f) for f in untold.__struct_fields__} | {"verdict": GOOD})
    assert right.with_coarse(Item.unknown("motion", "stood")).verdict is GOOD
    doubtful = right.with_coarse(wrong)
    assert (doubtful.verdict, ", but " in doubtful.item("motion").reason) == (UNTOLD, True)
    for images_deg, found in ((0.0, rotation(3.0, 0.0, 0.0)), (1.5, rotation(0.0, 0.0, 0.0))):
        health = images_state(images_deg).with_boxes(found, LIDAR)
        assert health.verdict is UNTOLD
        assert ", but " in health.item("boxes").reason
    # good boxes do not excuse images that agree much better elsewhere
    health = images_state(0.0, stated=4.0)
    doubted = CalibrationHealth(**{**{k: getattr(health, k) for k in health.__struct_fields__}, "verdict": UNTOLD})
    assert doubted.with_boxes(rotation(0.0, 0.0, 0.0), LIDAR).verdict is UNTOLD
    assert doubted.with_boxes(rotation(3.0, 0.0, 0.0), LIDAR).verdict is WRONG
    health = CalibrationHealth.of_boxes(
        rotation(3.0, 0.0, 0.0), LIDAR, source="0001", camera_id=2, lidar_id=0, frames=50
    )
    assert (health.verdict, health.views, health.frames) == (WRONG, 0, 50)
    assert {item.verdict for item in health.items[:5]} == {UNTOLD}
    assert health.item("boxes").values == pytest.approx((3.0, 0.0))


@pytest.mark.parametrize("frame", [BoxFrame.CAMERA, BoxFrame.WORLD])
def test_boxes_that_are_not_stated_in_the_lidars_frame_say_nothing_of_the_lidar(frame):
    for images_deg, found, verdict in [
        (None, rotation(0.0, 0.0, 0.0), UNTOLD),
        (None, rotation(3.0, 0.0, 0.0), WRONG),
        (None, None, UNTOLD),
        (0.0, rotation(0.0, 0.0, 0.0), GOOD),
        (0.0, rotation(3.0, 0.0, 0.0), UNTOLD),
        (1.5, rotation(0.0, 0.0, 0.0), WRONG),
    ]:
        health = images_state(images_deg).with_boxes(found, (BoxFrame.LIDAR, frame))
        assert health.verdict is verdict
        assert [item.name for item in health.items[len(PARTS) :]] == [
            "boxes_projection",
            "boxes_projection_roll",
            "boxes",
        ]
        assert health.item("boxes").verdict is UNTOLD
        assert "cancel" in health.item("boxes").reason
        assert health.item("boxes_projection").judged != "camera_from_lidar"
