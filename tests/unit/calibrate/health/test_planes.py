"""Planes from picture to picture, in a street of painted planes that is known by formula."""

from itertools import pairwise

import numpy as np
import pytest

from sceneloom.calibrate.frames import CalibrationFrame
from sceneloom.calibrate.health.planes import judge_planes
from sceneloom.calibrate.health.verdicts import Verdict
from sceneloom.calibrate.measures.candidate import Change
from sceneloom.calibrate.planes.followed import PlanePair
from sceneloom.calibrate.planes.surfaces import find_planes
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import unproject
from sceneloom.geometry.rigid import RigidTransform

CAMERA = Camera("brown_conrady", 320, 160, 200.0, 200.0, 159.5, 79.5, (-0.05, 0.01))
CAMERA_FROM_LIDAR = RigidTransform(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.1, -0.2, -0.3])
)
PLANES = (  # normal, distance from the world's origin, two axes along which it is painted
    (np.array([0.0, 0.0, 1.0]), -1.7, (0, 1)),
    (np.array([0.0, 1.0, 0.0]), 6.0, (0, 2)),
    (np.array([0.0, 1.0, 0.0]), -5.0, (0, 2)),
    (np.array([1.0, 0.0, 0.0]), 25.0, (1, 2)),
)
WAVES = np.random.default_rng(3).normal(scale=2.5, size=(8, 2)), np.random.default_rng(4).uniform(0, 6.3, 8)


def paint(places):
    """Brightness of places on a plane, (N, 2) [m]: waves of a metre and more in all directions."""
    return 128.0 + 20.0 * np.sin(places @ WAVES[0].T + WAVES[1]).sum(axis=-1)


def cast(origin, rays):
    """Where rays (N, 3) meet the first plane, and its brightness there."""
    nearest, grey = np.full(len(rays), np.inf), np.zeros(len(rays))
    for normal, distance, axes in PLANES:
        with np.errstate(divide="ignore"):
            range_m = (distance - origin @ normal) / (rays @ normal)
        first = (range_m > 0) & (range_m < nearest)
        nearest[first] = range_m[first]
        grey[first] = paint((origin + range_m[first, None] * rays[first])[:, list(axes)])
    return origin + nearest[:, None] * rays, np.clip(grey, 0, 255)


def frame(number, world_from_lidar, *, lit=True):
    world_from_camera = world_from_lidar @ CAMERA_FROM_LIDAR.inverse()
    columns, rows = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = unproject(CAMERA, np.column_stack([columns.ravel(), rows.ravel()]))
    _, grey = cast(world_from_camera.translation, world_from_camera.rotate(rays))
    grey = (grey if lit else 0.0 * grey).reshape(CAMERA.height, CAMERA.width).astype(np.float32)
    azimuths, heights = np.meshgrid(np.radians(np.arange(-50, 50, 0.5)), np.radians(np.arange(-24, 12, 0.8)))
    beams = np.stack(
        [np.cos(heights) * np.cos(azimuths), np.cos(heights) * np.sin(azimuths), np.sin(heights)], -1
    )
    hits, _ = cast(world_from_lidar.translation, world_from_lidar.rotate(beams.reshape(-1, 3)))
    return CalibrationFrame(
        "camera0", "lidar", number, number, number, CAMERA, CAMERA_FROM_LIDAR,
        np.ascontiguousarray(world_from_lidar.inverse().apply(hits)), None, None, None, grey,
        np.repeat(grey[..., None], 3, axis=2).astype(np.uint8), None, world_from_lidar,
    )  # fmt: skip


def drive(step_m, count=4, **looks):
    """Frames of a drive ahead with a little turning."""
    places = []
    for k in range(count):
        yaw = 0.01 * k
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
        places.append(RigidTransform(turn, np.array([step_m * k, 0.01 * k, 0.0])))
    return [frame(k, place, **looks) for k, place in enumerate(places)]


@pytest.fixture(scope="module")
def pairs():
    frames = drive(0.8)
    return [PlanePair.of(a, b) for a, b in pairwise(frames)]


def turned(pitch, yaw):
    return Change.turn(np.radians([pitch, yaw, 0.0])).camera_from_lidar(CAMERA_FROM_LIDAR.matrix)


@pytest.mark.parametrize(
    ("turn", "verdict"),
    [((0.0, 0.0), Verdict.GOOD), ((0.7, -0.7), Verdict.DRIFTING), ((4.0, 3.0), Verdict.WRONG)],
)
@pytest.mark.few(1)
def test_the_turn_of_a_camera_is_found_from_planes_and_judged(pairs, turn, verdict):
    item = judge_planes(pairs, turned(*turn))
    assert item.verdict is verdict
    # a tenth of a pixel is 0.03 degrees
    assert np.array(item.values) == pytest.approx([-turn[0], -turn[1]], abs=0.06)


def test_a_camera_upside_down_is_never_good(pairs):
    item = judge_planes(
        pairs, Change.turn(np.array([0.0, 0.0, np.pi])).camera_from_lidar(CAMERA_FROM_LIDAR.matrix)
    )
    assert item.verdict in {Verdict.WRONG, Verdict.CANNOT_TELL}


def test_dark_pictures_and_standing_still_tell_nothing(pairs):
    dark = drive(0.8, count=4, lit=False)
    blind = [PlanePair.of(a, b) for a, b in pairwise(dark)]
    item = judge_planes(blind, CAMERA_FROM_LIDAR.matrix)
    assert (item.verdict, item.reason[:8]) == (Verdict.CANNOT_TELL, "0 pieces")
    assert judge_planes(pairs[:2], CAMERA_FROM_LIDAR.matrix).verdict is Verdict.CANNOT_TELL
    still = drive(0.0, count=4)
    same = [PlanePair.of(a, b) for a, b in pairwise(still)]
    # without a step every calibration takes planes to where they are
    assert judge_planes(same, turned(3.0, 3.0)).verdict is not Verdict.GOOD


def test_planes_are_found_on_walls_and_not_along_single_lines():
    random = np.random.default_rng(1)
    wall = np.column_stack([np.full(400, 8.0), random.uniform(-2, 2, (400, 2))])
    wall[:, 0] += random.normal(scale=0.01, size=400)
    line = np.column_stack([np.linspace(0, 4, 100), np.full(100, 30.0), np.zeros(100)])
    bush = random.uniform(-0.5, 0.5, (300, 3)) - np.array([0.0, 20.0, 0.0])
    points = np.concatenate([wall, line, bush])
    found = find_planes(points, np.arange(len(points)))
    assert len(found.points) > 300
    assert (found.points[:, 0] > 7.9).mean() > 0.95
    # of 12 points within some 0.4 m, off by 1 cm: their plane is off by about a degree
    assert np.median(np.abs(found.normals[found.points[:, 0] > 7.9, 0])) > np.cos(np.radians(3.0))
    assert len(find_planes(points[:5], np.arange(5)).points) == 0
