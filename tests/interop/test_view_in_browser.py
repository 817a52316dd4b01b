"""The viewer's page in a real browser: it shows cloud and image, and nothing leaves the machine."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import CameraImage, CameraSensor, LazyFrames, LidarFrame, LidarPoints, LidarSensor, Scene

pytestmark = pytest.mark.slow
pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install 'sceneloom[view]'")

SCRIPT = Path(__file__).with_name("view_in_browser.js")
LIMIT_S = 240
IMAGE, CLOUD = (250, 20, 240), (30, 250, 20)
"""Colours of what is shown, which nothing of the page itself has."""
CLOSE = 60
"""An image is a JPEG file, and points have smooth borders."""

ENOUGH = 500
"""Pixels of a colour that are something to see."""


def wall_and_camera() -> Scene:
    """A wall of points ahead of the ego, and a camera that sees one colour."""
    across, up = np.meshgrid(np.linspace(-8, 8, 120), np.linspace(-2, 6, 60))
    positions = np.column_stack([np.full(across.size, 14.0), across.ravel(), up.ravel()]).astype(np.float32)
    colours = np.tile(np.array(CLOUD, np.uint8), (len(positions), 1))
    times = [0, 100_000_000]
    sweeps = [LidarFrame(t, LidarPoints(positions, colors=colours)) for t in times]
    camera_model = Camera("pinhole", 320, 240, 200.0, 200.0, 159.5, 119.5)
    rgb = np.tile(np.array(IMAGE, np.uint8), (240, 320, 1))
    ahead = RigidTransform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
    images = LazyFrames.of([CameraImage.of(t, camera_model, rgb) for t in times], times)
    return Scene(
        (
            LidarSensor("lidar", LazyFrames.of(sweeps, times), mount=RigidTransform.identity()),
            CameraSensor("camera", camera_model, images, mount=ahead),
        )
    )


def count_near(image: Path, colour: tuple[int, int, int]) -> int:
    """How many pixels of an image have about a colour."""
    rgb = np.asarray(Image.open(image).convert("RGB"), np.int64)
    return int((np.abs(rgb - np.array(colour)).max(axis=2) < CLOSE).sum())


def test_the_page_shows_cloud_and_image_and_nothing_leaves(browser, tmp_path):
    drive, seen = tmp_path / "drive.sfs", tmp_path / "seen.png"
    sceneloom.write(wall_and_camera(), drive)
    program, modules = browser
    home = tmp_path / "home"
    home.mkdir()
    words = [sys.executable, "-m", "sceneloom", "view", str(drive), "--web", "--no-findings"]
    environment = {**os.environ, "HOME": str(home)}
    viewer = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, env=environment)
    try:
        address = re.search(r"http://127\.0\.0\.1\S+", viewer.stderr.readline())
        assert address is not None
        look = ["node", str(SCRIPT), program, f"{address[0]}&renderer=webgl", str(seen), str(LIMIT_S)]
        reported, shown = "", (0, 0)
        environment = {**os.environ, "NODE_PATH": modules}
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": environment}
        with subprocess.Popen(look, **pipes) as page:
            for line in page.stdout:
                reported = line
                if line == "image\n":
                    shown = count_near(seen, IMAGE), count_near(seen, CLOUD)
                if min(shown) > ENOUGH and not page.stdin.closed:
                    page.stdin.write("enough\n")
                    page.stdin.close()
    finally:
        viewer.terminate()
        viewer.wait(timeout=30)
        viewer.stderr.close()
    assert min(shown) > ENOUGH, shown
    traffic = json.loads(reported)
    assert set(traffic["answered"]) == {"127.0.0.1"}
    assert list(home.iterdir()) == []
