"""Fewer timestamps: how few, of what, and what stays as it was."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom import scene as sc
from sceneloom.editing import simplify_scene
from sceneloom.editing.simplify import _thin_greedily
from sceneloom.errors import OptionError

ROTATION = np.array([[0.0, 0.0, 0.0, 1.0]])


def a_cuboid(values, timestamps=None):
    timestamps = np.arange(len(values)) * 100 if timestamps is None else timestamps
    return sc.CuboidAnnotation("a", sc.CuboidPath(np.asarray(timestamps, np.int64), np.asarray(values, np.float64)))


def rows(x, *, yaw=0.0):
    values = np.zeros((len(x), 9))
    values[:, :3], values[:, 3], values[:, 8] = (4.0, 2.0, 1.5), x, yaw
    return values


def test_a_path_needs_its_ends_and_corners_only_and_bends_what_their_curvature_says():
    for values, options, kept in (
        (rows(np.linspace(0, 50, 1001)), {"tolerance_m": 1e-9}, [0, 100_000]),
        (rows(np.concatenate([np.linspace(0, 10, 50), np.full(50, 10.0)])), {}, [0, 4900, 9900]),
        # less than half a rotation is known by its ends: 17 steps of 10 degrees
        (rows(np.zeros(37), yaw=np.arange(37) * 10.0), {"tolerance_deg": 0.01}, [0, 1700, 3400, 3600]),
        # values that are not finite stay
        (rows([0.0, 0.0, np.nan, 0.0, 0.0]), {}, [0, 100, 200, 300, 400]),
    ):
        (simple,) = simplify_scene(sc.Scene((), (a_cuboid(values),)), **options).annotations
        assert simple.path.timestamps_ns.tolist() == kept
    # a circle of 20 m: between timestamps an angle φ apart a line is r (1 - cos(φ/2)) off; 0.01 m: 3.6 degrees
    angles = np.radians(np.arange(0, 360, 0.1))
    values = rows(20 * np.cos(angles))
    values[:, 4] = 20 * np.sin(angles)
    (simple,) = simplify_scene(sc.Scene((), (a_cuboid(values),)), tolerance_deg=90).annotations
    assert 100 <= len(simple.path.timestamps_ns) <= 102
    # long straight curves are not looked at point by point
    calls = []

    def misfits(a, b):
        calls.append(b - a)
        return np.zeros(b - a - 1)

    assert _thin_greedily(100_000, misfits).tolist() == [0, 99_999]
    assert len(calls) < 20
    # of equal or running back timestamps, and short ones
    paths = [a_cuboid(rows(np.zeros(count))) for count in (0, 1, 2)]
    for cuboid in (a_cuboid(rows(np.zeros(4)), timestamps=[0, 5, 5, 9]), *paths):
        assert simplify_scene(sc.Scene((), (cuboid,))).annotations[0].path is cuboid.path
    empty = sc.PointsAnnotation("p", (sc.PointPath(np.zeros(0, np.int64), np.zeros((0, 3))),))
    assert simplify_scene(sc.Scene((), (empty,)), tolerance_m=1.0).annotations[0].paths == empty.paths


def a_scene():
    timestamps = np.arange(9) * 100
    locations = np.column_stack([np.arange(9.0), np.zeros(9), np.zeros(9)])
    path = sc.Poses(timestamps, locations, np.repeat(ROTATION, 9, axis=0))
    known = {"file_seconds": timestamps * 1e-9, "covariances": np.tile(np.eye(6), (9, 1, 1))}
    trajectory = sc.Trajectory("trajectory", timestamps, locations, None, **known)
    annotations = (
        a_cuboid(rows(np.arange(9.0))),
        sc.PointsAnnotation("p", (sc.PointPath(timestamps, locations, id="q"),), labels=("nose",)),
        sc.LocalizationAdjustment("l", path),
        sc.GroupAnnotation("g"),
    )
    return sc.Scene((sc.OdometrySensor("ego", path),), annotations, trajectories={"trajectory": trajectory})


def counts(scene):
    cuboid, points, adjustment, _ = scene.annotations
    paths = {"cuboids": cuboid.path, "keypoints": points.paths[0], "adjustments": adjustment.poses}
    paths |= {"sensors": scene.sensors[0].poses, "trajectories": scene.trajectories["trajectory"]}
    return {name: len(path.timestamps_ns) for name, path in paths.items()}


def test_all_kinds_of_paths_or_one_are_simplified_and_reported_and_a_pose_that_holds_for_ever_stays():
    simple = simplify_scene(a_scene())
    assert counts(simple) == dict.fromkeys(counts(simple), 2)
    assert {warning.location: warning.count for warning in simple.warnings} == dict.fromkeys(counts(simple), 7)
    trajectory = simple.trajectories["trajectory"]
    assert (trajectory.file_seconds.tolist(), trajectory.covariances.shape) == ([0.0, 800 * 1e-9], (2, 6, 6))
    assert simple.annotations[1].paths[0].id == "q"
    for kind in ("cuboids", "keypoints"):
        others = dict.fromkeys(("cuboids", "keypoints", "poses"), False)
        found = counts(simplify_scene(a_scene(), **{**others, kind: True}))
        assert [name for name, count in found.items() if count == 2] == [kind]
    scene = replace(a_scene(), sensors=(sc.OdometrySensor("ego", sc.Poses.identity()),))
    assert simplify_scene(scene).sensors[0].poses.static
    for wrong in ({"tolerance_m": -1.0}, {"tolerance_deg": float("nan")}):
        with pytest.raises(OptionError, match="expected a number from 0 on"):
            simplify_scene(sc.Scene(()), **wrong)
