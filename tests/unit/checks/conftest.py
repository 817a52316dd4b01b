"""A sound scene, changed by each test in one thing, and what rules state about it."""

import re
from collections.abc import Callable
from io import BytesIO
from typing import Any

import numpy as np
import pytest

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.checks import Rule, all_rules, validate
from sceneloom.formats.video.writer import VideoWriter

SECOND = 1_000_000_000
PERIOD = SECOND // 10
PARTS = {"a": "annotations", "s": "sensors"}
CAMERA_MODEL = Camera("pinhole", 32, 24, 30.0, 30.0, 15.5, 11.5)


def film(width: int, height: int, *times_s: float) -> bytes:
    """A video of black images."""
    content = BytesIO()
    with VideoWriter(content, width, height, fps=10) as writer:
        for time_s in times_s:
            writer.add(np.zeros((height, width, 3), np.uint8), time_s)
    return content.getvalue()


class Sound:
    """Parts of a scene in which no rule finds anything; each takes what is to be different."""

    def times(self, count: int = 6) -> np.ndarray:
        return np.arange(count, dtype=np.int64) * PERIOD

    def path(self, timestamps_ns: Any = None, **fields: Any) -> sc.Poses:
        """A straight trajectory at 5 m/s."""
        times = self.times() if timestamps_ns is None else np.asarray(timestamps_ns, np.int64)
        positions = np.column_stack([5.0 * times / SECOND, np.zeros(len(times)), np.zeros(len(times))])
        given = {"positions": positions, "quaternions_xyzw": np.tile([0.0, 0, 0, 1], (len(times), 1))}
        return sc.Poses(times, **{**given, **fields})

    def sweep(self, timestamp_ns: int, **fields: Any) -> sc.LidarFrame:
        """100 points around the sensor, measured over the sweep."""
        angles = np.linspace(0, 6, 100)
        radius = 10 + np.sin(timestamp_ns / SECOND)
        positions = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.zeros(100)])
        given = {
            "positions": positions.astype(np.float32),
            "intensities": np.arange(100, dtype=np.uint8),
            "timestamps_ns": timestamp_ns + np.linspace(0, 0.9 * PERIOD, 100).astype(np.int64),
        }
        return sc.LidarFrame(timestamp_ns, sc.LidarPoints(**{**given, **fields}))

    def lidar(self, timestamps_ns: Any = None, *, sweep: Any = None, **fields: Any) -> sc.LidarSensor:
        """A lidar, its points in its own frame."""
        times = self.times() if timestamps_ns is None else np.asarray(timestamps_ns, np.int64)
        frames = sc.LazyFrames.of([(sweep or self.sweep)(int(t)) for t in times], times)
        given = {"poses": self.path(), "points_frame": sc.PointsFrame.SENSOR}
        return sc.LidarSensor(**{"id": "top", "frames": frames, **given, **fields})

    def camera(
        self, timestamps_ns: Any = None, *, camera_model: Camera = CAMERA_MODEL, **fields: Any
    ) -> sc.CameraSensor:
        times = self.times() if timestamps_ns is None else np.asarray(timestamps_ns, np.int64)
        rng = np.random.default_rng(0)
        noise = rng.integers(0, 255, (len(times), camera_model.height, camera_model.width, 3), np.uint8)
        shots = [sc.CameraImage.of(int(t), camera_model, rgb) for t, rgb in zip(times, noise, strict=True)]
        images = sc.LazyFrames.of(shots, times)
        # z forward, y down
        poses = self.path(quaternions_xyzw=np.tile([-0.5, 0.5, -0.5, 0.5], (len(self.times()), 1)))
        return sc.CameraSensor(**{"id": "front", "camera": camera_model, "images": images, "poses": poses, **fields})

    def odometry(self, **fields: Any) -> sc.OdometrySensor:
        return sc.OdometrySensor(**{"id": "ego", "poses": self.path(), **fields})

    def scene(self, *parts: Any, **fields: Any) -> sc.Scene:
        """A scene of these sensors, or of a lidar and a camera, and of these annotations."""
        sensors = tuple(part for part in parts if isinstance(part, sc.Sensor))
        annotations = tuple(part for part in parts if not isinstance(part, sc.Sensor))
        return sc.Scene(sensors or (self.lidar(), self.camera()), annotations, **fields)


@pytest.fixture
def sound() -> Sound:
    return Sound()


Found = Callable[..., list[tuple[str, str]]]


@pytest.fixture
def found() -> Found:
    def run(source: Any, rule: str, **options: Any) -> list[tuple[str, str]]:
        report = validate(source, rules=[rule], **options)
        assert all(finding.rule == rule for finding in report.findings)
        return [(finding.path, finding.message) for finding in report.findings]

    return run


@pytest.fixture
def check(sound: Sound, found: Found) -> Callable[..., None]:
    """Compare what one rule finds in a scene, or in one of these sensors and annotations, with what is expected.

    That is "" for nothing, or for each finding its location, or "location: part of the message"; `s0.` stands for
    `sensors[0].` and `a0.` for `annotations[0].`.
    """

    def run(rule: str, expected: str | list[str], *parts: Any) -> None:
        scene = parts[0] if isinstance(parts[0], sc.Scene) else sound.scene(*parts)
        lines = [expected] if isinstance(expected, str) and expected else list(expected)
        lines = [re.sub(r"^([as])(\d+)\b", lambda m: f"{PARTS[m[1]]}[{m[2]}]", line) for line in lines]
        hits = found(scene, rule)
        assert [path for path, _ in hits] == [line.partition(": ")[0] for line in lines]
        for (_, message), line in zip(hits, lines, strict=True):
            assert line.partition(": ")[2] in message

    return run


@pytest.fixture
def keeps() -> Callable[[Any, tuple[Rule, ...]], bool]:
    """Whether no rule of a table finds anything in a scene."""
    return lambda source, table: validate(source, rules=[rule.id for rule in table]).findings == ()


@pytest.fixture
def fixed() -> Callable[[sc.Scene, str], sc.Scene]:
    """A scene repaired by one rule, whose fix changes nothing when it is applied again."""

    def run(scene: sc.Scene, rule: str) -> sc.Scene:
        fix = next(r.fix for r in all_rules() if r.id == rule)
        assert fix is not None
        once = fix(scene)
        again = fix(once)
        assert again is once or (again.time_offset_ns, again.sensors) == (once.time_offset_ns, once.sensors)
        return once

    return run
