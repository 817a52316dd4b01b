"""A sound recording, changed by each test in one thing, and what rules state about it."""

import json
import pickle
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sceneloom.checks import validate
from sceneloom.warnings import Finding

Line = dict[str, Any]
SPAN = 12.0


class SoundLines:
    """Lines of a drive in which no rule over lines finds anything; streams by name, each as lines in order of time."""

    def __init__(self) -> None:
        self._random = np.random.default_rng(7)
        self.streams: dict[str, list[Line]] = {
            "accelerometer": self._sensor("accelerometer", 100.0, [0.1, -0.2, 9.81], 0.05),
            "gyroscope": self._sensor("gyroscope", 100.0, [0.0, 0.01, 0.1], 0.01),
            "magnetometer": self._sensor("magnetometer", 20.0, [20.0, 5.0, -43.0], 0.5),
            "barometer": self._sensor("barometer", 20.0, [1013.25], 0.02),
            "imuTemperature": self._sensor("imuTemperature", 5.0, [305.0], 0.0),
            "gps": [self.fix(t, 8.0 * t) for t in self.times(5.0)],
            "groundTruth": [self.pose(t, 8.0 * t) for t in self.times(20.0)],
            "frames": [
                {"frames": [{"cameraInd": 0}], "number": k, "time": t} for k, t in enumerate(self.times(10.0, 0.0037))
            ],
        }

    def times(self, rate: float, shift: float = 0.0) -> list[float]:
        return [round(1.0 + shift + k / rate, 9) for k in range(int(SPAN * rate))]

    def _sensor(self, name: str, rate: float, mean: list[float], noise: float) -> list[Line]:
        times = self.times(rate)
        values = np.array(mean) + noise * self._random.standard_normal((len(times), len(mean)))
        return [self.sample(name, t, row) for t, row in zip(times, values.tolist(), strict=True)]

    def sample(self, name: str, time: float, values: list[float]) -> Line:
        return {"sensor": {"type": name, "values": values}, "time": time}

    def fix(self, time: float, north: float = 0.0, **fields: Any) -> Line:
        """A fix so many metres north of Helsinki, with half a metre of noise."""
        noise = 0.5 * self._random.standard_normal() if not fields else 0.0
        location = {"latitude": 60.17 + (north + noise) / 111_400.0, "longitude": 24.94, "altitude": 14.0}
        return {"gps": {**location, "accuracy": 0.5, **fields}, "time": time}

    def pose(self, time: float, east: float) -> Line:
        rotation = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
        return {"groundTruth": {"position": {"x": east, "y": 0.0, "z": 0.0}, "orientation": rotation}, "time": time}

    def shifted(self, name: str, seconds: float) -> "SoundLines":
        self.streams[name] = [{**line, "time": line["time"] + seconds} for line in self.streams[name]]
        return self

    def scaled(self, name: str, factor: float, rows: slice = slice(None)) -> "SoundLines":
        for line in self.streams[name][rows]:
            line["sensor"] = {**line["sensor"], "values": [v * factor for v in line["sensor"]["values"]]}
        return self

    def copy(self) -> "SoundLines":
        return pickle.loads(pickle.dumps(self))  # type: ignore[no-any-return]

    def lines(self) -> list[Line]:
        every = [line for stream in self.streams.values() for line in stream]
        return sorted(every, key=lambda line: line["time"])


@pytest.fixture(scope="session")
def sound_lines() -> SoundLines:
    return SoundLines()


@pytest.fixture
def drive(sound_lines: SoundLines) -> SoundLines:
    return sound_lines.copy()


Write = Callable[..., Path]


@pytest.fixture
def written(tmp_path: Path) -> Write:
    """Write lines, or a drive's, as the log of a folder."""

    def write(lines: SoundLines | Iterable[Line | str]) -> Path:
        listed = lines.lines() if isinstance(lines, SoundLines) else lines
        texts = [line if isinstance(line, str) else json.dumps(line) for line in listed]
        (tmp_path / "data.jsonl").write_text("".join(text + "\n" for text in texts))
        (tmp_path / "calibration.json").write_text('{"cameras": []}')
        return tmp_path

    return write


class Check:
    """Compare what rules find in a drive with what is expected; `findings` are of these rules alone."""

    def __init__(self, written: Write) -> None:
        self._written = written

    def findings(self, drive: SoundLines | Iterable[Line | str], rules: str) -> tuple[Finding, ...]:
        return validate(self._written(drive), rules=rules.split()).findings

    def __call__(self, drive: SoundLines | Iterable[Line | str], rules: str, *expected: Any) -> tuple[Finding, ...]:
        """`expected`: rule, line or stream (None: wherever), part of the message, and count where that is given."""
        found = self.findings(drive, " ".join({*rules.split(), *(rule for rule, *_ in expected)}))
        assert [finding.rule for finding in found] == [rule for rule, *_ in expected]
        folder = self._written(drive)
        for finding, (_, where, words, *count) in zip(found, expected, strict=True):
            location = line_of(folder, where) if isinstance(where, dict) else f"data.jsonl: {where}"
            assert where is None or finding.path == location
            assert words in finding.message
            assert count in ([], [finding.count])
        return found


@pytest.fixture
def check(written: Write) -> Check:
    return Check(written)


def line_of(folder: Path, line: Line) -> str:
    """The location of a line, by counting."""
    texts = (folder / "data.jsonl").read_text().splitlines()
    return f"data.jsonl: line {texts.index(json.dumps(line)) + 1}"
