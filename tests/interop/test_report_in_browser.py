"""The page about a drive in a real browser: nothing it complains of, nothing that leaves, all of it readable."""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.report import ReportSettings, write_report
from sceneloom.scene import DataWarning, LazyFrames, LidarFrame, LidarPoints, LidarSensor, Scene, WarningKind
from sceneloom.simulate import CameraSpec, Faults, LidarSpec, SensorFaults, simulate_street

SCRIPT = Path(__file__).with_name("report_in_browser.js")
LIMIT_S = 240
EVIL = "<img src=x onerror=alert(1)><script>alert(2)</script>"


def evil() -> Scene:
    """A scene whose every name is markup."""
    points = LidarPoints(np.random.default_rng(0).normal(0, 10, (50, 3)).astype(np.float32))
    frames = LazyFrames.of([LidarFrame(t, points) for t in (0, 10**8)], [0, 10**8])
    warning = DataWarning(kind=WarningKind.ASSUMED, code="x", location=EVIL, message=EVIL)
    return Scene((LidarSensor(EVIL, frames),), source=EVIL, format=EVIL, warnings=(warning,), metadata={EVIL: EVIL})


@pytest.fixture(scope="module")
def seen(browser, tmp_path_factory):
    """What the browser says of three pages: a drive with gaps, a scene of nothing, one of hostile names."""
    folder = tmp_path_factory.mktemp("pages")
    camera = CameraSpec(Camera("pinhole", 192, 128, 120.0, 120.0, 95.5, 63.5))
    faults = Faults({"camera0": SensorFaults(lost_frames=(3, 4, 9))})
    lidar = LidarSpec(beams=16, steps=180)
    drive = simulate_street(1, frames=14, lidar=lidar, cameras=(camera,), faults=faults)
    scenes = {"drive": drive.scene, "empty": Scene(()), "evil": evil()}
    pages = []
    for name, scene in scenes.items():
        pages.append(str(folder / f"{name}.html"))
        write_report(scene, pages[-1], settings=ReportSettings(quick=True))
    program, modules = browser
    command, environment = ["node", str(SCRIPT), program, str(folder), *pages], {**os.environ, "NODE_PATH": modules}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("page", ["drive.html", "empty.html", "evil.html"])
def test_nothing_leaves_and_it_fits_a_phone_and_a_screen_with_contrast_in_the_light_and_in_the_dark(seen, page):
    found = seen[page]
    assert (found["messages"], found["dialogs"]) == ([], [])  # nothing to complain of
    # the page itself, once for each view
    assert len(found["requests"]) == len(found["views"])
    assert all(request.startswith("file:") and request.endswith(page) for request in found["requests"])
    for view in found["views"]:
        where = view["width"], view["scheme"]
        assert view["overflow"] <= 0, where
        assert (view["unseen"], view["faint"]) == (0, []), where
        assert {"Verdict", "Timing and gaps", "Coverage", "Provenance"} <= set(view["headings"])
    light, dark = (v["background"] for v in found["views"][:2])
    assert (light, dark) == ("rgb(255, 255, 255)", "rgb(20, 22, 26)")


def test_images_plots_and_texts_are_there_and_it_can_be_used_by_keyboard_and_printed(seen):
    found = seen["drive.html"]
    view, keyboard = found["views"][0], found["keyboard"]
    assert view["images"] >= 4
    assert view["plots"] >= 8
    assert view["texts"] > 200
    assert (keyboard["first"], bool(keyboard["opened"])) == ("skip", True)
    assert {"A", "SUMMARY"} <= set(keyboard["reached"])
    assert found["printed"] > 10_000
    assert found["printedOverflow"] <= 0  # on the width of A4
    assert found["printedBackground"] == "rgb(255, 255, 255)"
