"""Extrinsics of unknown convention: candidates, ranking, reading and units."""

import itertools
import json
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.calibrate.conventions import (
    CAMERA_AXES,
    LIDAR_AXES,
    UNITS_NS,
    Extrinsic,
    check_drive,
    check_file,
    decide,
    edges_meeting,
    groups,
    hypotheses,
    read_extrinsics,
    time_units,
)
from sceneloom.calibrate.frames import calibration_frames
from sceneloom.errors import DataError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import LazyFrames
from sceneloom.simulate import simulate_street

ROTATION = Rotation.from_euler("ZYX", [-88.0, 1.5, -91.0], degrees=True)
TRANSLATION = np.array([0.1, -0.3, 0.2])
RIG = np.eye(4)
RIG[:3, :3], RIG[:3, 3] = ROTATION.as_matrix(), TRANSLATION


def _quaternion(transform, *, scalar_first):
    quaternion = Rotation.from_matrix(transform[:3, :3]).as_quat()
    return np.roll(quaternion, 1) if scalar_first else quaternion


WRITINGS = {
    "4x4 by rows": (lambda m: m.reshape(-1), {"layout": "rows"}),
    "4x4 by columns": (lambda m: m.T.reshape(-1), {"layout": "columns"}),
    "3x4 by rows": (lambda m: m[:3].reshape(-1), {"layout": "rows"}),
    "3x4 by columns": (lambda m: m[:3].T.reshape(-1), {"layout": "columns"}),
    "translation, x y z w": (
        lambda m: np.r_[m[:3, 3], _quaternion(m, scalar_first=False)],
        {"order of parts": "translation first", "quaternion": "x y z w"},
    ),
    "w x y z, translation": (
        lambda m: np.r_[_quaternion(m, scalar_first=True), m[:3, 3]],
        {"order of parts": "rotation first", "quaternion": "w x y z"},
    ),
    "translation, degrees about fixed axes": (
        lambda m: np.r_[m[:3, 3], Rotation.from_matrix(m[:3, :3]).as_euler("xyz", degrees=True)],
        {"order of parts": "translation first", "angles": "degrees", "order of angles": "Rz Ry Rx"},
    ),
    "radians about moving axes, translation": (
        lambda m: np.r_[Rotation.from_matrix(m[:3, :3]).as_euler("XYZ"), m[:3, 3]],
        {"order of parts": "rotation first", "angles": "radians", "order of angles": "Rx Ry Rz"},
    ),
}


@pytest.mark.parametrize("direction", ["camera from lidar", "lidar from camera"])
@pytest.mark.parametrize("writing", WRITINGS)
def test_one_of_the_trajectories_gives_the_rig_that_was_written(writing, direction):
    write, choices = WRITINGS[writing]
    numbers = write(RIG if direction == "camera from lidar" else np.linalg.inv(RIG))
    wanted = {
        **choices,
        "direction": direction,
        "camera axes": "x right, y down, z forward",
        "lidar axes": "those of the points",
    }
    right = [trajectory for trajectory in hypotheses(numbers) if wanted.items() <= trajectory.choices.items()]
    assert len(right) == 1
    np.testing.assert_allclose(right[0].camera_from_points, RIG, atol=1e-9)  # rounding alone


def test_other_axes_rotate_the_frames_on_both_sides():
    body_from_camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # columns: right, down, forward
    stated = np.eye(4)
    stated[:3, :3] = body_from_camera @ RIG[:3, :3] @ Rotation.from_euler("z", -90, degrees=True).as_matrix()
    stated[:3, 3] = body_from_camera @ RIG[:3, 3]
    wanted = {
        "direction": "camera from lidar",
        "camera axes": "x forward, y left, z up",
        "lidar axes": "x, y along the points' -y, x",
    }
    right = [
        trajectory for trajectory in hypotheses(stated.reshape(-1)) if wanted.items() <= trajectory.choices.items()
    ]
    assert len(right) == 1
    np.testing.assert_allclose(right[0].camera_from_points, RIG, atol=1e-9)  # rounding alone


def test_a_rotation_beside_its_translation_is_read_by_rows_and_by_columns():
    numbers = np.r_[RIG[:3, :3].T.reshape(-1), RIG[:3, 3]]
    trajectories = hypotheses(numbers, apart=True)
    assert any(
        np.allclose(trajectory.camera_from_points, RIG)
        for trajectory in trajectories
        if trajectory.choices["layout"] == "columns"
    )
    assert not any(
        np.allclose(trajectory.camera_from_points, RIG)
        for trajectory in trajectories
        if trajectory.choices["layout"] == "rows"
    )


@pytest.mark.parametrize(
    "numbers",
    [
        np.full(16, np.nan),
        np.diag([1.0, 1.0, -1.0, 1.0]).reshape(-1),
        [1, 2, 3, 0.5, 0.5, 0.5, 0.6],
        [400, 0, 0, 400, 0, 0],
        [700, 0, 600, 0, 700, 180, 0, 0, 1],
        [1.0, 2.0],
    ],
)
def test_what_is_no_transform_is_read_not(numbers):
    assert hypotheses(numbers) == ()


def test_choices_that_are_certain_leave_the_others_out():
    quaternion = np.r_[TRANSLATION, ROTATION.as_quat()]
    everything, certain = hypotheses(quaternion), hypotheses(quaternion, {"quaternion": "x y z w"})
    assert {trajectory.choices["quaternion"] for trajectory in certain} == {"x y z w"}
    assert {trajectory.choices["quaternion"] for trajectory in everything} == {"x y z w", "w x y z"}


def test_ways_of_the_same_transform_make_one_group():
    half_rotation = np.diag([1.0, -1.0, -1.0, 1.0])
    found = groups(hypotheses(half_rotation.reshape(-1)))
    together = [
        {
            (trajectory.choices["layout"], trajectory.choices["direction"], trajectory.choices["camera axes"])
            for trajectory in group
        }
        for group in found
    ]
    # by rows as by columns, in both directions, it is one and the same half rotation about x
    same = set(
        itertools.product(
            ("rows", "columns"), ("camera from lidar", "lidar from camera"), ("x right, y down, z forward",)
        )
    )
    assert any(same <= group for group in together)
    for one, other in itertools.combinations(found, 2):
        assert np.abs(one[0].camera_from_points - other[0].camera_from_points).max() > 1e-3


@dataclass(frozen=True)
class Judge:
    frames: tuple[Any, ...]
    score: Any
    truth: np.ndarray


@pytest.fixture(scope="module")
def judge():
    frames = calibration_frames(simulate_street(4, frames=3).scene, most=2)
    return Judge(frames, edges_meeting(frames), frames[0].camera_from_lidar.matrix)


def _quaternion_of_deciding(matrix, *, scalar_first):
    quaternion = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    return np.roll(quaternion, 1) if scalar_first else quaternion


def _angles(matrix, order, *, degrees):
    return Rotation.from_matrix(matrix[:3, :3]).as_euler(order, degrees=degrees)


DECIDING_WRITINGS = {
    "4x4 rows": lambda m: m.reshape(-1),
    "4x4 columns": lambda m: m.T.reshape(-1),
    "3x4 rows": lambda m: m[:3].reshape(-1),
    "3x4 columns": lambda m: m[:3].T.reshape(-1),
    **{
        f"quaternion, scalar first {scalar_first}, translation first {translation_first}": partial(
            lambda m, scalar_first, translation_first: np.concatenate(
                [m[:3, 3], _quaternion_of_deciding(m, scalar_first=scalar_first)]
                if translation_first
                else [_quaternion_of_deciding(m, scalar_first=scalar_first), m[:3, 3]]
            ),
            scalar_first=scalar_first,
            translation_first=translation_first,
        )
        for scalar_first in (False, True)
        for translation_first in (False, True)
    },
    **{
        f"angles {order}, degrees {degrees}": partial(
            lambda m, order, degrees: np.concatenate([m[:3, 3], _angles(m, order, degrees=degrees)]),
            order=order,
            degrees=degrees,
        )
        for order in ("xyz", "XYZ")
        for degrees in (False, True)
    },
}


def _written(truth, direction, camera_axes, lidar_axes):
    """What a file says of the true rig, (4, 4), under some axes and in some direction."""
    left, right = np.eye(4), np.eye(4)
    left[:3, :3], right[:3, :3] = CAMERA_AXES[camera_axes].T, LIDAR_AXES[lidar_axes].T
    stated = left @ truth @ right
    return stated if direction == "camera from lidar" else np.linalg.inv(stated)


COMBINATIONS = tuple(
    itertools.product(DECIDING_WRITINGS, ("camera from lidar", "lidar from camera"), CAMERA_AXES, LIDAR_AXES)
)


def _judged(judge, combination):
    """Whether the decision is right, wrong, or left open."""
    writing, direction, camera_axes, lidar_axes = combination
    numbers = DECIDING_WRITINGS[writing](_written(judge.truth, direction, camera_axes, lidar_axes))
    decision = decide(Extrinsic(writing, tuple(numbers.tolist())), judge.frames, judge.score)
    possible = (
        direction in decision.possible.get("direction", ())
        and camera_axes in decision.possible["camera axes"]
        and lidar_axes in decision.possible["lidar axes"]
    )
    if not decision.decided:
        return "open"
    return "right" if possible and np.allclose(decision.camera_from_lidar, judge.truth, atol=1e-3) else "wrong"


@pytest.mark.slow
def test_rigs_written_in_some_of_all_ways_are_reported(judge):
    verdicts = [_judged(judge, combination) for combination in COMBINATIONS[:: len(COMBINATIONS) // 5]]
    assert "wrong" not in verdicts
    assert verdicts.count("right") >= 0.9 * len(verdicts)


@pytest.mark.slow
def test_a_rig_written_in_a_third_of_all_ways_is_reported_or_left_open(judge):
    verdicts = [_judged(judge, combination) for combination in COMBINATIONS[::3]]
    assert verdicts.count("wrong") <= 0.01 * len(verdicts)
    assert verdicts.count("right") >= 0.9 * len(verdicts)


def test_without_a_drive_only_what_no_vehicle_has_is_left_out(judge):
    decision = decide(Extrinsic("file", tuple(judge.truth.reshape(-1).tolist())))
    assert decision.possible["direction"] == ("camera from lidar",)
    assert decision.possible["camera axes"] == ("x right, y down, z forward",)
    assert len(decision.possible["lidar axes"]) > 1
    assert not decision.decided


def test_a_rig_of_another_vehicle_is_left_open(judge):
    elsewhere = np.eye(4)
    elsewhere[:3, :3] = Rotation.from_euler("y", 40, degrees=True).as_matrix()
    decision = decide(
        Extrinsic("file", tuple((elsewhere @ judge.truth).reshape(-1).tolist())), judge.frames, judge.score
    )
    assert not decision.decided


def test_a_camera_on_its_head_is_read_not(judge):
    over = np.diag([-1.0, -1.0, 1.0, 1.0]) @ judge.truth
    numbers = tuple(over[:3].reshape(-1).tolist())
    decision = decide(Extrinsic("file", numbers), judge.frames, judge.score)
    assert not decision.decided or not np.allclose(decision.camera_from_lidar, over)


READING_ROTATION = [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]
READING_TRANSLATION = [0.1, -0.2, 0.3]
ROWS = [*READING_ROTATION[0], 0.1, *READING_ROTATION[1], -0.2, *READING_ROTATION[2], 0.3]
QUATERNION = [0.5, -0.5, 0.5, -0.5]


def _found(tmp_path, text):
    path = tmp_path / "calibration"
    path.write_text(text, "utf-8")
    return {extrinsic.location: extrinsic for extrinsic in read_extrinsics(path)}


def test_matrices_are_found_wherever_they_stand_in_json(tmp_path):
    matrix = [ROWS[:4], ROWS[4:8], ROWS[8:], [0, 0, 0, 1]]
    found = _found(tmp_path, json.dumps({"cameras": [{"name": "front", "imuToCamera": matrix}], "K": [700, 0, 600]}))
    assert found["cameras[0].imuToCamera"].numbers == (*ROWS, 0, 0, 0, 1)
    assert list(found) == ["cameras[0].imuToCamera"]


def test_lines_of_names_and_numbers_are_read_as_kitti_writes_them(tmp_path):
    text = f"P2: {' '.join(['700.0'] * 12)}\nTr_velo_to_cam: {' '.join(map(str, ROWS))}\n\n"
    found = _found(tmp_path, text)
    assert list(found) == ["Tr_velo_to_cam"]
    assert found["Tr_velo_to_cam"].numbers == tuple(ROWS)


def test_lines_without_colons_are_read_as_well(tmp_path):
    assert list(_found(tmp_path, f"Tr_velo_cam {' '.join(map(str, ROWS))}\n")) == ["Tr_velo_cam"]


def test_bare_numbers_over_several_lines_are_one_matrix(tmp_path):
    text = "\n".join(" ".join(map(str, row)) for row in np.reshape([*ROWS, 0, 0, 0, 1], (4, 4)))
    assert next(iter(_found(tmp_path, text).values())).numbers == (*ROWS, 0.0, 0.0, 0.0, 1.0)


def test_a_rotation_and_a_translation_side_by_side_belong_together(tmp_path):
    text = f"calib_time: 09-Jan-2012\nR: {' '.join(str(n) for row in READING_ROTATION for n in row)}\nT: 0.1 -0.2 0.3\n"
    (extrinsic,) = _found(tmp_path, text).values()
    assert extrinsic.apart
    assert extrinsic.numbers == (*(n for row in READING_ROTATION for n in row), *READING_TRANSLATION)


def test_named_numbers_leave_no_doubt_of_their_order(tmp_path):
    pose = {
        "position": dict(zip("xyz", READING_TRANSLATION, strict=True)),
        "heading": dict(zip("wxyz", QUATERNION, strict=True)),
    }
    (extrinsic,) = _found(tmp_path, json.dumps({"poses": [pose]})).values()
    assert extrinsic.location == "poses[0]"
    assert extrinsic.known["quaternion"] == "x y z w"
    np.testing.assert_allclose(extrinsic.numbers, [*READING_TRANSLATION, *QUATERNION[1:], QUATERNION[0]])


def test_a_list_of_a_quaternion_leaves_its_order_open(tmp_path):
    (extrinsic,) = _found(tmp_path, json.dumps({"translation": READING_TRANSLATION, "rotation": QUATERNION})).values()
    assert extrinsic.numbers == (*READING_TRANSLATION, *QUATERNION)
    assert "quaternion" not in extrinsic.known


def test_toml_is_read(tmp_path):
    (extrinsic,) = _found(tmp_path, f"[camera]\nextrinsic = {ROWS}\n").values()
    assert extrinsic.location == "camera.extrinsic"


@pytest.mark.parametrize(
    "text", ["", "{}", "no numbers at all", "[1, 2, 3]", '{"a": [null, true, "x"]}', "[[1], [2, 3], 4]"]
)
def test_a_file_without_an_extrinsic_says_what_was_expected(tmp_path, text):
    with pytest.raises(DataError, match="no extrinsic in it; expected 16, 12 or 9 numbers"):
        _found(tmp_path, text)


def test_what_is_no_text_is_named(tmp_path):
    path = tmp_path / "image.png"
    path.write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(DataError, match=r"image\.png"):
        read_extrinsics(path)
    with pytest.raises(DataError, match="absent"):
        read_extrinsics(tmp_path / "absent")


def test_the_files_of_kitti_and_others_are_read(data_dir):
    kitti = read_extrinsics(data_dir / "real" / "kitti_object" / "calib" / "000001.txt")
    assert [extrinsic.location for extrinsic in kitti] == ["R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo"]
    recording = read_extrinsics(data_dir / "recordings" / "pandaset" / "calibration.json")
    assert [extrinsic.location for extrinsic in recording][:3] == [f"cameras[{n}].imuToCamera" for n in range(3)]
    nuscenes = read_extrinsics(data_dir / "real" / "nuscenes_one_sample" / "infos.json")
    assert "data_list[0].images.CAM_FRONT.lidar2cam" in {extrinsic.location for extrinsic in nuscenes}


@pytest.mark.parametrize("text", ['{{"T": [{}]}}', "T = [{}]"])
def test_whole_numbers_that_no_float_can_hold_are_refused(tmp_path, text):
    (tmp_path / "calib").write_text(text.format(", ".join(["1" + "0" * 400] * 16)))
    with pytest.raises(DataError, match="too large to convert to float; expected the numbers"):
        read_extrinsics(tmp_path / "calib")


RATES = {
    "lidar": (5, 10, 20),
    "camera": (10, 30, 60),
    "radar": (13, 20),
    "imu": (100, 200, 400),
    "gnss": (1, 10),
}
STARTS_S = (0.0, -3.0, 12.5, 1_317_000_000.0)


@pytest.mark.parametrize(("kind", "rate"), [(kind, rate) for kind, rates in RATES.items() for rate in rates])
@pytest.mark.parametrize("unit", UNITS_NS)
@pytest.mark.parametrize("start", STARTS_S)
def test_usual_sensors_report_their_unit(kind, rate, unit, start):
    timestamps = (start + np.arange(50) / rate) * 1e9 / UNITS_NS[unit]
    assert time_units(timestamps, kind) == (unit,)


def test_a_gap_and_repeated_timestamps_change_nothing():
    timestamps = [0, 0, 100, 200, 300, 5000, 5100, 5100, 5200]
    assert time_units(timestamps, "lidar") == ("milliseconds",)


@pytest.mark.parametrize("timestamps", [[], [1.0], [2.0, 2.0], [np.nan, np.inf]])
def test_too_few_timestamps_state_nothing(timestamps):
    assert time_units(timestamps, "lidar") == ()


def test_a_rate_that_no_sensor_has_fits_no_unit():
    # 9,091 Hz in microseconds, 9.1 Hz in milliseconds: too fast and too slow for an IMU
    assert time_units(np.arange(10) * 110.0, "imu") == ()


@pytest.fixture(scope="module")
def scene():
    """What is sensed is made when it is asked for, and each test asks again: here it is kept."""
    scene = simulate_street(4, frames=3).scene
    (camera,), (lidar,) = scene.cameras, scene.lidars
    images = [p.loaded() for p in camera.images]
    kept = {
        camera.id: replace(camera, images=LazyFrames.of(images, camera.images.timestamps_ns)),
        lidar.id: replace(lidar, frames=LazyFrames.of(list(lidar.frames), lidar.frames.timestamps_ns)),
    }
    return replace(scene, sensors=tuple(kept.get(sensor.id, sensor) for sensor in scene.sensors))


def _mounted(scene, **mounts):
    """The scene with other mountings of its sensors."""
    sensors = tuple(
        replace(sensor, poses=None, mount=mounts[sensor.id]) if sensor.id in mounts else sensor
        for sensor in scene.sensors
    )
    return replace(scene, sensors=sensors)


def test_a_drive_that_is_right_is_reported_to_be_as_read(scene):
    report = check_drive(scene)
    assert [found.as_read for found in report.extrinsics] == [True]
    assert all(found.stated in found.possible for found in report.points)
    assert {found.kind for found in report.times} >= {"lidar", "camera", "imu"}
    assert all("seconds" in found.possible for found in report.times)
    assert not report.wrong


def test_a_camera_whose_mounting_was_reversed_is_reported(scene):
    frame = calibration_frames(scene, most=1)[0]
    upside = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    lidar_mount = next(sensor.mount for sensor in scene.lidars)
    wrong = lidar_mount @ frame.camera_from_lidar.inverse() @ upside
    report = check_drive(_mounted(scene, camera0=wrong))
    assert [found.as_read for found in report.extrinsics] == [False]
    assert report.extrinsics[0].possible["camera axes"] == ("x right, y up, z backward",)
    assert report.wrong


def test_timestamps_in_milliseconds_read_as_seconds_are_reported(scene):
    imu = next(sensor for sensor in scene.sensors if sensor.type == "imu")
    slow = {name: replace(stream, timestamps_ns=stream.timestamps_ns * 1000) for name, stream in imu.streams.items()}
    report = check_drive(replace(scene, sensors=(replace(imu, streams=slow),)))
    assert [found.possible for found in report.times] == [("milliseconds",)]
    assert report.wrong


def test_a_file_is_judged_by_a_drive(scene, tmp_path):
    truth = calibration_frames(scene, most=1)[0].camera_from_lidar
    lidar_from_camera = truth.inverse()
    path = tmp_path / "rig.json"
    quaternion = np.roll(lidar_from_camera.quaternion_xyzw, 1)
    pose = {"translation": lidar_from_camera.translation.tolist(), "rotation": quaternion.tolist()}
    path.write_text(json.dumps({"front": pose}), "utf-8")
    reported = []
    (found,) = check_file(path, scene, progress=lambda done, total: reported.append((done, total))).extrinsics
    assert (found.location, found.camera, found.decided) == ("front", "camera0", True)
    assert found.possible["quaternion"] == ("w x y z",)
    assert found.possible["direction"] == ("lidar from camera",)
    np.testing.assert_allclose(found.camera_from_lidar, truth.matrix, atol=1e-6)  # rounding of the text
    assert reported == [(1, 1)]


def test_a_file_alone_is_judged_by_what_vehicles_have(tmp_path):
    path = tmp_path / "rig.txt"
    path.write_text("Tr: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3\n", "utf-8")
    (found,) = check_file(path).extrinsics
    assert found.possible["direction"] == ("camera from lidar",)
    assert found.camera is None


def test_a_file_without_an_extrinsic_is_refused(scene, tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("nothing here", "utf-8")
    with pytest.raises(DataError, match=r"notes\.txt: no extrinsic"):
        check_file(path, scene)


@pytest.mark.parametrize("recording", ["kitti_drive", pytest.param("pandaset", marks=pytest.mark.slow)])
@pytest.mark.slow
def test_nothing_of_real_recordings_is_reported_to_be_wrong(data_dir, recording):
    with sceneloom.open(data_dir / "recordings" / recording) as drive:
        report = check_drive(drive)
    assert not report.wrong
    assert all(found.as_read in {True, None} for found in report.extrinsics)
