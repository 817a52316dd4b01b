"""Frames: every way to write a transform means the same, and chains of them agree with SciPy's rotations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.errors import CalibrationError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.rig.reader import Edge, FrameTree, frame_from_optical, read_transform
from sceneloom.geometry.rigid import RigidTransform

from .conftest import codes

ROTATION = Rotation.from_euler("ZYX", [30.0, -20.0, 10.0], degrees=True)
SHIFT = np.array([1.0, -2.0, 3.0])
MATRIX = np.vstack([np.column_stack([ROTATION.as_matrix(), SHIFT]), [0, 0, 0, 1]])


def read(record, ledger=None):
    arrays = {name: value if name == "euler_order" else np.asarray(value) for name, value in record.items()}
    return read_transform(arrays, "here", ledger or Ledger(lenient=False))


def test_all_ways_to_write_a_transform_mean_the_same_and_a_rotation_that_is_a_little_off_is_repaired():
    for record in (
        {"translation": SHIFT, "quaternion_xyzw": ROTATION.as_quat()},
        {"translation": SHIFT, "quaternion_wxyz": np.roll(ROTATION.as_quat(), 1)},
        {"translation": SHIFT, "rotation_matrix": ROTATION.as_matrix()},
        # capital letters are SciPy's intrinsic rotations: Rz(yaw)·Ry(pitch)·Rx(roll)
        {"translation": SHIFT, "euler_deg": [10.0, -20.0, 30.0], "euler_order": "zyx"},
        {"matrix": MATRIX},
        {"matrix": MATRIX[:3]},
    ):
        np.testing.assert_allclose(read(record).matrix, MATRIX, atol=1e-12, err_msg=[*record][-1])
    ledger = Ledger(lenient=False)
    found = read({"rotation_matrix": ROTATION.as_matrix() * 1.002}, ledger)
    np.testing.assert_allclose(found.rotation, ROTATION.as_matrix(), atol=1e-12)
    assert [(warning.code, warning.location) for warning in ledger.warnings] == [("rotation-normalised", "here")]


@pytest.mark.parametrize(
    ("record", "problem"),
    [
        ({}, "no transform; expected matrix, or translation and one of"),
        ({"matrix": MATRIX, "translation": SHIFT}, "matrix beside translation"),
        ({"quaternion_xyzw": [0, 0, 0, 1], "euler_deg": [0, 0, 0]}, "quaternion_xyzw and euler_deg; expected one"),
        ({"euler_deg": [0, 0, 0]}, "euler_deg and euler_order; expected both"),
        ({"quaternion_xyzw": [0, 0, 0, 2.0]}, "length 2.0000; expected 1"),
        ({"rotation_matrix": np.diag([1.0, 1.0, -1.0])}, "mirrored or singular"),
        ({"rotation_matrix": np.eye(3) * 1.01}, "off by 0.02"),
        ({"matrix": MATRIX.T}, "last row"),
    ],
)
def test_what_is_no_transform_is_refused(record, problem):
    with pytest.raises(CalibrationError, match=problem):
        read(record)


def edge(source, target, seed):
    rng = np.random.default_rng(seed)
    transform = RigidTransform(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    return Edge(source, target, transform, f"{source} to {target}")


def test_loops_that_agree_are_taken_and_contradictions_and_frames_without_connection_reported():
    one, two = edge("a", "base", 1), edge("b", "a", 2)
    closing = one.target_from_source @ two.target_from_source
    loop = Edge("b", "base", closing, "b to base")
    np.testing.assert_allclose(FrameTree("base", [one, two, loop]).ego_from("b").matrix, closing.matrix, atol=1e-12)
    tree = FrameTree("base", [one, edge("cam", "rig", 2)])
    assert (tree.frames, tree.loose) == (("base", "a", "cam", "rig"), ("cam", "rig"))
    for failing, problem in (
        (lambda: FrameTree("base", [one, two, Edge("base", "b", closing, "transforms[2]")]),
         r"contradicts the chain 'b' - 'base' - 'a' by .* m and .*°; is one of these"),
        (lambda: tree.ego_from("cam"), "'cam' to the ego's frame 'base'; it is connected with 'rig', the ego's"),
        (lambda: tree.ego_from("radar"),
         r"\(known frames: 'base', 'a', 'cam', 'rig'\); give it an `extrinsic`"),
        (lambda: FrameTree("base", [edge("a", "a", 1)]), "from 'a' to itself"),
    ):  # fmt: skip
        with pytest.raises(CalibrationError, match=problem):
            failing()


def test_axes_state_what_points_right_down_and_forward_and_mirrors_are_refused():
    for axes, rotated in (
        (("optical",), [[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        (("flu",), [[0, -1, 0], [0, 0, -1], [1, 0, 0]]),
        (("frd",), [[0, 1, 0], [0, 0, 1], [1, 0, 0]]),
        (("-y", "-z", "+x"), [[0, -1, 0], [0, 0, -1], [1, 0, 0]]),
        (("x", "z", "-y"), [[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
    ):
        assert frame_from_optical(axes).rotate(np.eye(3)).tolist() == rotated, axes
    for axes in (("body",), ("-y", "+z", "+x"), ("x", "x", "y"), ("x", "y"), ("x", "y", "w"), ("",)):
        with pytest.raises(CalibrationError):
            frame_from_optical(axes)


def test_both_directions_of_an_extrinsic_mean_the_same_and_angles_that_look_like_radians_are_remarked(opened):
    as_it_is = opened().cameras[0].mount.matrix
    inverse = opened(('to = "top", translation = [0.5, 0.0, -0.5]', 'from = "top", translation = [-0.5, 0.0, 0.5]'))
    np.testing.assert_allclose(inverse.cameras[0].mount.matrix, as_it_is, atol=1e-12)
    for euler, remarked in (
        ("[-1.5708, 0, -1.5708]", True), ("[0, 0, 3.14]", True), ("[1.5, 0.2, -0.8]", False), ("[0, 0, 0]", False),
    ):  # fmt: skip
        scene = opened(("quaternion_xyzw = [0.0, 0.0, 0.0, 1.0]", f'euler_deg = {euler}\neuler_order = "zyx"'))
        assert codes(scene) == ["angles-in-radians"] * remarked, euler
