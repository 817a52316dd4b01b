"""Scenes whose clocks are corrected, and kept lines of recordings that move along."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.editing.retime import ClockCorrection, retimed_scene
from sceneloom.errors import OptionError
from sceneloom.formats import open_scene, write_scene
from sceneloom.scene import Box2DAnnotation, BoxPath, EventAnnotation
from sceneloom.scene.types import key_of
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

LATE = ClockCorrection(30_000_000.0, 100.0, 1_000_000_000)


@pytest.fixture(scope="module")
def scene():
    """Four sweeps, a camera, an IMU, a receiver, boxes in space and in images."""
    camera = CameraSpec(Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5))
    drive = simulate_street(1, frames=4, lidar=LidarSpec(beams=8, steps=60), cameras=(camera,)).scene
    times = drive.sensor("camera0").images.timestamps_ns.copy()
    boxes = Box2DAnnotation("box", "camera0", BoxPath(times, np.tile([1.0, 1.0, 5.0, 5.0], (len(times), 1))))
    event = EventAnnotation("event", 1_100_000_000, sensor_id="lidar")
    return replace(drive, annotations=(*drive.annotations, boxes, event))


def by_hand(times):
    """The formula of the docstring in whole numbers of a nanosecond."""
    return np.array([t - 30_000_000 - round(1e-4 * (t - 30_000_000 - 1_000_000_000)) for t in times.tolist()])


def corrected(scene, *ids):
    return retimed_scene(scene, sensors={key_of(i): LATE for i in ids})


def test_sweeps_move_with_their_points_unless_those_are_of_another_clock(scene):
    before, after = scene.sensor("lidar").frames, corrected(scene, "lidar").sensor("lidar").frames
    assert after.timestamps_ns.tolist() == by_hand(before.timestamps_ns).tolist()
    for old, new in zip(before, after, strict=True):
        assert new.timestamp_ns == by_hand(np.array([old.timestamp_ns]))[0]
        assert new.points.timestamps_ns.tolist() == by_hand(old.points.timestamps_ns).tolist()
        assert np.array_equal(new.points.positions, old.points.positions)
    points = replace(before[0].points, timestamps_ns=before[0].points.timestamps_ns + 10**15)
    frames = type(before).of([replace(before[0], points=points)], [before[0].timestamp_ns])
    strange = replace(scene, sensors=(replace(scene.sensor("lidar"), frames=frames),), annotations=())
    moved = corrected(strange, "lidar").sensor("lidar").frames[0]
    assert np.array_equal(moved.points.timestamps_ns, points.timestamps_ns)


def test_images_samples_fixes_and_what_was_drawn_in_them_move(scene):
    moved = corrected(scene, "camera0", "imu", "gnss")
    for pick in (
        lambda s: s.sensor("camera0").images.timestamps_ns,
        lambda s: s.sensor("imu").streams["gyroscope"].timestamps_ns,
        lambda s: s.sensor("imu").streams["accelerometer"].timestamps_ns,
        lambda s: s.sensor("gnss").timestamps_ns,
    ):
        assert pick(moved).tolist() == by_hand(pick(scene)).tolist()
    # what is not named stays
    assert moved.sensor("lidar") is scene.sensor("lidar")
    assert moved.trajectories == scene.trajectories
    image = moved.sensor("camera0").images[1]
    assert image.timestamp_ns == moved.sensor("camera0").images.timestamps_ns[1]
    assert np.array_equal(image.rgb, scene.sensor("camera0").images[1].rgb)
    # annotations go with what they were drawn in
    cuboid = next(a for a in scene.annotations if a.type == "cuboid")
    for ids, moves in ((("lidar",), ["cuboid", "event"]), (("camera0",), ["box_2d"]), (("imu",), [])):
        moved = {a.id: a for a in corrected(scene, *ids).annotations}
        for name, pick in (
            ("cuboid", lambda a: a[cuboid.id].path.timestamps_ns),
            ("box_2d", lambda a: a["box"].path.timestamps_ns),
            ("event", lambda a: np.array([a["event"].start_ns])),
        ):
            was = pick({a.id: a for a in scene.annotations})
            assert pick(moved).tolist() == (by_hand(was) if name in moves else was).tolist(), (ids, name)


def test_poses_of_mounted_sensors_are_the_trajectories_at_their_right_times(scene):
    moved = corrected(scene, "lidar")
    lidar, trajectory = moved.sensor("lidar"), scene.trajectories["groundTruth"].poses
    times = lidar.frames.timestamps_ns[1:3]
    ego, sensor = trajectory.interpolate(times), lidar.poses.interpolate(times)
    for k in range(2):
        rotation = Rotation.from_quat(ego.quaternions_xyzw[k])
        expected = ego.positions[k] + rotation.apply(lidar.mount.translation.copy())
        # poses are thinned to a millimetre
        assert np.allclose(sensor.positions[k], expected, atol=2e-3)
    # a trajectory that moves takes them along
    moved = retimed_scene(scene, trajectories={"groundTruth": ClockCorrection(50_000_000.0)})
    before, after = scene.trajectories["groundTruth"], moved.trajectories["groundTruth"]
    assert np.array_equal(after.timestamps_ns, before.timestamps_ns - 50_000_000)
    time = scene.sensor("lidar").frames.timestamps_ns[1:2]
    was = scene.sensor("lidar").poses.interpolate(time + 50_000_000).positions
    # the path keeps within a millimetre of the trajectory
    assert np.allclose(moved.sensor("lidar").poses.interpolate(time).positions, was, atol=3e-3)


def test_there_and_back_is_where_it_was_and_unknown_streams_are_refused(scene):
    times = np.arange(0, 10**12, 10**9)
    there = ClockCorrection(-5e8, -120.0, 10**11).right(times)
    back = ClockCorrection(5e8, 120.0, 10**11).right(there)
    # (120 ppm)² of a thousand seconds is 15 µs, and offset times skew 60 µs
    assert np.abs(back - times).max() < 80_000
    with pytest.raises(OptionError, match="nobody"):
        corrected(scene, "nobody")
    with pytest.raises(OptionError, match="nowhere"):
        retimed_scene(scene, trajectories={"nowhere": LATE})


@pytest.mark.parametrize("suffix", ["drive", "drive.sfs"])
def test_corrected_scenes_can_be_written_and_read_back(scene, tmp_path: Path, suffix):
    moved = corrected(scene, "lidar", "camera0")
    sceneloom.write(moved, tmp_path / suffix, **({"images": "png"} if suffix == "drive" else {}))
    with sceneloom.open(tmp_path / suffix) as again:
        for old, new in (
            (moved.lidars[0].frames.timestamps_ns, again.lidars[0].frames.timestamps_ns),
            (moved.cameras[0].images.timestamps_ns, again.cameras[0].images.timestamps_ns),
        ):
            # scene files count microseconds, and floor the timestamps of sweeps
            assert np.abs(old - new).max() <= 1_000


def sample(seconds, **beside):
    return {"sensor": {"type": "gyroscope", "values": [0.0, 0.5, seconds]} | beside, "time": seconds}


def pose(seconds, **beside):
    return {"groundTruth": {"position": {"x": seconds, "y": 0.0, "z": 0.0}} | beside, "time": seconds}


def fix(seconds, **beside):
    return {"gps": {"latitude": 60.0, "longitude": 25.0, "altitude": seconds} | beside, "time": seconds}


def retimed_lines(folder, lines, **corrections):
    (folder / "drive").mkdir(exist_ok=True)
    (folder / "drive" / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    with open_scene(folder / "drive") as scene:
        write_scene(retimed_scene(scene, **corrections), folder / "again", overwrite=True)
    return [json.loads(line) for line in (folder / "again" / "data.jsonl").read_text().splitlines()]


def test_further_keys_move_with_their_samples_and_a_line_of_two_records_becomes_two(tmp_path):
    lines = [
        *(sample(0.5, temperature=20.0), sample(0.5, temperature=21.0), pose(1.0, status="TRACKING")),
        *(fix(1.125, satellites=7), sample(1.5), sample(2.5, temperature=22.0)),
    ]
    late, early = ClockCorrection(250_000_000), ClockCorrection(-500_000_000)
    found = retimed_lines(tmp_path, lines, sensors={key_of("imu"): late}, trajectories={"groundTruth": early})
    shifts = {"sensor": -0.25, "groundTruth": 0.5, "gps": 0.0}
    expected = [{**line, "time": line["time"] + shifts[next(iter(line))]} for line in lines]
    assert found == sorted(expected, key=lambda line: line["time"])
    # a line of two records is two lines when one of them moves
    found = retimed_lines(tmp_path, [{**sample(0.5), **fix(0.5)}], sensors={key_of("imu"): late})
    assert found == [{**sample(0.5), "time": 0.25}, fix(0.5)]
