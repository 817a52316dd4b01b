"""Recordings that we write are replayed by the software of the format's owner, where somebody has it.

It is proprietary and no dependency of anything here: `SCENELOOM_VENDOR_PYTHON` names a Python that has it installed.
"""

import json
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from tests.peers import python_with

from sceneloom.cameras.camera import Camera
from sceneloom.formats.recording.writer import write_recording
from sceneloom.scene import DepthCameraSensor, DepthFrame, LazyFrames
from sceneloom.simulate import CameraSpec, ImuSpec, LidarSpec, PathSpec, Stop, camera_mount, simulate_street

FRAMES = 30
REPLAY = """
import json, sys
import spectacularAI

outputs, depths = [], set()

def on_output(output):
    outputs.append(json.loads(output.asJson()))

def on_map(output):
    for key in output.updatedKeyFrames:
        frame = output.map.keyFrames.get(key)
        depth = frame and frame.frameSet.depthFrame
        if depth and depth.image:
            depths.add((round(depth.depthScale, 9), int(depth.image.toArray().max())))

replay = spectacularAI.Replay(sys.argv[1], on_map)
replay.setOutputCallback(on_output)
replay.setPlaybackSpeed(-1)
replay.runReplay()
print("RESULT" + json.dumps([outputs, sorted(depths)]))
"""


@pytest.fixture
def vendor_python():
    """A Python that has the vendor's software."""
    return python_with("the vendor's software", "SCENELOOM_VENDOR_PYTHON")


def replayed(folder, python):
    """The outputs of the vendor's software, and the scales and largest steps of depth images."""
    command = [python, "-c", REPLAY, str(folder)]
    done = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    results = [line for line in done.stdout.splitlines() if line.startswith("RESULT")]
    assert results, done.stdout
    return json.loads(results[0].removeprefix("RESULT"))


def a_drive(offsets_y):
    lens = Camera("pinhole", 320, 200, 200.0, 200.0, 159.5, 99.5)
    cameras = [CameraSpec(lens, camera_mount(position=(1.5, y, 1.5))) for y in offsets_y]
    return simulate_street(
        1,
        frames=FRAMES,
        lidar=LidarSpec(beams=4, steps=40),
        cameras=cameras,
        imu=ImuSpec(rate_hz=200.0),
        path=PathSpec(stops=(Stop(0.0, 1.0),)),
    )


@pytest.mark.parametrize("pictures", ["copy", "ffv1", "png"])
def test_a_stereo_drive_is_tracked(vendor_python, tmp_path, pictures):
    write_recording(a_drive((0.25, -0.25)).scene, tmp_path / "drive", pictures=pictures)
    outputs, _ = replayed(tmp_path / "drive", vendor_python)
    assert {output["status"] for output in outputs} == {"TRACKING"}
    # a few pictures go by before it begins
    assert len(outputs) > 0.7 * FRAMES
    stamps = [output["time"] for output in outputs]
    assert stamps == sorted(stamps)


def test_depth_images_are_understood_in_metres(vendor_python, tmp_path):
    drive = a_drive((0.25,))
    camera, truth = drive.scene.cameras[0], drive.truth.cameras["camera0"]
    stamps = camera.pictures.timestamps_ns

    def image(k):
        depths = truth.truth(k).depths
        return np.where(depths > 60.0, np.float32(0.0), depths)

    frames = LazyFrames(stamps, lambda k: DepthFrame(int(stamps[k]), camera.camera, lambda: image(k)))
    depth = DepthCameraSensor("depth", camera.camera, frames, mount=camera.mount)
    report = write_recording(replace(drive.scene, sensors=(*drive.scene.sensors, depth)), tmp_path / "drive")
    # 60 m fit into 65535 steps of 1 mm
    assert "rounded to steps of 0.001 m" in [loss.what for loss in report]
    _, depths = replayed(tmp_path / "drive", vendor_python)
    assert {scale for scale, _ in depths} == {0.001}
    largest = max(step for _, step in depths)
    assert 50_000 < largest <= 60_000
