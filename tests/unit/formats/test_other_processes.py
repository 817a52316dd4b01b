"""Scenes and samples in other processes: the same frames and images, bit for bit, and files of their own."""

import hashlib
import inspect
import json
import os
import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import simplejpeg

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError
from sceneloom.formats.recording.cameras import PngFolder
from sceneloom.formats.video.reader import VideoReader, open_video
from sceneloom.pipeline.alignment import moved_scene
from sceneloom.pipeline.deskewing import deskewed_scene
from sceneloom.scene import CameraImage, LazyFrames, LidarFrame, LidarPoints, LidarSensor, PointsSensor, Scene
from sceneloom.scene.time_range import cut_scene
from sceneloom.simulate import (
    CameraSpec,
    Faults,
    LidarSpec,
    RadarSpec,
    SensorFaults,
    SolidStateSpec,
    TrafficSpec,
    simulate_street,
)

CAMERA_MODELS = (
    Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5),
    Camera("fisheye", 64, 48, 30.0, 30.0, 31.5, 23.5, (0.02, -0.004)),
)


def digest(scene):
    """One number for all that can be read of a scene."""
    stated = hashlib.sha256()
    for sensor in scene.sensors:
        stated.update(f"{sensor.id!r} {sorted(sensor.extras)}".encode())
    for cloud in [sensor for sensor in scene.sensors if sensor.type in ("lidar", "radar")]:
        for frame in cloud.frames:
            arrays = [
                getattr(frame.points, name, None) for name in ("positions", "intensities", "timestamps_ns", "rings")
            ]
            stated.update(b"".join(a.tobytes() for a in arrays if a is not None))
            stated.update(repr((frame.timestamp_ns, sorted(frame.extras))).encode())
    for camera in scene.cameras:
        for image in camera.images:
            stated.update(repr((image.timestamp_ns, image.camera, sorted(image.extras))).encode())
            stated.update(image.rgb.tobytes())
            stated.update(b"" if image.encoded is None else image.encoded())
        if camera.video is not None:
            with camera.video.open() as file:
                stated.update(file.read())
    return stated.hexdigest()


IN_ANOTHER = (
    "import hashlib, json, pickle, sys\n"
    + inspect.getsource(digest)
    + """
found = {}
for name, location in json.load(sys.stdin).items():
    with open(location, "rb") as file:
        scene = pickle.load(file)
    found[name] = digest(scene)
    scene.close()
print(json.dumps(found))
"""
)

POOLS = """
import json, multiprocessing, pickle, sys, warnings

def hashed(arrays):
    return {name: array.tobytes().hex() for name, array in arrays.items()}

def arrays(number):
    return hashed(SAMPLES[number].arrays())

def take(blob):
    global SAMPLES
    SAMPLES = pickle.loads(blob)

if __name__ == "__main__":
    # a process that has threads of its own may be forked: what could hang there is what is tested
    warnings.filterwarnings("ignore", "This process .* is multi-threaded", DeprecationWarning)
    locations = json.load(sys.stdin)
    for location in locations:
        with open(location, "rb") as file:
            SAMPLES = pickle.load(file)
        numbers = range(len(SAMPLES))
        expected = [arrays(number) for number in numbers]
        blob = pickle.dumps(SAMPLES)
        for method in sys.argv[1:]:
            # forked processes find the samples open, with a decoder on its trajectory; others get them pickled
            started = {} if method == "fork" else {"initializer": take, "initargs": (blob,)}
            with multiprocessing.get_context(method).Pool(2, **started) as pool:
                assert pool.map(arrays, numbers, chunksize=1) == expected, (location, method)
                sent = pool.map(SAMPLES.__getitem__, numbers, chunksize=1)
                assert [hashed(sample.arrays()) for sample in sent] == expected, (location, method)
                # and the parent, too, goes on
                assert arrays(0) == expected[0]
        SAMPLES.scene.close()
    print("done", len(locations))
"""


def run(program, question, *arguments):
    """Run a program in a fresh interpreter, outside the checkout, and give what it prints."""
    what = ["-c", program] if isinstance(program, str) else [str(program)]
    done = subprocess.run(
        [sys.executable, "-W", "error", *what, *arguments],
        input=json.dumps(question),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


RIG = """
[[sensors]]
id = "front"
type = "camera"
video = "data.mkv"
times = { rate_hz = 10 }
camera_model = { fx = 60, fy = 60, cx = 47.5, cy = 31.5 }
extrinsic = { to = "base", matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]] }
"""


@pytest.fixture(scope="module")
def locations(tmp_path_factory):
    """A drive as recordings with videos and with PNG files, as scene files raw and fused, and with JPEG images."""
    folder = tmp_path_factory.mktemp("drives")
    cameras = tuple(CameraSpec(camera_model) for camera_model in CAMERA_MODELS)
    drive = simulate_street(1, frames=5, lidar=LidarSpec(beams=8, steps=90), cameras=cameras).scene
    sceneloom.write(drive, folder / "video")
    sceneloom.write(drive, folder / "png", images="png")
    sceneloom.write(drive, folder / "raw.sfs")
    sceneloom.fuse(drive, folder / "fused.sfs")
    (folder / "rig").mkdir()
    shutil.copy(folder / "video" / "data.mkv", folder / "rig")
    (folder / "rig" / "rig.toml").write_text(RIG)
    sceneloom.write(Scene((jpeg_camera(drive.cameras[0]),)), folder / "jpeg.sfs")
    return folder


def jpeg_camera(camera):
    """The same camera, its images JPEG files."""
    files = [partial(simplejpeg.encode_jpeg, image.rgb, 90, "RGB", "444") for image in camera.images]
    images = [replace(p, encoded=file) for p, file in zip(camera.images, files, strict=True)]
    return replace(camera, images=LazyFrames.of(images, camera.images.timestamps_ns))


def living_street():
    """A simulated drive of all that moves and measures, with something wrong in it."""
    lidars = (LidarSpec(beams=4, steps=40), SolidStateSpec())
    wrong = Faults({"lidar0": SensorFaults(clock_skew_ppm=50.0), "camera0": SensorFaults(lost_frames=(1,))})
    cameras, radars = (CameraSpec(CAMERA_MODELS[0]),), (RadarSpec(),)
    traffic = TrafficSpec()
    return simulate_street(
        2, frames=2, lidars=lidars, cameras=cameras, radars=radars, traffic=traffic, faults=wrong
    ).scene


@pytest.fixture(scope="module")
def scenes(locations):
    """Scenes of every kind."""
    small = LidarSpec(beams=4, steps=40)
    simulated = simulate_street(2, frames=2, lidar=small, cameras=(CameraSpec(CAMERA_MODELS[0]),)).scene
    names = ("video", "png", "raw.sfs", "fused.sfs", "jpeg.sfs", "rig")
    opened = {name: sceneloom.open(locations / name) for name in names}
    kept = [replace(image, extras={}) for image in opened["png"].cameras[0].images]
    in_memory = [CameraImage.of(image.timestamp_ns, image.camera, image.rgb) for image in kept]
    timestamps = [image.timestamp_ns for image in kept]
    yield {
        **opened,
        "simulated": simulated,
        "living street": living_street(),
        "deskewed": deskewed_scene(opened["video"]),
        "memory": Scene(
            (
                LidarSensor("top", LazyFrames.of([LidarFrame(5, LidarPoints(np.ones((4, 3), np.float32)))], [5])),
                replace(opened["png"].cameras[0], images=LazyFrames.of(in_memory, timestamps)),
            )
        ),
        "cut": cut_scene(opened["raw.sfs"], start=0.1, stop=0.3),
        "cut video": cut_scene(opened["video"], start=0.1, stop=0.3),
        "moved": moved_scene(opened["fused.sfs"], np.array([1.0, 2.0, 3.0])),
        "replaced": replace(
            opened["video"], sensors=tuple(replace(camera, id=f"my {camera.id}") for camera in opened["video"].cameras)
        ),
        "map": Scene((PointsSensor("map", np.ones((5, 3), np.float32)),)),
    }
    for scene in opened.values():
        scene.close()


def pickled(objects, folder):
    """Write pickles to files, and give where they are."""
    found = {name: str(folder / f"{k}.pickle") for k, name in enumerate(objects)}
    for name, location in found.items():
        Path(location).write_bytes(pickle.dumps(objects[name]))
    return found


def test_scenes_of_every_kind_give_the_same_bits_in_another_process(scenes, tmp_path):
    expected = {name: digest(scene) for name, scene in scenes.items()}
    assert len(set(expected.values())) == len(expected)
    assert scenes["jpeg.sfs"].cameras[0].images[0].encoded is not None
    found = json.loads(run(IN_ANOTHER, pickled(scenes, tmp_path)))
    assert found == expected


def test_scenes_that_were_never_read_can_go_as_well(locations, tmp_path):
    fresh = {name: sceneloom.open(locations / name) for name in ("video", "raw.sfs")}
    found = json.loads(run(IN_ANOTHER, pickled(fresh, tmp_path)))
    assert found == {name: digest(scene) for name, scene in fresh.items()}
    for scene in fresh.values():
        scene.close()


@pytest.mark.slow
def test_samples_are_the_same_in_spawned_and_forked_workers_and_as_sent_back_by_them(scenes, tmp_path):
    chosen = {name: scenes[name].samples() for name in ("video", "raw.sfs", "cut video")}
    program = tmp_path / "pools.py"
    program.write_text(POOLS)
    methods = ["spawn", "fork"] if hasattr(os, "fork") else ["spawn"]
    assert run(program, list(pickled(chosen, tmp_path).values()), *methods).strip() == "done 3"


def test_closing_a_scene_closes_nothing_elsewhere(locations):
    scene = sceneloom.open(locations / "raw.sfs")
    rgb = scene.cameras[0].images[1].rgb
    elsewhere = pickle.loads(pickle.dumps(scene))
    scene.close()
    np.testing.assert_array_equal(elsewhere.cameras[0].images[1].rgb, rgb)
    elsewhere.close()
    with pytest.raises(DataError, match="the scene is closed"):
        elsewhere.lidars[0].frames[0]
    with pytest.raises(DataError, match="the scene is closed"):
        pickle.loads(pickle.dumps(scene)).lidars[0].frames[0]


def test_closing_a_recording_closes_nothing_elsewhere(locations):
    scene = sceneloom.open(locations / "video")
    rgb = scene.cameras[1].images[2].rgb
    elsewhere = pickle.loads(pickle.dumps(scene))
    scene.close()
    np.testing.assert_array_equal(elsewhere.cameras[1].images[2].rgb, rgb)
    elsewhere.close()
    for closed in (scene, elsewhere, pickle.loads(pickle.dumps(scene))):
        with pytest.raises(DataError, match="is closed"):
            closed.cameras[1].images[2].rgb  # noqa: B018


@pytest.mark.parametrize(
    ("name", "file", "read"),
    [
        ("raw.sfs", "raw.sfs", lambda scene: scene.lidars[0].frames[0]),
        ("video", "video/data.mkv", lambda scene: scene.cameras[0].images[0].rgb),
    ],
)
def test_a_file_that_was_changed_meanwhile_is_refused(locations, name, file, read):
    scene = sceneloom.open(locations / name)
    read(scene)
    parcel = pickle.dumps(scene)
    changed = next((locations / file).parent.glob(f"{(locations / file).stem}.*"))
    status = changed.stat()
    os.utime(changed, ns=(status.st_atime_ns, status.st_mtime_ns + 1_000_000_000))
    try:
        with pytest.raises(DataError, match=r"was changed after it was opened: .* \+1\.000 s apart"):
            read(pickle.loads(parcel))
    finally:
        os.utime(changed, ns=(status.st_atime_ns, status.st_mtime_ns))
        scene.close()


def test_a_file_that_was_removed_meanwhile_is_named(locations, tmp_path):
    content = (locations / "raw.sfs").read_bytes()
    (tmp_path / "gone.sfs").write_bytes(content)
    with sceneloom.open(tmp_path / "gone.sfs") as scene:
        parcel = pickle.dumps(scene)
        (tmp_path / "gone.sfs").unlink()
        assert len(scene.lidars[0].frames[0].points)
    with pytest.raises(DataError, match=r"gone\.sfs.*cannot be opened again"):
        pickle.loads(parcel).lidars[0].frames[0]


def test_a_scene_of_a_file_is_small_when_pickled_and_one_in_memory_takes_its_arrays(scenes):
    """What is pickled are timestamps, poses and tables; points and pixels stay in the file."""
    for name in ("video", "png", "raw.sfs", "fused.sfs"):
        scene = scenes[name]
        points = sum(frame.points.positions.nbytes for lidar in scene.lidars for frame in lidar.frames)
        pixels = sum(image.rgb.nbytes for camera in scene.cameras for image in camera.images)
        assert len(pickle.dumps(scene)) < (points + pixels) / 2, name
    assert len(pickle.dumps(scenes["memory"])) > 5 * 96 * 64 * 3


def test_a_video_takes_its_list_of_images_along(locations, monkeypatch):
    video = open_video(next((locations / "video").glob("data.*kv")))
    rgb = video.rgb(3)
    monkeypatch.setattr("sceneloom.formats.video.reader.read_index", lambda *_: pytest.fail("walked through again"))
    again = pickle.loads(pickle.dumps(video))
    np.testing.assert_array_equal(again.rgb(3), rgb)
    assert again.count == 5


def test_a_scene_file_takes_the_lists_of_its_videos_along(locations, monkeypatch):
    scene = sceneloom.open(locations / "raw.sfs")
    rgb = scene.cameras[1].images[3].rgb
    parcel = pickle.dumps(pickle.loads(pickle.dumps(scene)))
    monkeypatch.setattr("sceneloom.formats.video.reader.read_index", lambda *_: pytest.fail("walked through again"))
    np.testing.assert_array_equal(pickle.loads(parcel).cameras[1].images[3].rgb, rgb)


def test_a_video_of_bytes_takes_its_bytes_along(locations):
    content = next((locations / "video").glob("data.*kv")).read_bytes()
    for source in (content, bytearray(content), memoryview(content)):
        video = open_video(source)
        np.testing.assert_array_equal(pickle.loads(pickle.dumps(video)).rgb(4), video.rgb(4))


def test_a_folder_of_images_can_be_pickled(locations):
    folder = PngFolder(locations / "png" / "frames1")
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(folder)).rgb(2), folder.rgb(2))


def test_a_sample_that_is_pickled_needs_no_file(locations, tmp_path):
    content = (locations / "raw.sfs").read_bytes()
    (tmp_path / "gone.sfs").write_bytes(content)
    with sceneloom.open(tmp_path / "gone.sfs") as scene:
        sample = scene.samples()[2]
        expected, parcel = sample.arrays(), pickle.dumps(sample)
    (tmp_path / "gone.sfs").unlink()
    found = pickle.loads(parcel).arrays()
    assert list(found) == list(expected)
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array)


def test_a_sample_with_a_damaged_image_can_be_pickled_and_says_so_later(scenes):
    sample = scenes["raw.sfs"].samples(cameras="camera0")[0]
    damaged = replace(sample.images["camera0"], decode=partial(_refuse, "is torn"))
    again = pickle.loads(pickle.dumps(replace(sample, images={"camera0": damaged})))
    with pytest.raises(DataError, match="is torn"):
        again.images["camera0"].rgb  # noqa: B018


def _refuse(problem):
    raise DataError("drive", "image 0", problem)


def test_a_map_of_a_file_stays_in_it_and_one_in_memory_goes_along(tmp_path):
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(20_000, 3)).astype(np.float32)
    in_memory = PointsSensor("map", positions, rng.integers(0, 256, (20_000, 3)).astype(np.uint8))
    sceneloom.write(Scene((in_memory,)), tmp_path / "map.sfs")
    with sceneloom.open(tmp_path / "map.sfs") as scene:
        parcel = pickle.dumps(scene)
    assert len(parcel) < 5_000 < len(pickle.dumps(in_memory))
    for restored in (pickle.loads(parcel).sensors[0], pickle.loads(pickle.dumps(in_memory))):
        np.testing.assert_array_equal(restored.positions, positions)
        np.testing.assert_array_equal(restored.colors, in_memory.colors)
    os.utime(tmp_path / "map.sfs", ns=(0, 0))
    with pytest.raises(DataError, match="was changed after it was opened"):
        pickle.loads(parcel)


def test_a_worker_that_goes_forward_seeks_in_each_video_once(scenes, monkeypatch):
    samples = pickle.loads(pickle.dumps(scenes["video"].samples()))
    sought = []
    seek = VideoReader._seek
    monkeypatch.setattr(VideoReader, "_seek", lambda reader, k: sought.append((reader.name, k)) or seek(reader, k))
    for sample in samples:
        assert all(image.rgb.any() for image in sample.images.values())
    assert sorted(k for _, k in sought) == [0, 0]
    assert len({name for name, _ in sought}) == 2


def test_poses_and_mountings_refuse_writing_after_the_journey_too(scenes):
    camera = pickle.loads(pickle.dumps(scenes["video"])).cameras[0]
    for array in (camera.poses.positions, camera.mount.rotation, camera.images.timestamps_ns):
        assert not array.flags.writeable


def test_images_in_memory_refuse_writing_after_the_journey_too(scenes):
    rgb = pickle.loads(pickle.dumps(scenes["memory"])).cameras[0].images[0].rgb
    with pytest.raises(ValueError, match="read-only"):
        rgb[:] = 0
