"""Axes of declared frames, and records of table 3 as camera models and mountings in frames of any axes."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.cameras.camera import Camera
from sceneloom.db34t.setting import CalibrationEntry, DeclaredAxes, SensorKind, calibrated_pair, calibration_data
from sceneloom.errors import CalibrationError
from sceneloom.geometry.rigid import RigidTransform

from .test_records import CALIBRATION

CAMERA_AXES = DeclaredAxes.of_triple((2, 0, -1), left_handed=False)
LIDAR_AXES = DeclaredAxes.of_triple((0, -1, 2), left_handed=False)


@pytest.mark.parametrize(
    ("triple", "left_handed", "words"),
    [
        ((2, 0, -1), False, "+z,+x,-y"),  # table 2's example of a camera
        ((0, -1, 2), False, "+x,-y,+z"),  # and of a lidar
        ((2, 0, -1), True, "+z,-x,-y"),
        ((0, -1, 2), True, "-x,-y,+z"),
        ((1, 0, 2), False, "+y,+x,+z"),  # y forward, x right, z up, as of nuScenes' lidar
        ((0, 1, 2), False, "-x,+y,+z"),
    ],
)
def test_a_triple_says_what_its_words_state(triple, left_handed, words):
    by_triple = DeclaredAxes.of_triple(triple, left_handed=left_handed)
    assert by_triple.words == words
    assert by_triple.left_handed is left_handed
    np.testing.assert_array_equal(DeclaredAxes.of_words(words).forward_right_up, by_triple.forward_right_up)


def test_a_left_handed_frame_is_mirrored_on_the_way_in_and_those_of_the_examples_are_used_inside():
    mirrored, inside = DeclaredAxes.of_words("+x,+y,+z"), np.eye(3)
    for axes, kind, expected in (
        (CAMERA_AXES, "CAMERA", inside),
        (LIDAR_AXES, "LIDAR", inside),
        (mirrored, "LIDAR", np.diag([1, -1, 1])),
    ):
        np.testing.assert_array_equal(axes.standard_from_declared(SensorKind[kind]), expected)


@pytest.mark.parametrize(
    "axes", [(0, 1), (0, 1, 1), (0, -1, 3), (0, 1, 2, 0), "", "+x", "+x,+y", "+x,+x,+z", "a,b,c", "+x,-y,+z,+x"]
)
def test_triples_and_words_that_are_no_axes_are_refused(axes):
    with pytest.raises(CalibrationError, match="axes"):
        DeclaredAxes.of_words(axes) if isinstance(axes, str) else DeclaredAxes.of_triple(axes, left_handed=False)


FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
PINHOLE = Camera("pinhole", 640, 480, 500.0, 500.0, 319.5, 239.5)


def declared_record(rotation, translation, *, by_rows=False, reference_frame=0):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    numbers = (matrix if by_rows else matrix.T).reshape(-1).tolist()
    return replace(CALIBRATION, extrinsic_matrix=numbers, reference_frame=reference_frame)


def test_the_example_of_the_standard_looks_forward_from_beside_the_lidar():
    pair = calibrated_pair(CALIBRATION, CAMERA_AXES, LIDAR_AXES)
    np.testing.assert_allclose(pair.camera_from_lidar.rotation, FORWARD, atol=0.008)  # it is rotated by 0.4°
    np.testing.assert_allclose(pair.camera_from_lidar.translation, (-0.0062, 0.0756, 0.0337))
    assert pair.notes == ()
    assert (pair.camera.fx, pair.camera.cy, pair.camera.coefficients[4]) == (468.3708, 235.6143, 0.0429)


@pytest.mark.parametrize("translation", [(1, 2, 3), (0, 0, 0)])
@pytest.mark.parametrize("by_rows", [False, True])
def test_the_layout_is_known_by_the_translation_or_else_by_which_looks_forward(by_rows, translation):
    pair = calibrated_pair(declared_record(FORWARD, translation, by_rows=by_rows), CAMERA_AXES, LIDAR_AXES)
    np.testing.assert_allclose(pair.camera_from_lidar.rotation, FORWARD, atol=1e-12)
    np.testing.assert_array_equal(pair.camera_from_lidar.translation, translation)
    back = (-FORWARD.T @ translation).tolist()
    data = declared_record(FORWARD.T, back, by_rows=by_rows, reference_frame=1)  # which maps into the lidar
    into_lidar = calibrated_pair(data, CAMERA_AXES, LIDAR_AXES)
    np.testing.assert_allclose(into_lidar.camera_from_lidar.matrix, pair.camera_from_lidar.matrix, atol=1e-12)


@pytest.mark.parametrize("left_handed", [False, True])
@pytest.mark.parametrize(
    "triple", [t for order in itertools.permutations(range(3)) for t in itertools.product(*[{a, -a} for a in order])]
)
def test_axes_of_any_frame_lead_to_the_same_mounting(triple, left_handed):
    axes = DeclaredAxes.of_triple(triple, left_handed=left_handed)
    assert axes.left_handed is left_handed
    camera_axes = DeclaredAxes.of_triple((2, 0, -1), left_handed=left_handed)
    inside = RigidTransform(FORWARD, np.array([0.1, -0.2, 0.3]))
    data = calibration_data(PINHOLE, inside, camera_axes, axes)
    declared = np.reshape(data.extrinsic_matrix, (4, 4)).T
    # a point 5 m before, 1 m left of and 2 m above the lidar, in the declared frame by the triple's own words
    point = axes.forward_right_up @ (5.0, -1.0, 2.0)
    seen = declared[:3, :3] @ point + declared[:3, 3]
    right, down, forward = FORWARD @ (5.0, 1.0, 2.0) + (0.1, -0.2, 0.3)
    np.testing.assert_allclose(camera_axes.forward_right_up.T @ seen, (forward, right, -down), atol=1e-12)
    again = calibrated_pair(data, camera_axes, axes)
    np.testing.assert_allclose(again.camera_from_lidar.matrix, inside.matrix, atol=1e-12)
    assert np.linalg.det(declared[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("rotation_deg", [44, 46, 90, 180])
def test_a_camera_that_looks_far_off_forward_is_remarked(rotation_deg):
    rotation = FORWARD @ Rotation.from_euler("z", rotation_deg, degrees=True).as_matrix()
    pair = calibrated_pair(declared_record(rotation, (0, 0, 1)), CAMERA_AXES, LIDAR_AXES)
    assert bool(pair.notes) is (rotation_deg > 45)
    assert all("mirrored or transposed?" in note for note in pair.notes)


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        ({"extrinsic_matrix": (1.0,) * 16}, "0 0 0 1"),
        ({"extrinsic_matrix": (2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 1, 1)}, "rotation is off"),
        ({"intrinsic_matrix": (500, 0, 0, 0, 500, 0, 320, 240, 1)}, "row after row"),
        ({"intrinsic_matrix": (-500, 0, 320, 0, 500, 240, 0, 0, 1)}, "focal lengths"),
    ],
)
def test_numbers_that_are_no_calibration_are_refused(changed, problem):
    with pytest.raises(CalibrationError, match=problem):
        CalibrationEntry(1, 0, replace(CALIBRATION, **changed))


def test_a_camera_model_without_distortion_is_a_pinhole_and_one_that_table_3_lacks_is_refused_by_name():
    assert (
        calibrated_pair(replace(CALIBRATION, distortion_coeffs=(0,) * 5), CAMERA_AXES, LIDAR_AXES).camera.model
        == "pinhole"
    )
    fisheye = Camera("fisheye", 640, 480, 300.0, 300.0, 319.5, 239.5, (0.1, 0.0, 0.0, 0.0))
    with pytest.raises(CalibrationError, match="fisheye"):
        calibration_data(fisheye, RigidTransform.identity(), CAMERA_AXES, LIDAR_AXES)
    with pytest.raises(CalibrationError, match="mirrors"):
        calibrated_pair(declared_record(np.diag([-1.0, 1.0, 1.0]) @ FORWARD, (0, 0, 1)), CAMERA_AXES, LIDAR_AXES)
