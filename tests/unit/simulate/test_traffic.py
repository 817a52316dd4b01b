"""A drive through traffic: what must hold of everyone in it, and of the truth about them."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.simulate import (
    CameraSpec,
    LidarSpec,
    PathSpec,
    Stop,
    TrafficSpec,
    camera_mount,
    simulate_street,
)
from sceneloom.simulate.camera import RenderedCamera
from sceneloom.simulate.objects import NO_MOVERS
from sceneloom.simulate.street import Street

EXACT_LIDAR = LidarSpec(beams=32, steps=600, range_sigma=0.0, drop_rate=0.0)
SMALL = CameraSpec(Camera("pinhole", 320, 200, 200.0, 200.0, 159.5, 90.0), camera_mount(pitch_deg=2.0))
ROLLING = replace(SMALL, readout_ns=60_000_000, mount=camera_mount(yaw_deg=30.0))
BUSY = TrafficSpec(cars=4.0, cyclists=2.0, pedestrians=8.0)
SEED = 7


def drive_through(traffic, *, seed=SEED, frames=12, cameras=(SMALL, ROLLING), **options):
    return simulate_street(
        seed, frames=frames, lidar=EXACT_LIDAR, cameras=cameras, traffic=traffic, **options
    )


@pytest.fixture(scope="module")
def busy():
    return drive_through(BUSY)


@pytest.fixture(scope="module")
def empty():
    return drive_through(None)


def rotated(yaws):
    """Rotates about z by (N,) yaws, (N, 2, 2)."""
    rows = [[np.cos(yaws), -np.sin(yaws)], [np.sin(yaws), np.cos(yaws)]]
    return np.moveaxis(np.array(rows), 2, 0)


def in_box(points_world, centers, yaws, size_lwh):
    """How far outside a box at each point's own time points are [m], at most 0 inside."""
    apart = points_world - centers
    ahead = np.cos(yaws) * apart[:, 0] + np.sin(yaws) * apart[:, 1]
    left = np.cos(yaws) * apart[:, 1] - np.sin(yaws) * apart[:, 0]
    return (np.abs(np.column_stack([ahead, left, apart[:, 2]])) - np.array(size_lwh) / 2).max(axis=1)


def test_there_is_something_of_everything(busy):
    labels = [thing.label for thing in busy.truth.movers]
    assert set(labels) == {"car", "cyclist", "pedestrian"}
    assert sum(thing.stands for thing in busy.truth.movers) >= 1
    assert all(thing.label == "pedestrian" for thing in busy.truth.movers if thing.stands)
    first = len(busy.truth.objects) + 1
    assert [thing.instance for thing in busy.truth.movers] == list(range(first, first + len(labels)))


def test_traffic_changes_neither_the_trajectory_nor_what_stands(busy, empty):
    assert busy.truth.objects == empty.truth.objects
    np.testing.assert_array_equal(busy.truth.path.control_points, empty.truth.path.control_points)
    np.testing.assert_array_equal(busy.truth.street.shapes.maps, empty.truth.street.shapes.maps)
    assert empty.truth.movers == ()
    seen, bare = busy.truth.image("camera0", 3), empty.truth.image("camera0", 3)
    moving = seen.instances > len(busy.truth.objects)
    assert moving.mean() > 0.005
    np.testing.assert_array_equal(seen.colors[~moving], bare.colors[~moving])
    np.testing.assert_array_equal(seen.depths[~moving], bare.depths[~moving])
    assert (seen.depths[moving] <= np.where(bare.depths > 0, bare.depths, np.inf)[moving]).all()


def test_a_drive_without_traffic_has_the_annotations_of_what_stands(empty, busy):
    stands = [annotation for annotation in busy.scene.annotations if annotation.stationary]
    ids = {annotation.id for annotation in empty.scene.annotations}
    assert ids < {annotation.id for annotation in stands}
    assert all(annotation.stationary for annotation in empty.scene.annotations)


@pytest.mark.parametrize("k", [0, 7])
def test_points_on_movers_lie_in_their_boxes_at_the_points_own_times(busy, k):
    truth, frame = busy.truth, busy.scene.lidars[0].frames[k]
    clean, first = truth.clean_points_world(k), len(truth.objects) + 1
    assert (clean.instances >= first).sum() > 200
    for thing in truth.movers:
        own = np.flatnonzero(clean.instances == thing.instance)
        times = frame.points.timestamps_ns[own]
        states = truth.street.movers.states(np.full(len(own), thing.instance - first), times)
        centers = states.positions + np.array([0, 0, thing.size_lwh[2] / 2])
        assert (in_box(clean.positions_world[own], centers, states.yaws, thing.size_lwh) < 1e-9).all()


def test_points_move_with_what_they_are_on_and_stand_on_what_stands(busy):
    truth, k = busy.truth, 4
    clean, times = truth.clean_points_world(k), busy.scene.lidars[0].frames[k].points.timestamps_ns
    first = len(truth.objects) + 1
    assert (clean.velocities[clean.instances < first] == 0).all()
    cars = [thing for thing in truth.movers if thing.label != "pedestrian"]
    step = 1_000_000
    checked = 0
    for thing in cars:
        own = np.flatnonzero(clean.instances == thing.instance)
        if not len(own):
            continue
        which = np.full(len(own), thing.instance - first)
        before, now, after = (truth.street.movers.states(which, times[own] + t) for t in (-step, 0, step))
        # A point fixed to a rigid body, carried along by the body's poses.
        rotations = [Rotation.from_euler("z", states.yaws[:, None]) for states in (before, now, after)]
        local = rotations[1].inv().apply(clean.positions_world[own] - now.positions)
        moved = rotations[2].apply(local) + after.positions - rotations[0].apply(local) - before.positions
        # h²/6 times a jerk below 50 m/s³.
        np.testing.assert_allclose(moved / (2e-9 * step), clean.velocities[own], atol=1e-4)
        checked += len(own)
    assert checked > 200
    # Parts of a walker's leg swing at up to 0.3 rad x 7 rad/s x 0.9 m beside its 1.7 m/s.
    people = np.isin(clean.instances, [t.instance for t in truth.movers if t.label == "pedestrian"])
    assert np.linalg.norm(clean.velocities[people], axis=1).max(initial=0.0) < 4.0


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"seed": 1},
        {"path": PathSpec(yaw_rate=1.0)},
        {"path": PathSpec(stops=(Stop(1.0, 2.0),), ramp=1.0)},
    ],
    ids=["default", "another seed", "fast rotates", "a stop"],
)
@pytest.mark.few(1)
def test_nobody_runs_into_anybody_or_anything(options):
    truth = drive_through(BUSY, frames=40, cameras=(), **options).truth
    times = np.arange(1_000_000_000, 5_000_000_000, 50_000_000)
    boxes, count = truth.boxes(times), len(truth.objects)
    ego = truth.path.at(times)
    ego_yaw = np.arctan2(ego.rotations[:, 1, 0], ego.rotations[:, 0, 0])
    grid = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.5, 0.5, 5)), -1).reshape(-1, 2)

    def plan(index):
        if index < 0:
            return ego.positions[:, :2], ego_yaw, np.array([4.5, 1.8])
        return boxes.centers_world[:, index, :2], boxes.yaws[:, index], boxes.sizes_lwh[index, :2]

    def touch(a, b, there):
        """Whether a point of a grid over one ground plan lies in the other at any time that both are there."""
        (center_a, yaw_a, size_a), (center_b, yaw_b, size_b) = plan(a), plan(b)
        near = np.linalg.norm(center_a - center_b, axis=1) < (np.hypot(*size_a) + np.hypot(*size_b)) / 2
        rows = np.flatnonzero(near & there)
        if not len(rows):
            return False
        points = np.einsum("tij,gj->tgi", rotated(yaw_a[rows]), grid * size_a) + center_a[rows, None]
        local = np.einsum("tji,tgj->tgi", rotated(yaw_b[rows]), points - center_b[rows, None])
        return (np.abs(local) < size_b / 2).all(axis=2).any()

    moving = [-1, *range(count, count + len(truth.movers))]
    solid = [k for k in range(count) if boxes.labels[k] in {"building", "car", "bin", "barrier"}]
    assert len(moving) > 12
    for a, b in (*combinations(moving, 2), *((a, b) for a in moving for b in solid)):
        there = (a < 0 or boxes.present[:, a]) & (b < 0 or boxes.present[:, b])
        assert not touch(a, b, np.broadcast_to(there, len(times))), (a, b)
        assert not touch(b, a, np.broadcast_to(there, len(times))), (a, b)


def test_everyone_goes_at_the_speed_of_their_kind_and_looks_where_they_go(busy):
    times = np.arange(1_000_000_000, 2_200_000_000, 10_000_000)
    boxes = busy.truth.boxes(times)
    speeds = np.linalg.norm(boxes.velocities, axis=2)
    headings = np.arctan2(boxes.velocities[..., 1], boxes.velocities[..., 0])
    fastest = {"car": 12.0, "cyclist": 6.5, "pedestrian": 1.9}
    slowest = {"car": 3.0, "cyclist": 2.8, "pedestrian": 0.0}
    for k in range(len(busy.truth.objects), len(boxes.labels)):
        there, label = boxes.present[:, k], boxes.labels[k]
        assert (speeds[there, k] <= fastest[label]).all()
        assert (speeds[there, k] >= slowest[label]).all()
        goes = there & (speeds[:, k] > 0.3)
        off = np.angle(np.exp(1j * (headings[goes, k] - boxes.yaws[goes, k])))
        assert np.abs(off).max(initial=0.0) < 0.01


def test_in_the_egos_lane_cars_stop_and_go_with_it():
    drive = drive_through(BUSY, cameras=(), path=PathSpec(stops=(Stop(0.0, 4.0),)))
    first, times = len(drive.truth.objects), np.array([1_900_000_000, 2_100_000_000], np.int64)
    boxes = drive.truth.boxes(times)
    cars = [k for k in range(first, len(boxes.labels)) if boxes.labels[k] == "car"]
    speeds = np.linalg.norm(boxes.velocities[:, cars], axis=2)
    stationary = (speeds < 1e-6).all(axis=0)
    assert stationary.sum() >= 2
    assert (~stationary).sum() >= 2


def test_annotations_state_within_a_centimetre_and_a_tenth_of_a_degree_where_movers_are(busy):
    truth = busy.truth
    by_id = {annotation.id: annotation for annotation in busy.scene.annotations}
    first = len(truth.objects) + 1
    between = np.random.default_rng(0).integers(1_000_000_000, 2_200_000_000, 200)
    for thing in truth.movers:
        annotation = by_id[f"{thing.label}-{thing.instance}"]
        assert annotation.stationary == thing.stands
        timestamps, values = annotation.path.timestamps_ns, annotation.path.values
        assert (np.diff(timestamps) > 0).all()
        times = between if thing.stands else between[(between >= timestamps[0]) & (between <= timestamps[-1])]
        states = truth.street.movers.states(np.full(len(times), thing.instance - first), times)
        middle = states.positions + np.array([0, 0, thing.size_lwh[2] / 2])
        stated = np.column_stack([np.interp(times, timestamps, values[:, axis]) for axis in (3, 4, 5, 8)])
        assert np.abs(stated[:, :3] - middle).max(initial=0.0) < 0.01
        assert np.abs(stated[:, 3] - np.degrees(states.yaws)).max(initial=0.0) < 0.1
        assert (values[:, :3] == thing.size_lwh).all()


def alone(street, instance):
    """The street with one object in it."""
    shapes, movers = street.shapes, street.movers
    own = np.flatnonzero(shapes.instances == instance)
    if len(own):
        return Street(
            (),
            type(shapes)(*(getattr(shapes, name)[own] for name in shapes.__slots__)),
            street.ground,
            NO_MOVERS,
        )
    nobody = type(shapes)(*(getattr(shapes, name)[:0] for name in shapes.__slots__))
    return Street(
        (),
        nobody,
        street.ground,
        replace(
            movers,
            things=tuple(
                thing if thing.instance == instance else replace(thing, first_ns=0, last_ns=-1)
                for thing in movers.things
            ),
        ),
    )


@pytest.mark.parametrize("camera_id", ["camera0", "camera1"])
def test_what_hides_an_object_is_what_an_image_of_it_alone_shows_more_of_it(busy, camera_id):
    truth, k = busy.truth, 2
    camera = truth.cameras[camera_id]
    occlusion, shown = truth.occlusion(camera_id, k), truth.instances(camera_id, k)
    assert (np.diff(occlusion.instances) > 0).all()
    moving = occlusion.instances > len(truth.objects)
    chosen = [*np.flatnonzero(moving)[:6], *np.flatnonzero(~moving)[::9]]
    assert moving.sum() >= 3
    for row in chosen:
        instance = int(occlusion.instances[row])
        single = RenderedCamera.of(
            camera.spec, alone(truth.street, instance), truth.path, timestamps_ns=camera.timestamps_ns
        )
        assert occlusion.alone_px[row] == (single.truth(k).instances == instance).sum()
        assert occlusion.visible_px[row] == (shown == instance).sum()
    assert set(np.unique(shown[shown > 0])) <= set(occlusion.instances.tolist())
    assert ((occlusion.hidden >= 0) & (occlusion.hidden <= 1)).all()
    assert occlusion.hidden.max() > 0.5


@pytest.mark.parametrize("camera_id", ["camera0", "camera1"])
def test_what_an_image_shows_of_movers_is_visible_at_its_time(busy, camera_id):
    truth, k = busy.truth, 5
    camera, image = truth.cameras[camera_id], truth.image(camera_id, k)
    rows, columns = np.nonzero(image.instances > len(truth.objects))
    assert len(rows) > 100
    camera_model = camera.spec.camera
    rays = (
        np.column_stack(
            [
                (columns - camera_model.cx) / camera_model.fx,
                (rows - camera_model.cy) / camera_model.fy,
                np.ones(len(rows)),
            ]
        )
        * image.depths[rows, columns].astype(np.float64)[:, None]
    )
    rotations, origins = camera.line_poses(k)
    line = rows if len(origins) > 1 else np.zeros(len(rows), np.int64)
    points = np.einsum("nij,nj->ni", rotations[line], rays) + origins[line]
    # float32 depths are off by 4e-6 m at 60 m; at an outline such a point may lie beside its object.
    assert truth.visible(camera_id, k, points).mean() > 0.99
    times = camera.line_times_ns(k)[line]
    first = len(truth.objects) + 1
    which = image.instances[rows, columns].astype(np.int64) - first
    states = truth.street.movers.states(which, times)
    sizes = np.array([thing.size_lwh for thing in truth.movers])[which]
    centers = states.positions + np.array([0, 0, 0.5]) * sizes
    apart = points - centers
    ahead = np.cos(states.yaws) * apart[:, 0] + np.sin(states.yaws) * apart[:, 1]
    left = np.cos(states.yaws) * apart[:, 1] - np.sin(states.yaws) * apart[:, 0]
    assert (np.abs(np.column_stack([ahead, left, apart[:, 2]])) < sizes / 2 + 1e-4).all()


def test_boxes_of_what_stands_are_there_at_all_times(busy):
    boxes = busy.truth.boxes([1_000_000_000, 1_700_000_000])
    stationary = len(busy.truth.objects)
    assert boxes.present[:, :stationary].all()
    assert not boxes.velocities[:, :stationary].any()
    for k, thing in enumerate(busy.truth.objects):
        assert boxes.instances[k] == thing.instance
        np.testing.assert_array_equal(boxes.centers_world[1, k], thing.center_world)
    assert len(boxes.labels) == stationary + len(busy.truth.movers)


def test_the_same_traffic_comes_whatever_is_asked_for_first(busy):
    again = drive_through(BUSY)
    np.testing.assert_array_equal(again.truth.instances("camera1", 8), busy.truth.instances("camera1", 8))
    for k in (9, 1, 4):
        first, second = (d.scene.lidars[0].frames[k].points for d in (again, busy))
        np.testing.assert_array_equal(first.positions, second.positions)
    other = drive_through(BUSY, seed=SEED + 1)
    assert len(other.truth.movers) != len(busy.truth.movers) or not np.array_equal(
        other.truth.street.movers.anchors, busy.truth.street.movers.anchors
    )


def test_nobody_moves_where_nobody_is_wanted():
    drive = drive_through(TrafficSpec(cars=0.0, cyclists=0.0, pedestrians=0.0), cameras=())
    assert drive.truth.movers == ()
    only = drive_through(TrafficSpec(cars=3.0, cyclists=0.0, pedestrians=0.0), cameras=())
    assert {thing.label for thing in only.truth.movers} == {"car"}


@pytest.mark.parametrize(
    "wrong",
    [
        {"cars": 7.0},
        {"cyclists": -1.0},
        {"pedestrians": float("nan")},
        {"stationary": 1.5},
        {"crossing": 0.9},
    ],
)
def test_traffic_that_cannot_be_is_refused_by_name(wrong):
    with pytest.raises(OptionError, match=f"traffic.{next(iter(wrong))}"):
        TrafficSpec(**wrong)
