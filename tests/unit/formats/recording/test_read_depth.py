"""Depth videos and 16-bit images against the numbers that were put into them, and what is assumed of them."""

import pickle
import re

import numpy as np
import pytest

from sceneloom import diff
from sceneloom.checks import validate
from sceneloom.editing import crop_scene, merge_scenes, thin_scene, to_ego, to_world, undistort_scene
from sceneloom.errors import DataError
from sceneloom.formats.sfs.writer import write_scene as write_sfs
from sceneloom.formats.video.reader import open_video
from sceneloom.pipeline.alignment import moved_scene
from sceneloom.scene import DepthCameraSensor
from sceneloom.scene.contents import watched
from sceneloom.scene.summary import summarise

LOOKS_AHEAD = [[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, -0.2], [0.0, 0.0, 0.0, 1.0]]
COUNT = 4


@pytest.fixture
def images():
    rng = np.random.default_rng(11)
    steps = rng.integers(0, 65536, (COUNT, 16, 32), dtype=np.uint16)
    steps[:, 0, 0], steps[:, 0, 1] = 0, 65535
    return list(steps)


def frames_line(k, **depth_fields):
    entries = [{"cameraInd": 0, "hasDepth": True}, {"cameraInd": 1, **depth_fields}]
    return {"frames": entries, "number": k, "time": 0.1 * k}


def pose_line(k):
    position, orientation = {"x": 2.0 * k, "y": 0, "z": 0}, {"w": 1, "x": 0, "y": 0, "z": 0}
    return {"groundTruth": {"position": position, "orientation": orientation}, "time": 0.1 * k}


def two_cameras(recording, pinhole, fields):
    """A colour camera and the lines of a depth camera, whose images are still to be added."""
    entry = {**pinhole, "imuToCamera": LOOKS_AHEAD}
    lines = [line for k in range(COUNT) for line in (pose_line(k), frames_line(k, **fields(k)))]
    return recording.lines(lines).calibration([entry, entry]).video("data.mkv", COUNT)


@pytest.fixture
def depth_recording(recording, pinhole, images):
    fields = {"colorFormat": "gray16", "depthScale": 0.002, "aligned": True}
    return two_cameras(recording, pinhole, lambda _: fields).video("data2.mkv", images)


@pytest.fixture
def scene(depth_recording):
    with depth_recording.open() as scene:
        yield scene


def codes(scene):
    return {warning.code for warning in scene.warnings}


def test_depths_are_steps_times_their_scale(scene, images):
    camera = scene.sensor("camera1")
    assert isinstance(camera, DepthCameraSensor)
    assert camera.type == "depth_camera"
    assert [c.id for c in scene.cameras] == ["camera0"]
    for frame, steps in zip(camera.frames, images, strict=True):
        assert frame.depth.dtype == np.float32
        # exact but for rounding to float32
        np.testing.assert_array_equal(frame.depth, (steps.astype(np.float64) * 0.002).astype(np.float32))
        assert (frame.scale, frame.depth[0, 0]) == (0.002, 0.0)
    assert camera.frames[1].extras["aligned"] is True
    assert camera.video.codec == "ffv1"
    np.testing.assert_allclose(camera.mount.matrix, np.linalg.inv(LOOKS_AHEAD), atol=1e-15)
    assert not codes(scene)


@pytest.mark.parametrize("name", ["data2.mkv", "data2.avi", "frames2"])
def test_videos_of_either_container_and_images_of_16_bits_hold_depths_with_a_scale_for_each(
    recording, pinhole, images, name
):
    drive = two_cameras(recording, pinhole, lambda k: {"depthScale": 0.001 * (k + 1)})
    (drive.pngs if name == "frames2" else drive.video)(name, images)
    with recording.open() as scene:
        camera = scene.sensor("camera1")
        assert (camera.video is None) == (camera.fps is None) == (name == "frames2")
        for k, frame in enumerate(camera.frames):
            np.testing.assert_allclose(frame.depth, images[k] * (0.001 * (k + 1)), rtol=1e-6)  # float32


def test_a_scale_that_is_not_stated_is_a_millimetre_a_calibration_that_of_the_first_camera_and_others_are_refused(
    recording, pinhole, images
):
    two_cameras(recording, pinhole, lambda _: {}).video("data2.mkv", images)
    recording.calibration([{**pinhole, "imuToCamera": LOOKS_AHEAD}])
    with recording.open() as scene:
        colour, depth = scene.sensor("camera0"), scene.sensor("camera1")
        assert depth.frames[0].depth[0, 1] == np.float32(65.535)
        assert (depth.camera, codes(scene)) == (colour.camera, {"depth-aligned", "depth-scale-assumed"})
        np.testing.assert_array_equal(depth.mount.matrix, colour.mount.matrix)
    for scale in (0, -0.001, "0.001", True, 1e9):
        two_cameras(recording, pinhole, lambda _, scale=scale: {"depthScale": scale})
        with pytest.raises(DataError, match=re.escape(f"depthScale: {scale!r} of camera 1; expected metres")):
            recording.open()
        with recording.open(lenient=True) as scene:
            assert [sensor.id for sensor in scene.sensors] == ["camera0"]


def test_depths_in_a_video_of_colours_are_refused_and_one_of_steps_has_colours(depth_recording, tmp_path, pinhole):
    with open_video(depth_recording.path / "data.mkv") as video:
        assert not video.has_steps
        with pytest.raises(DataError, match="has pixels of type bgr0; expected one of gray16le"):
            video.steps(0)
    with open_video(depth_recording.path / "data2.mkv") as video:
        assert video.has_steps
        assert video.rgb(0).shape == (16, 32, 3)
    other = type(depth_recording)(tmp_path / "other")
    two_cameras(other, pinhole, lambda _: {"colorFormat": "gray16"}).video("data2.mkv", COUNT)
    with pytest.raises(DataError, match="pixels are no 16-bit grey, while lines state colorFormat 'gray16'"):
        other.open()


def test_validation_reads_depth_images_and_names_one_that_cannot_be_decoded(depth_recording, tmp_path, pinhole, images):
    report = validate(depth_recording.path, locations=None)
    assert [f for f in report.findings if f.severity == "error"] == []
    assert report.passed
    other = type(depth_recording)(tmp_path / "other")
    two_cameras(other, pinhole, lambda _: {"depthScale": 0.001}).pngs("frames2", images)
    broken = other.path / "frames2" / "00000002.png"
    broken.write_bytes(broken.read_bytes()[:-60])
    report = validate(other.path, locations=None)
    assert [f.path for f in report.findings if f.rule == "frame-readable"] == ["sensors[1].frames[2]"]


def test_depth_cameras_are_counted_watched_sent_to_other_processes_and_left_out_of_scene_files(scene, images, tmp_path):
    summary = summarise(scene).sensors[1]
    found = (summary.type, summary.count, summary.camera_model, summary.video)
    assert found == ("depth_camera", COUNT, "pinhole 32x16", "ffv1")
    assert (summary.rate_hz, summary.poses, summary.mounted) == (pytest.approx(10.0), COUNT, True)
    reported = []
    for frame in watched(scene, lambda *what: reported.append(what)).sensor("camera1").frames:
        assert frame.depth.shape == (16, 32)
    assert [what[:2] for what in reported] == [("camera1", k) for k in range(4)]
    there = pickle.loads(pickle.dumps(scene.sensor("camera1")))
    np.testing.assert_array_equal(there.frames[3].depth, scene.sensor("camera1").frames[3].depth)
    losses = {loss.field: loss.what for loss in write_sfs(scene, tmp_path / "drive.sfs")}
    assert "4 depth images" in losses["sensors[camera1]"]


def test_parts_of_a_drive_have_the_depth_images_of_their_times(scene, images):
    halves = crop_scene(scene, stop=0.2), crop_scene(scene, start=0.2)
    for part, rows in (
        (crop_scene(scene, start=0.1, stop=0.3), [1, 2]),
        (thin_scene(scene, every=2), [0, 2]),
        (merge_scenes(halves, join=True), [0, 1, 2, 3]),
    ):
        camera = part.sensor("camera1")
        assert camera.frames.timestamps_ns.tolist() == [row * 100_000_000 for row in rows]
        assert len(rows) == COUNT or camera.video.frame_indices == tuple(rows)
        for frame, row in zip(camera.frames, rows, strict=True):
            np.testing.assert_allclose(frame.depth, images[row] * 0.002, rtol=1e-6)  # float32
    # and they are placed as cameras are
    colour, depth = to_world(scene).sensor("camera0"), to_world(scene).sensor("camera1")
    np.testing.assert_allclose(depth.poses.positions, colour.poses.positions, atol=1e-12)
    # each pose at x = 2 k; the mounting puts the camera 0.2 m ahead and 0.1 m to the left
    np.testing.assert_allclose(depth.poses.positions[:, 0], 2.0 * np.arange(COUNT) + 0.2, atol=1e-12)
    on_ego = to_ego(scene).sensor("camera1")
    np.testing.assert_allclose(on_ego.poses.positions, [[0.2, 0.1, 0.0]] * COUNT, atol=1e-12)
    moved = moved_scene(scene, np.array([1.0, 2.0, 3.0])).sensor("camera1")
    np.testing.assert_allclose(moved.poses.positions, depth.poses.positions - [1, 2, 3], atol=1e-12)


def test_differences_of_depths_are_reported_and_undistorting_leaves_them_and_says_so(
    depth_recording, pinhole, images, tmp_path
):
    images[1][5, 7] ^= 512
    fields = {"colorFormat": "gray16", "depthScale": 0.002, "aligned": True}
    other = two_cameras(type(depth_recording)(tmp_path / "other"), pinhole, lambda _: fields)
    other.video("data2.mkv", images)
    with depth_recording.open() as first, other.open() as second:
        assert not diff(first, first, pixels=True).differences
        reported = {d.path: d.amount for d in diff(first, second, pixels=True).differences if "camera1" in d.path}
    # 512 steps of 2 mm in one of 512 pixels; float32
    assert reported == {"sensors['camera1'].frames[].depth": pytest.approx(512 * 0.002 / 512, rel=1e-5)}
    bent = {**pinhole, "distortionCoefficients": [-0.1, 0.01, 0.0]}
    with other.calibration([bent, bent]).open() as scene:
        plain = undistort_scene(scene)
        assert plain.sensor("camera0").camera.model == "pinhole"
        assert plain.sensor("camera1").camera == scene.sensor("camera1").camera
        assert codes(plain) == {"depth-not-undistorted"}
