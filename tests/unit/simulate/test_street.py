from itertools import combinations

import numpy as np
import pytest

from sceneloom.simulate.objects import ShapeKind
from sceneloom.simulate.street import GroundMap, Lane, build_street
from sceneloom.simulate.trajectory import plan_path


@pytest.fixture(scope="module", params=[0, 1, 2])
def built(request):
    path = plan_path(np.random.default_rng(request.param), start_ns=0, duration=15.0)
    return path, build_street(np.random.default_rng(100 + request.param), path)


def in_any_shape(packed, points):
    """Which of (N, 3) world points lie in any shape; the unit bodies are written out once more."""
    inside = np.zeros(len(points), bool)
    for k in range(len(packed)):
        local = points @ packed.maps[k, :, :3].T + packed.maps[k, :, 3]
        x, y, z = np.abs(local).T
        rule = {
            ShapeKind.BOX: (x <= 1) & (y <= 1) & (z <= 1),
            ShapeKind.CYLINDER: (np.hypot(x, y) <= 1) & (z <= 1),
            ShapeKind.ELLIPSOID: np.linalg.norm(local, axis=1) <= 1,
            ShapeKind.GABLE: (x <= 1) & (z <= 1) & (y <= (1 - local[:, 2]) / 2),
        }[ShapeKind(packed.kinds[k])]
        inside |= rule
    return inside


@pytest.mark.few(1)
def test_nothing_stands_in_the_ego_trajectory(built):
    path, street = built
    states = path.at_seconds(np.arange(-1.0, 16.0, 0.1))
    left = states.rotations[:, :, 1]
    swept = [
        states.positions + across * left + [0, 0, height]
        for across in np.linspace(-1.1, 1.1, 5)
        for height in (0.1, 0.6, 1.2, 1.8, 2.2)
    ]
    assert not in_any_shape(street.shapes, np.concatenate(swept)).any()


def plan_corners(thing):
    length, width, _ = thing.size_lwh
    rotation = np.array([[np.cos(thing.yaw), -np.sin(thing.yaw)], [np.sin(thing.yaw), np.cos(thing.yaw)]])
    grid = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.5, 0.5, 9)), -1).reshape(-1, 2)
    return (grid * [length, width]) @ rotation.T + thing.center_world[:2]


def test_houses_cars_and_bins_do_not_stand_in_one_another(built):
    solid = [thing for thing in built[1].objects if thing.label in {"building", "car", "bin", "barrier"}]
    grids = {thing.instance: plan_corners(thing) for thing in solid}
    for a, b in combinations(solid, 2):
        apart = np.hypot(*np.subtract(a.center_world[:2], b.center_world[:2]))
        if apart > np.hypot(*a.size_lwh[:2]) / 2 + np.hypot(*b.size_lwh[:2]) / 2:
            continue
        cosine, sine = np.cos(b.yaw), np.sin(b.yaw)
        local = (grids[a.instance] - b.center_world[:2]) @ np.array([[cosine, -sine], [sine, cosine]])
        assert not (np.abs(local) < np.array(b.size_lwh[:2]) / 2).all(axis=1).any()


def test_the_box_of_an_object_holds_all_its_shapes(built):
    _, street = built
    generator = np.random.default_rng(0)
    on_ball = generator.normal(size=(400, 3))
    on_ball /= np.linalg.norm(on_ball, axis=1, keepdims=True)
    rim = on_ball[:, :2] / np.linalg.norm(on_ball[:, :2], axis=1, keepdims=True)
    samples = {
        ShapeKind.BOX: np.clip(on_ball * 2, -1, 1),
        ShapeKind.CYLINDER: np.column_stack([rim, np.sign(on_ball[:, 2])]),
        ShapeKind.ELLIPSOID: on_ball,
        ShapeKind.GABLE: np.column_stack([np.sign(on_ball[:, :2]), -np.ones(400)]),
    }
    for k in range(len(street.shapes)):
        thing = street.objects[street.shapes.instances[k] - 1]
        world_from_unit = np.linalg.inv(np.vstack([street.shapes.maps[k], [0, 0, 0, 1]]))
        local = samples[ShapeKind(street.shapes.kinds[k])]
        world = local @ world_from_unit[:3, :3].T + world_from_unit[:3, 3]
        cosine, sine = np.cos(thing.yaw), np.sin(thing.yaw)
        away = (world - thing.center_world) @ np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        assert (np.abs(away) <= np.array(thing.size_lwh) / 2 + 1e-9).all(), thing.label


def test_a_street_has_something_of_everything(built):
    labels = {thing.label for thing in built[1].objects}
    assert labels == {"building", "car", "tree", "pole", "bin", "barrier"}
    kinds = np.unique(built[1].shapes.kinds)
    assert kinds.tolist() == [0, 1, 2, 3]


def test_objects_are_numbered_from_one_in_their_order(built):
    assert [thing.instance for thing in built[1].objects] == list(range(1, len(built[1].objects) + 1))


def test_the_bounding_balls_hold_their_shapes(built):
    packed = built[1].shapes
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    for k in np.flatnonzero(packed.kinds == ShapeKind.BOX):
        world_from_unit = np.linalg.inv(np.vstack([packed.maps[k], [0, 0, 0, 1]]))
        world = corners @ world_from_unit[:3, :3].T + world_from_unit[:3, 3]
        assert np.linalg.norm(world - packed.spheres[k, :3], axis=1).max() <= packed.spheres[k, 3] + 1e-9


def test_the_same_seed_builds_the_same_street_and_another_one_another():
    path = plan_path(np.random.default_rng(0), start_ns=0, duration=3.0)
    first, again, other = (build_street(np.random.default_rng(seed), path) for seed in (7, 7, 8))
    assert first.objects == again.objects
    np.testing.assert_array_equal(first.shapes.maps, again.shapes.maps)
    assert first.objects != other.objects


def test_the_map_of_the_ground_knows_how_far_along_and_left_of_the_trajectory_its_nodes_lie():
    lane = Lane.of(plan_path(np.random.default_rng(3), start_ns=0, duration=10.0))
    ground = GroundMap.of(lane)
    along, left = ground.nodes[..., 0], ground.nodes[..., 1]
    drawn = np.argwhere((np.abs(left) < 10.0) & (along > lane.along[0] + 1) & (along < lane.along[-1] - 1))
    chosen = drawn[np.random.default_rng(0).choice(len(drawn), 500, replace=False)]
    for i, j in chosen:
        spot = lane.location(*map(float, ground.nodes[i, j, :2]))[:2]
        node = ground.corner + ground.cell * np.array([i, j])
        # Points of the lane are 25 cm apart; between them a bend of 15 m leaves its chord by 0.5 mm, and ten metres
        # to its side the rounding of the heading between them counts as millimetres.
        assert np.hypot(*(spot - node)) < 0.02


def test_far_from_the_trajectory_the_ground_is_only_grass():
    lane = Lane.of(plan_path(np.random.default_rng(3), start_ns=0, duration=5.0))
    ground = GroundMap.of(lane)
    nodes = ground.corner + ground.cell * np.argwhere(ground.nodes[..., 1] >= 14.0)
    nearest = [np.linalg.norm(lane.points - node, axis=1).min() for node in nodes[::37]]
    assert min(nearest) >= 13.9
