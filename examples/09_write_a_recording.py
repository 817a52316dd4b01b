"""Write a drive as a recording: a folder of JSON lines, videos, lidar files and a calibration.

A street is simulated with a pair of cameras side by side, a lidar, an IMU and a satellite receiver. What the folder
cannot hold stands in the loss report; then it opens like any other drive, with the same numbers to the bit.
`sceneloom convert SCENE FOLDER` does the same from a file, and `sceneloom validate FOLDER` looks for mistakes.

    python examples/09_write_a_recording.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.simulate import CameraSpec, ImuSpec, LidarSpec, PathSpec, Stop, camera_mount

CAMERA_MODEL = Camera("pinhole", 160, 96, 100.0, 100.0, 79.5, 47.5)
PAIR = [CameraSpec(CAMERA_MODEL, camera_mount(position=(1.5, y, 1.5))) for y in (0.25, -0.25)]

if __name__ == "__main__":
    where = Path(sys.argv[1] if len(sys.argv) > 1 else "stereo_drive")
    drive = sceneloom.simulate_street(
        5,
        frames=10,
        lidar=LidarSpec(beams=16, steps=360),
        cameras=PAIR,
        imu=ImuSpec(rate_hz=200.0),
        # visual-inertial software wants to begin at rest
        path=PathSpec(stops=(Stop(0.0, 0.4),)),
    ).scene
    # FFV1 keeps every pixel; "copy", the default, encodes H.264 where a camera has no video of its own
    for loss in sceneloom.write(drive, where, format="recording", overwrite=True, images="ffv1"):
        print(f"{loss.field}: {loss.what}")

    with sceneloom.open(where) as scene:
        print("sensors:", ", ".join(f"{sensor.id} ({sensor.type})" for sensor in scene.sensors))
        pairs = zip(drive.cameras[0].images, scene.cameras[0].images, strict=True)
        print("images equal:", all(np.array_equal(a.rgb, b.rgb) for a, b in pairs))
        sweeps = zip(drive.lidars[0].frames, scene.lidars[0].frames, strict=True)
        print("points equal:", all(np.array_equal(a.points.positions, b.points.positions) for a, b in sweeps))
    lines = (where / "data.jsonl").read_text("utf-8").splitlines()
    print(f"{len(lines)} lines; the one of the first images:")
    print(next(line for line in lines if "frames" in line))
