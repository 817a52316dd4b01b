"""A drive that is written as a recording and read back is the same, but for what the loss report reports."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

import sceneloom
from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.editing.diff import Change, diff_scenes
from sceneloom.formats.recording.writer import write_recording
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import CameraSpec, ImuSpec, LidarSpec, RadarSpec, camera_mount, sensor_mount, simulate_street

MS = 1_000_000

_KEPT = re.compile(r"(metadata|.*\.extras)\[|trajectories\['[^']*'\]$|.*\.(file_seconds|mount|fps|model)$")
"""What reading adds: the file's own numbers and texts, a trajectory and mountings found from poses, a rate."""


def untold(scene, back, report, **tolerances):
    """The differences that no loss reports; sensors that were read back under other ids are named as they were."""
    stated = [(re.fullmatch(r"read back as '(.*)'", loss.what), loss.field) for loss in report]
    names = {match[1]: re.fullmatch(r"sensors\[(.*)\]\.id", field)[1] for match, field in stated if match}
    back = replace(back, sensors=tuple(replace(s, id=names.get(s.id, s.id)) for s in back.sensors))
    fields = [re.sub(r"\[([^\]]+)\]", r"['\1']", loss.field) for loss in report]
    fields = [re.sub(r"^metadata\.(\w+)$", r"metadata['\1']", field) for field in fields]
    found = diff_scenes(scene, back, pixels=True, other_timestamps=True, **tolerances)
    assert not found.not_compared
    return [
        difference
        for difference in found.differences
        if not any(_covers(field, difference.path) for field in fields)
        and not (difference.change is Change.ADDED and _KEPT.match(difference.path))
        and not _same_direction(scene, back, difference.path)
    ]


def _covers(field, path):
    if field == "sensors":
        return path == field
    if field.endswith(".camera"):
        # images have their camera model, unless they state another
        path = path.replace(".images[].camera", ".camera")
    if field.startswith("sensors[]"):
        return re.sub(r"\['[^']*'\]", "[]", path, count=1).startswith(field)
    return path.startswith(field)


def _same_direction(scene, back, path):
    """Whether poses differ in their timestamps only; those of recordings stand at the times of the frames."""
    match = re.fullmatch(r"sensors\['([^']*)'\]\.poses\..*", path)
    if not match:
        return False
    a, b = (next(s for s in each.sensors if str(s.id) == match[1]).poses for each in (scene, back))
    timestamps = np.clip(b.timestamps_ns, a.timestamps_ns[0], a.timestamps_ns[-1])
    positions = np.stack([np.interp(timestamps, a.timestamps_ns, column) for column in a.positions.T], axis=1)
    rotations = Slerp(a.timestamps_ns, Rotation.from_quat(a.quaternions_xyzw))(timestamps)
    angles = (rotations.inv() * Rotation.from_quat(b.quaternions_xyzw)).magnitude()
    # between poses 10 ms apart, a sensor on an arm of 2 m and its ego do not move on the very same line
    return np.abs(positions - b.positions).max() < 1e-3 and np.degrees(angles.max()) < 0.01


def cameras(camera_model):
    return [CameraSpec(camera_model, camera_mount(position=(1.5, y, 1.5))) for y in (0.25, -0.25)]


@pytest.fixture(scope="module")
def stereo():
    """Two cameras, lidar, IMU, GNSS and ground truth."""
    camera_model = Camera("pinhole", 64, 40, 40.0, 40.0, 31.5, 19.5)
    return simulate_street(
        1, frames=4, lidar=LidarSpec(beams=16, steps=100), cameras=cameras(camera_model), imu=ImuSpec(rate_hz=200.0)
    ).scene


@pytest.mark.parametrize("images", ["png", "ffv1", "h264"])
def test_images_come_back_as_they_were_kept_and_what_differs_is_reported(stereo, tmp_path, images):
    report = write_recording(stereo, tmp_path / "drive", images=images)
    with sceneloom.open(tmp_path / "drive") as scene:
        assert [camera.id for camera in scene.cameras] == ["camera0", "camera1"]
        off = np.array([
            np.abs(shot.rgb.astype(int) - again.rgb)
            for camera, found in zip(stereo.cameras, scene.cameras, strict=True)
            for shot, again in zip(camera.images, found.images, strict=True)
        ])  # fmt: skip
        if images == "h264":
            # chroma has half the resolution: edges of colours bleed, planes stay within a few levels
            assert np.median(off, axis=(1, 2, 3)).max() <= 4
            assert off.mean(axis=(1, 2, 3)).max() <= 12
            write_recording(scene, tmp_path / "ffv1", images="ffv1")
            with sceneloom.open(tmp_path / "ffv1") as back:
                by_bytes = {difference.message for difference in diff_scenes(scene, back).differences}
                assert by_bytes == {"h264; then ffv1 of other bytes"}
                assert diff_scenes(scene, back, pixels=True).equal
        else:
            assert off.max() == 0
        assert ("sensors[camera0].images[].rgb" in [loss.field for loss in report]) == (images == "h264")
        # a mounting is reversed on writing, and on reading again
        assert untold(stereo, scene, report, tolerance_m=1e-12, tolerance_deg=1e-10) == []


def whole_street():
    """A drive with radar, two lidars, boxes, odd camera models, attributes and a trajectory that is reported twice."""
    camera_model = Camera("fisheye_rad_tan_prism", 64, 40, 40.0, 40.0, 31.5, 19.5, (0.05, -0.01))
    lidars = [LidarSpec(beams=8, steps=60), LidarSpec(beams=8, steps=60, mount=sensor_mount(position=(0.0, 0.5, 1.0)))]
    scene = simulate_street(2, frames=3, lidars=lidars, cameras=cameras(camera_model), radars=[RadarSpec()]).scene
    trajectory = scene.trajectories["groundTruth"].poses
    moved = sc.Poses(trajectory.timestamps_ns, trajectory.positions + 1.0, trajectory.quaternions_xyzw)
    named = [replace(sensor, id=f"my {sensor.id}") for sensor in scene.sensors]
    return replace(scene, sensors=(*named, sc.OdometrySensor("wheels", moved)))


def depth_pair():
    """A camera and one that measures depth, with a step of its own."""
    camera_model = Camera("pinhole", 32, 16, 30.0, 31.0, 16.0, 8.0)
    rng = np.random.default_rng(5)
    timestamps = np.arange(3, dtype=np.int64) * 100 * MS
    pixels = rng.integers(0, 256, (3, 16, 32, 3)).astype(np.uint8)
    steps = rng.integers(0, 65536, (3, 16, 32))
    here, shots, images = RigidTransform.identity(), [], []
    for k, t in enumerate(timestamps.tolist()):
        shots.append(sc.CameraImage.of(t, camera_model, pixels[k]))
        images.append(sc.DepthFrame(t, camera_model, lambda k=k: (steps[k] * 0.002).astype(np.float32), 0.002))
    depth = sc.DepthCameraSensor("depth", camera_model, sc.LazyFrames.of(images, timestamps), mount=here)
    return sc.Scene((depth, sc.CameraSensor("colour", camera_model, sc.LazyFrames.of(shots, timestamps), mount=here)))


def poses_alone():
    """Cameras with poses in the world, and no ego trajectory."""
    camera_model = Camera("pinhole", 32, 16, 30.0, 31.0, 16.0, 8.0)
    timestamps = np.arange(3, dtype=np.int64) * 100 * MS
    positions = np.arange(9.0).reshape(3, 3)
    rotations = np.tile([0.0, 0.0, 0.6, 0.8], (3, 1))
    sensors = []
    for k, name in enumerate(("left", "right")):
        shots = [sc.CameraImage.of(int(t), camera_model, np.full((16, 32, 3), 9 * k, np.uint8)) for t in timestamps]
        poses = sc.Poses(timestamps, positions + np.array([0, k, 0]), rotations)
        sensors.append(sc.CameraSensor(name, camera_model, sc.LazyFrames.of(shots, timestamps), poses=poses))
    return sc.Scene(tuple(sensors))


def numbers_alone():
    """Two receivers, the pressure of the air, and a trajectory without orientations."""
    timestamps = np.arange(20, dtype=np.int64) * 50 * MS
    rng = np.random.default_rng(1)
    streams = {"accelerometer": sc.VectorSamples(timestamps, rng.normal(size=(20, 3)))}
    streams["barometer"] = sc.VectorSamples(timestamps, rng.normal(1013.0, 1.0, (20, 1)))
    lla = np.stack([60 + rng.random(20), 24 + rng.random(20), rng.random(20)], axis=1)
    accuracies = np.where(rng.random(20) < 0.5, np.nan, 2.0)
    fixes = [sc.GnssSensor(name, timestamps, lla, accuracies, accuracies[::-1]) for name in ("gnss", "rtkgps")]
    trajectory = sc.Trajectory("arcore", timestamps, rng.normal(size=(20, 3)), None)
    return sc.Scene((sc.ImuSensor("imu", streams), *fixes), trajectories={"arcore": trajectory})


SCENES = {made.__name__: made for made in (whole_street, depth_pair, poses_alone, numbers_alone)}


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("images", ["copy", "png"])
def test_a_scene_loses_only_what_its_loss_report_says_and_nothing_when_it_is_written_again(tmp_path, name, images):
    scene = SCENES[name]()
    first, second = tmp_path / "first", tmp_path / "second"
    report = write_recording(scene, first, images=images)
    with sceneloom.open(first) as back:
        assert untold(scene, back, report, tolerance_m=1e-12, tolerance_deg=1e-10) == []
        if images == "copy":
            report = write_recording(back, second)
            assert [loss for loss in report if loss.field != "replay"] == []
            files = [path.relative_to(first) for path in first.rglob("*") if path.is_file()]
            assert len(files) >= 1
            for file in files:
                assert (first / file).read_bytes() == (second / file).read_bytes(), file


def test_a_scene_file_of_another_program_loses_only_what_its_loss_report_says(data_dir, tmp_path):
    path = data_dir / "real" / "sfs_reference" / "argoverse2_2frames_cuboids.sfs"
    with sceneloom.open(path) as scene:
        report = write_recording(scene, tmp_path / "drive")
        with sceneloom.open(tmp_path / "drive") as back:
            assert untold(scene, back, report) == []
    # and what is reported is little: the scene has boxes, and points in the world, of a lidar that nothing else
    # locations
    lidar = ("id", "poses", "points_frame", *(f"frames[].points.{n}" for n in ("positions", "rings", "timestamps_ns")))
    assert {loss.field for loss in report} == {
        *("annotations", "metadata.source", "metadata.sceneloom", "extras.time_unit"),
        *(f"sensors[up_lidar].{field}" for field in lidar),
    }
