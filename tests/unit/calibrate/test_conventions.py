"""Conventions of extrinsics: candidates, ranking, reading of files, units of time."""

import itertools
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.calibrate import conventions
from sceneloom.calibrate.frames import calibration_frames
from sceneloom.errors import DataError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import LazyFrames
from sceneloom.simulate import simulate_street

ROTATION = Rotation.from_euler("ZYX", [-88.0, 1.5, -91.0], degrees=True)
RIG = np.eye(4)
RIG[:3, :3], RIG[:3, 3] = ROTATION.as_matrix(), [0.1, -0.3, 0.2]
DIRECTIONS = ("camera from lidar", "lidar from camera")
OPENCV = "x right, y down, z forward"


def xyzw(m):
    return Rotation.from_matrix(m[:3, :3]).as_quat()


def wxyz(m):
    return np.roll(xyzw(m), 1)


def angles(m, order, degrees):
    return Rotation.from_matrix(m[:3, :3]).as_euler(order, degrees=degrees)


FIRST, LAST = {"order of parts": "translation first"}, {"order of parts": "rotation first"}
WRITINGS = {
    "4x4 by rows": (lambda m: m.reshape(-1), {"layout": "rows"}),
    "4x4 by columns": (lambda m: m.T.reshape(-1), {"layout": "columns"}),
    "3x4 by rows": (lambda m: m[:3].reshape(-1), {"layout": "rows"}),
    "3x4 by columns": (lambda m: m[:3].T.reshape(-1), {"layout": "columns"}),
    "translation, x y z w": (lambda m: np.r_[m[:3, 3], xyzw(m)], {**FIRST, "quaternion": "x y z w"}),
    "x y z w, translation": (lambda m: np.r_[xyzw(m), m[:3, 3]], {**LAST, "quaternion": "x y z w"}),
    "translation, w x y z": (lambda m: np.r_[m[:3, 3], wxyz(m)], {**FIRST, "quaternion": "w x y z"}),
    "w x y z, translation": (lambda m: np.r_[wxyz(m), m[:3, 3]], {**LAST, "quaternion": "w x y z"}),
    **{
        f"translation, {unit} {order}": (
            lambda m, order=order, unit=unit: np.r_[m[:3, 3], angles(m, order, unit == "degrees")],
            {**FIRST, "angles": unit, "order of angles": "Rz Ry Rx" if order == "xyz" else "Rx Ry Rz"},
        )
        for order in ("xyz", "XYZ")
        for unit in ("degrees", "radians")
    },
    "radians XYZ, translation": (
        lambda m: np.r_[angles(m, "XYZ", False), m[:3, 3]],
        {**LAST, "angles": "radians", "order of angles": "Rx Ry Rz"},
    ),
}


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("writing", WRITINGS)
def test_one_reading_gives_the_rig_that_was_written(writing, direction):
    write, choices = WRITINGS[writing]
    numbers = write(RIG if direction == DIRECTIONS[0] else np.linalg.inv(RIG))
    wanted = {**choices, "direction": direction, "camera axes": OPENCV, "lidar axes": "those of the points"}
    (right,) = [reading for reading in conventions.hypotheses(numbers) if wanted.items() <= reading.choices.items()]
    np.testing.assert_allclose(right.camera_from_points, RIG, atol=1e-9)  # rounding alone


def test_readings_have_the_choices_that_fit_and_those_of_the_same_transform_make_one_group():
    body_from_camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # columns: right, down, forward
    stated = np.eye(4)
    stated[:3, :3] = body_from_camera @ RIG[:3, :3] @ Rotation.from_euler("z", -90, degrees=True).as_matrix()
    stated[:3, 3] = body_from_camera @ RIG[:3, 3]
    wanted = {"direction": "camera from lidar", "camera axes": "x forward, y left, z up"}
    wanted["lidar axes"] = "x, y along the points' -y, x"
    (right,) = [one for one in conventions.hypotheses(stated.reshape(-1)) if wanted.items() <= one.choices.items()]
    np.testing.assert_allclose(right.camera_from_points, RIG, atol=1e-9)  # rounding alone
    readings = conventions.hypotheses(np.r_[RIG[:3, :3].T.reshape(-1), RIG[:3, 3]], apart=True)
    assert {one.choices["layout"] for one in readings if np.allclose(one.camera_from_points, RIG)} == {"columns"}
    numbers = WRITINGS["translation, x y z w"][0](RIG)
    everything, certain = conventions.hypotheses(numbers), conventions.hypotheses(numbers, {"quaternion": "x y z w"})
    assert {one.choices["quaternion"] for one in certain} == {"x y z w"}
    assert {one.choices["quaternion"] for one in everything} == {"x y z w", "w x y z"}
    for none in (
        *(np.full(16, np.nan), np.diag([1.0, 1.0, -1.0, 1.0]).reshape(-1), [1, 2, 3, 0.5, 0.5, 0.5, 0.6]),
        *([400, 0, 0, 400, 0, 0], [700, 0, 600, 0, 700, 180, 0, 0, 1], [1.0, 2.0]),
    ):
        assert conventions.hypotheses(none) == ()
    # by rows as by columns, in both directions, it is one and the same half rotation about x
    found = conventions.groups(conventions.hypotheses(np.diag([1.0, -1.0, -1.0, 1.0]).reshape(-1)))
    names = ("layout", "direction", "camera axes")
    together = [{tuple(one.choices[name] for name in names) for one in group} for group in found]
    assert any(set(itertools.product(("rows", "columns"), DIRECTIONS, (OPENCV,))) <= group for group in together)
    for one, other in itertools.combinations(found, 2):
        assert np.abs(one[0].camera_from_points - other[0].camera_from_points).max() > 1e-3


@pytest.fixture(scope="module")
def scene():
    """A simulated drive whose images and sweeps are computed once."""
    scene = simulate_street(4, frames=3).scene
    (camera,), (lidar,) = scene.cameras, scene.lidars
    images = LazyFrames.of([image.loaded() for image in camera.images], camera.images.timestamps_ns)
    frames = LazyFrames.of(list(lidar.frames), lidar.frames.timestamps_ns)
    kept = {camera.id: replace(camera, images=images), lidar.id: replace(lidar, frames=frames)}
    return replace(scene, sensors=tuple(kept.get(sensor.id, sensor) for sensor in scene.sensors))


@pytest.fixture(scope="module")
def judge(scene):
    frames = calibration_frames(scene, most=2)
    score, truth = conventions.score_by_rotation(frames), frames[0].camera_from_lidar.matrix

    def decided(numbers, *, alone=False):
        extrinsic = conventions.Extrinsic("file", tuple(np.ravel(numbers).tolist()))
        return conventions.decide(extrinsic) if alone else conventions.decide(extrinsic, frames, score)

    return SimpleNamespace(decide=decided, truth=truth)


COMBINATIONS = tuple(itertools.product(WRITINGS, DIRECTIONS, conventions.CAMERA_AXES, conventions.LIDAR_AXES))


def verdict(judge, writing, direction, camera_axes, lidar_axes):
    """Whether the decision about a file with the true rig, under some axes and in some direction, is right."""
    left, right = np.eye(4), np.eye(4)
    left[:3, :3], right[:3, :3] = conventions.CAMERA_AXES[camera_axes].T, conventions.LIDAR_AXES[lidar_axes].T
    stated = left @ judge.truth @ right
    found = judge.decide(WRITINGS[writing][0](stated if direction == DIRECTIONS[0] else np.linalg.inv(stated)))
    if not found.decided:
        return "open"
    wanted = {"direction": direction, "camera axes": camera_axes, "lidar axes": lidar_axes}
    possible = all(value in found.possible.get(name, ()) for name, value in wanted.items())
    return "right" if possible and np.allclose(found.camera_from_lidar, judge.truth, atol=1e-3) else "wrong"


@pytest.mark.slow
@pytest.mark.parametrize(("step", "wrong"), [(len(COMBINATIONS) // 5, 0.0), (3, 0.01)])
def test_rigs_written_in_many_ways_are_found_or_left_open(judge, step, wrong):
    verdicts = [verdict(judge, *combination) for combination in COMBINATIONS[::step]]
    assert verdicts.count("wrong") <= wrong * len(verdicts)
    assert verdicts.count("right") >= 0.9 * len(verdicts)


def test_without_a_drive_only_implausible_readings_are_left_out_and_other_rigs_are_not_accepted(judge):
    decision = judge.decide(judge.truth, alone=True)
    assert decision.possible["direction"] == ("camera from lidar",)
    assert decision.possible["camera axes"] == (OPENCV,)
    assert len(decision.possible["lidar axes"]) > 1
    assert not decision.decided
    elsewhere = np.eye(4)
    elsewhere[:3, :3] = Rotation.from_euler("y", 40, degrees=True).as_matrix()
    assert not judge.decide(elsewhere @ judge.truth).decided
    over = np.diag([-1.0, -1.0, 1.0, 1.0]) @ judge.truth  # upside down
    decision = judge.decide(over[:3])
    assert not decision.decided or not np.allclose(decision.camera_from_lidar, over)


TRANSLATION, QUATERNION = [0.1, -0.2, 0.3], [0.5, -0.5, 0.5, -0.5]
NINE = [0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0]
ROWS = [*NINE[:3], 0.1, *NINE[3:6], -0.2, *NINE[6:], 0.3]
SIXTEEN = [*ROWS, 0.0, 0.0, 0.0, 1.0]
FOUR_ROWS = [SIXTEEN[k : k + 4] for k in (0, 4, 8, 12)]


def text(numbers):
    return " ".join(map(str, numbers))


HUGE = ", ".join(["1" + "0" * 400] * 16)
NONE = "no extrinsic in it; expected 16, 12 or 9 numbers"


def test_numbers_are_found_in_json_toml_and_text_if_there_are_any(tmp_path):
    for written, location, numbers in [
        (json.dumps({"cameras": [{"imuToCamera": FOUR_ROWS}], "K": [700, 0, 600]}), "cameras[0].imuToCamera", SIXTEEN),
        (f"P2: {text([700.0] * 12)}\nTr_velo_to_cam: {text(ROWS)}\n\n", "Tr_velo_to_cam", ROWS),
        (f"Tr_velo_cam {text(ROWS)}\n", "Tr_velo_cam", ROWS),
        ("\n".join(map(text, FOUR_ROWS)), "", SIXTEEN),
        (f"calib_time: 09-Jan-2012\nR: {text(NINE)}\nT: 0.1 -0.2 0.3\n", "the file", [*NINE, *TRANSLATION]),
        (json.dumps({"translation": TRANSLATION, "rotation": QUATERNION}), "the file", [*TRANSLATION, *QUATERNION]),
        (f"[camera]\nextrinsic = {ROWS}\n", "camera.extrinsic", ROWS),
    ]:
        (tmp_path / "calibration").write_text(written, "utf-8")
        (extrinsic,) = conventions.read_extrinsics(tmp_path / "calibration")
        assert (extrinsic.location, extrinsic.numbers) == (location or extrinsic.location, tuple(numbers))
        assert extrinsic.apart is (len(numbers) == 12 and numbers[:9] == NINE)
        assert "quaternion" not in extrinsic.known
    heading = dict(zip("wxyz", QUATERNION, strict=True))
    pose = {"position": dict(zip("xyz", TRANSLATION, strict=True)), "heading": heading}
    (tmp_path / "poses.json").write_text(json.dumps({"poses": [pose]}), "utf-8")
    (extrinsic,) = conventions.read_extrinsics(tmp_path / "poses.json")
    assert (extrinsic.location, extrinsic.known["quaternion"]) == ("poses[0]", "x y z w")
    np.testing.assert_allclose(extrinsic.numbers, [*TRANSLATION, *QUATERNION[1:], QUATERNION[0]])
    for content, message in [
        (None, "calib"),  # there is no such file yet
        *((text, NONE) for text in ("", "{}", "no numbers at all", "[1, 2, 3]", '{"a": [null, true, "x"]}')),
        ("[[1], [2, 3], 4]", NONE),
        (b"\x89PNG\xff\xfe", r"calib: .*expected a text with an extrinsic"),
        (f'{{"T": [{HUGE}]}}', "too large to convert to float; expected the numbers"),
        (f"T = [{HUGE}]", "too large to convert to float; expected the numbers"),
    ]:
        if content is not None:
            (tmp_path / "calib").write_bytes(content if isinstance(content, bytes) else content.encode())
        with pytest.raises(DataError, match=message):
            conventions.check_file(tmp_path / "calib")


def test_the_files_of_kitti_and_others_are_read(data_dir):
    kitti = conventions.read_extrinsics(data_dir / "real" / "kitti_object" / "calib" / "000001.txt")
    assert [extrinsic.location for extrinsic in kitti] == ["R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo"]
    recording = conventions.read_extrinsics(data_dir / "recordings" / "pandaset" / "calibration.json")
    assert [extrinsic.location for extrinsic in recording][:3] == [f"cameras[{n}].imuToCamera" for n in range(3)]
    nuscenes = conventions.read_extrinsics(data_dir / "real" / "nuscenes_one_sample" / "infos.json")
    assert "data_list[0].images.CAM_FRONT.lidar2cam" in {extrinsic.location for extrinsic in nuscenes}


RATES = {"lidar": (5, 10, 20), "camera": (10, 30, 60), "radar": (13, 20), "imu": (100, 200, 400), "gnss": (1, 10)}


def test_units_of_timestamps_are_those_of_usual_sensors():
    for unit in conventions.UNITS_NS:
        rates = [(kind, rate) for kind, rates in RATES.items() for rate in rates]
        for (kind, rate), start in itertools.product(rates, (0.0, -3.0, 12.5, 1_317_000_000.0)):
            assert conventions.time_units((start + np.arange(50) / rate) * 1e9 / conventions.UNITS_NS[unit], kind) == (
                unit,
            )
    assert conventions.time_units([0, 0, 100, 200, 300, 5000, 5100, 5100, 5200], "lidar") == ("milliseconds",)
    for timestamps in ([], [1.0], [2.0, 2.0], [np.nan, np.inf]):
        assert conventions.time_units(timestamps, "lidar") == ()
    # 9,091 Hz in microseconds, 9.1 Hz in milliseconds: too fast and too slow for an IMU
    assert conventions.time_units(np.arange(10) * 110.0, "imu") == ()


def test_a_sound_drive_is_as_read_a_reversed_mounting_is_reported_and_a_file_judged_by_a_drive(scene, tmp_path):
    report = conventions.check_drive(scene)
    assert [found.as_read for found in report.extrinsics] == [True]
    assert all(found.stated in found.possible for found in report.points)
    assert {found.kind for found in report.times} >= {"lidar", "camera", "imu"}
    assert all("seconds" in found.possible for found in report.times)
    assert not report.wrong
    frame = calibration_frames(scene, most=1)[0]
    upside = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    mount = scene.lidars[0].mount @ frame.camera_from_lidar.inverse() @ upside
    sensors = (replace(one, poses=None, mount=mount) if one.id == "camera0" else one for one in scene.sensors)
    report = conventions.check_drive(replace(scene, sensors=tuple(sensors)))
    assert [found.as_read for found in report.extrinsics] == [False]
    assert report.extrinsics[0].possible["camera axes"] == ("x right, y up, z backward",)
    assert report.wrong
    imu = next(sensor for sensor in scene.sensors if sensor.type == "imu")
    slow = {name: replace(stream, timestamps_ns=stream.timestamps_ns * 1000) for name, stream in imu.streams.items()}
    report = conventions.check_drive(replace(scene, sensors=(replace(imu, streams=slow),)))
    assert [found.possible for found in report.times] == [("milliseconds",)]
    assert report.wrong
    truth = calibration_frames(scene, most=1)[0].camera_from_lidar
    written, path = truth.inverse(), tmp_path / "rig.json"
    pose = {"translation": written.translation.tolist(), "rotation": wxyz(written.matrix).tolist()}
    path.write_text(json.dumps({"front": pose}), "utf-8")
    reported = []
    (found,) = conventions.check_file(
        path, scene, progress=lambda done, total: reported.append((done, total))
    ).extrinsics
    assert (found.location, found.camera, found.decided) == ("front", "camera0", True)
    assert found.possible["quaternion"] == ("w x y z",)
    assert found.possible["direction"] == ("lidar from camera",)
    np.testing.assert_allclose(found.camera_from_lidar, truth.matrix, atol=1e-6)  # rounding of the text
    assert reported == [(1, 1)]
    # alone by plausibility
    (tmp_path / "rig.txt").write_text("Tr: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3\n", "utf-8")
    (found,) = conventions.check_file(tmp_path / "rig.txt").extrinsics
    assert (found.possible["direction"], found.camera) == (("camera from lidar",), None)


@pytest.mark.slow
@pytest.mark.parametrize("recording", ["kitti_drive", "pandaset"])
def test_nothing_of_real_recordings_is_reported_to_be_wrong(data_dir, recording):
    with sceneloom.open(data_dir / "recordings" / recording) as drive:
        report = conventions.check_drive(drive)
    assert not report.wrong
    assert all(found.as_read in {True, None} for found in report.extrinsics)
