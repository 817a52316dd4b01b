"""Scenes and samples in other processes: the same frames and images, bit for bit, and files of their own."""

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
from sceneloom.formats.recording.reader import PngFolder
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

from .conftest import digest

CAMERA_MODELS = (
    Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5),
    Camera("fisheye", 64, 48, 30.0, 30.0, 31.5, 23.5, (0.02, -0.004)),
)


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


def run(question, *words):
    """Run Python with some words on its command line, outside the checkout, and give what it prints."""
    command = [sys.executable, "-W", "error", *words]
    asked = json.dumps(question)
    done = subprocess.run(command, input=asked, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


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
    camera = drive.cameras[0]
    files = [partial(simplejpeg.encode_jpeg, image.rgb, 90, "RGB", "444") for image in camera.images]
    images = [replace(p, encoded=file) for p, file in zip(camera.images, files, strict=True)]
    camera = replace(camera, images=LazyFrames.of(images, camera.images.timestamps_ns))
    sceneloom.write(Scene((camera,)), folder / "jpeg.sfs")
    return folder


@pytest.fixture(scope="module")
def scenes(locations):
    # a drive of all that moves and measures, with something wrong in it
    wrong = Faults({"lidar0": SensorFaults(clock_skew_ppm=50.0), "camera0": SensorFaults(lost_frames=(1,))})
    simulated = simulate_street(
        2, frames=2, lidars=(LidarSpec(beams=4, steps=40), SolidStateSpec()), cameras=(CameraSpec(CAMERA_MODELS[0]),),
        radars=(RadarSpec(),), traffic=TrafficSpec(), faults=wrong,
    ).scene  # fmt: skip
    names = ("video", "png", "raw.sfs", "fused.sfs", "jpeg.sfs")
    opened = {name: sceneloom.open(locations / name) for name in names}
    images = opened["png"].cameras[0].images
    in_memory = [CameraImage.of(image.timestamp_ns, image.camera, image.rgb) for image in images]
    yield {
        **opened,
        "simulated": simulated,
        "deskewed": deskewed_scene(opened["video"]),
        "memory": Scene(
            (
                LidarSensor("top", LazyFrames.of([LidarFrame(5, LidarPoints(np.ones((4, 3), np.float32)))], [5])),
                replace(opened["png"].cameras[0], images=LazyFrames.of(in_memory, images.timestamps_ns)),
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
    found = {name: str(folder / f"{k}.pickle") for k, name in enumerate(objects)}
    for name, location in found.items():
        Path(location).write_bytes(pickle.dumps(objects[name]))
    return found


def test_scenes_of_every_kind_read_or_not_give_the_same_bits_in_another_process(scenes, locations, tmp_path):
    expected = {name: digest(scene) for name, scene in scenes.items()}
    assert len(set(expected.values())) == len(expected)
    assert scenes["jpeg.sfs"].cameras[0].images[0].encoded is not None
    fresh = {name: sceneloom.open(locations / name) for name in ("video", "raw.sfs")}
    fresh["png"] = sceneloom.open(f"local://{locations / 'png'}")  # which is fetched as it is read
    parcels = pickled(scenes | {f"fresh {name}": scene for name, scene in fresh.items()}, tmp_path)
    expected |= {f"fresh {name}": expected[name] for name in fresh}
    assert json.loads(run(parcels, "-c", IN_ANOTHER)) == expected
    # what others closed is still there for this one
    assert digest(fresh["png"]) == expected["png"]
    for scene in fresh.values():
        scene.close()


@pytest.mark.slow
def test_samples_are_the_same_in_spawned_and_forked_workers_and_as_sent_back_by_them(scenes, tmp_path):
    chosen = {name: scenes[name].samples() for name in ("video", "raw.sfs", "cut video")}
    program = tmp_path / "pools.py"
    program.write_text(POOLS)
    methods = ["spawn", "fork"] if hasattr(os, "fork") else ["spawn"]
    assert run(list(pickled(chosen, tmp_path).values()), str(program), *methods).strip() == "done 3"


@pytest.mark.parametrize("name", ["raw.sfs", "video"])
def test_closing_a_scene_closes_nothing_elsewhere_and_a_file_that_was_changed_meanwhile_is_refused(locations, name):
    scene = sceneloom.open(locations / name)
    rgb = scene.cameras[1].images[2].rgb
    elsewhere, late = (pickle.loads(pickle.dumps(scene)) for _ in range(2))
    scene.close()
    np.testing.assert_array_equal(elsewhere.cameras[1].images[2].rgb, rgb)
    elsewhere.close()
    for closed in (scene, elsewhere, pickle.loads(pickle.dumps(scene))):
        with pytest.raises(DataError, match="is closed"):
            _ = closed.cameras[1].images[2].rgb
    if name == "raw.sfs":
        with pytest.raises(DataError, match="the scene is closed"):
            elsewhere.lidars[0].frames[0]
    changed = locations / name if name == "raw.sfs" else next((locations / name).glob("data.*kv"))
    status = changed.stat()
    os.utime(changed, ns=(status.st_atime_ns, status.st_mtime_ns + 1_000_000_000))
    try:
        with pytest.raises(DataError, match=r"was changed after it was opened: .* \+1\.000 s apart"):
            _ = late.lidars[0].frames[0] if name == "raw.sfs" else late.cameras[0].images[0].rgb
    finally:
        os.utime(changed, ns=(status.st_atime_ns, status.st_mtime_ns))


def test_a_file_that_was_removed_meanwhile_is_named_and_a_sample_needs_none(locations, tmp_path):
    shutil.copy(locations / "raw.sfs", tmp_path / "gone.sfs")
    with sceneloom.open(tmp_path / "gone.sfs") as scene:
        sample = scene.samples()[2]
        expected, parcels = sample.arrays(), (pickle.dumps(scene), pickle.dumps(sample))
        (tmp_path / "gone.sfs").unlink()
        assert len(scene.lidars[0].frames[0].points)
    with pytest.raises(DataError, match=r"gone\.sfs.*cannot be opened again"):
        pickle.loads(parcels[0]).lidars[0].frames[0]
    found = pickle.loads(parcels[1]).arrays()
    assert list(found) == list(expected)
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array)


def test_a_scene_of_a_file_is_small_when_pickled_and_one_in_memory_takes_its_arrays_which_refuse_writing(
    scenes, tmp_path
):
    """What is pickled are timestamps, poses and tables; points and pixels stay in the file."""
    for name in ("video", "png", "raw.sfs", "fused.sfs"):
        scene = scenes[name]
        points = sum(frame.points.positions.nbytes for lidar in scene.lidars for frame in lidar.frames)
        pixels = sum(image.rgb.nbytes for camera in scene.cameras for image in camera.images)
        assert len(pickle.dumps(scene)) < (points + pixels) / 2, name
    assert len(pickle.dumps(scenes["memory"])) > 5 * 96 * 64 * 3
    camera = pickle.loads(pickle.dumps(scenes["video"])).cameras[0]
    in_memory = pickle.loads(pickle.dumps(scenes["memory"])).cameras[0].images[0].rgb
    for array in (camera.poses.positions, camera.mount.rotation, camera.images.timestamps_ns, in_memory):
        assert not array.flags.writeable
    # a map of a file stays in it, and one in memory goes along
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


def test_a_video_takes_its_list_of_images_or_its_bytes_along(locations, monkeypatch):
    path = next((locations / "video").glob("data.*kv"))
    content, folder = path.read_bytes(), PngFolder(locations / "png" / "frames1")
    for source in (content, bytearray(content), memoryview(content)):
        video = open_video(source)
        np.testing.assert_array_equal(pickle.loads(pickle.dumps(video)).rgb(4), video.rgb(4))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(folder)).rgb(2), folder.rgb(2))
    video, scene = open_video(path), sceneloom.open(locations / "raw.sfs")
    rgb = video.rgb(3), scene.cameras[1].images[3].rgb
    parcel = pickle.dumps(pickle.loads(pickle.dumps(scene)))
    monkeypatch.setattr("sceneloom.formats.video.reader.read_index", lambda *_: pytest.fail("walked through again"))
    again = pickle.loads(pickle.dumps(video))
    assert again.count == 5
    np.testing.assert_array_equal(again.rgb(3), rgb[0])
    np.testing.assert_array_equal(pickle.loads(parcel).cameras[1].images[3].rgb, rgb[1])


def refuse():
    raise DataError("drive", "image 0", "is torn")


def test_a_worker_that_goes_forward_seeks_in_each_video_once_and_a_damaged_image_says_so_when_it_is_read(
    scenes, monkeypatch
):
    samples = pickle.loads(pickle.dumps(scenes["video"].samples()))
    sought, seek = [], VideoReader._seek
    monkeypatch.setattr(VideoReader, "_seek", lambda reader, k: sought.append((reader.name, k)) or seek(reader, k))
    for sample in samples:
        assert all(image.rgb.any() for image in sample.images.values())
    assert [k for _, k in sought] == [0, 0]
    assert len({name for name, _ in sought}) == 2
    damaged = replace(samples[0].images["camera0"], decode=refuse)
    again = pickle.loads(pickle.dumps(replace(samples[0], images={"camera0": damaged})))
    with pytest.raises(DataError, match="is torn"):
        _ = again.images["camera0"].rgb
