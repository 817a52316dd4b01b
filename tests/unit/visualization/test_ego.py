import numpy as np
import pytest

from sceneloom.geometry.rigid import RigidTransform
from sceneloom.visualization.clouds import EgoPosition, find_ego, middle_of

# An IMU whose x points to the left of the car, as z stays up.
ROTATED = RigidTransform(
    np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([5.0, 0.0, 1.0])
)


def test_forward_is_where_the_path_leads_not_where_the_imu_points():
    path = np.column_stack([np.linspace(0, 10, 11), np.zeros(11), np.linspace(0, 2, 11)])
    ego = find_ego(ROTATED, path, ())
    assert ego.position_world.tolist() == [5.0, 0.0, 1.0]
    assert ego.forward_world == pytest.approx([1.0, 0.0, 0.0])


def test_on_a_bend_forward_is_the_tangent():
    angles = np.linspace(0, np.pi, 181)
    path = np.column_stack([30 * np.cos(angles), 30 * np.sin(angles), np.zeros(181)])
    ego = find_ego(RigidTransform(np.eye(3), path[90].copy()), path, ())
    # The path is known every 0.5 m of a circle of 30 m: half a step is 0.0087 rad.
    assert ego.forward_world == pytest.approx([-1.0, 0.0, 0.0], abs=0.01)


def test_an_ego_that_is_stationary_faces_where_its_first_camera_looks(make_view):
    view = make_view([])
    for path in (None, np.zeros((5, 3)), np.zeros((0, 3)), np.full((3, 3), np.nan)):
        assert find_ego(ROTATED, path, [view]).forward_world == pytest.approx([1.0, 0.0, 0.0])
    assert find_ego(ROTATED, None, ()).forward_world == pytest.approx([0.0, 1.0, 0.0])


def test_a_camera_stands_in_for_an_unknown_ego(make_view):
    view = make_view([])
    assert find_ego(None, None, [view]).position_world == pytest.approx(view.world_from_camera.translation)
    assert find_ego(None, None, ()) is None


def test_an_ego_that_looks_straight_up_faces_somewhere_level():
    upright = RigidTransform(np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]), np.zeros(3))
    assert find_ego(upright, None, ()).forward_world == pytest.approx([1.0, 0.0, 0.0])


def test_the_arrow_points_forward_and_is_as_long_as_asked():
    corners = EgoPosition(np.array([1.0, 2.0, 3.0]), np.array([0.0, 1.0, 0.0])).arrow(2.0)
    assert np.ptp(corners, axis=0)[1] == pytest.approx(2.0)
    assert corners[0] == pytest.approx([1.0, 2.0 + 1.2, 3.0])
    assert corners[:, 0].mean() == pytest.approx(1.0)


def test_the_middle_of_no_points_is_the_origin():
    assert middle_of(np.zeros((0, 3))).position_world.tolist() == [0.0, 0.0, 0.0]
    assert middle_of(
        np.array([[1.0, 5.0, 0.0], [2.0, 4.0, 9.0], [90.0, 3.0, 1.0]])
    ).position_world.tolist() == [2, 4, 1]
