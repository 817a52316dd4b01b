"""The command line, called in the process, and a small recording to call it on."""

import json
from collections.abc import Callable
from dataclasses import dataclass

import click
import pytest

import sceneloom
from sceneloom.batch.running import run_task
from sceneloom.cameras.camera import Camera
from sceneloom.cli import main
from sceneloom.db34t.json import format_json
from sceneloom.db34t.scene_objects import boxes_2d_record, boxes_3d_record
from sceneloom.simulate import CameraSpec, LidarSpec, detect_2d, detect_3d, simulate_street

SMALL = Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5)


def small_drive(camera=SMALL, *, seed=1, frames=3):
    """A street seen by a coarse lidar and one camera."""
    return simulate_street(seed, frames=frames, lidar=LidarSpec(beams=8, steps=90), cameras=(CameraSpec(camera),))


@dataclass(frozen=True)
class Outcome:
    """What a call gave."""

    code: int
    out: str
    err: str


Call = Callable[..., Outcome]


@pytest.fixture
def call(capsys):
    """Call `sceneloom` with arguments, of which the first may be several words."""

    def run(*arguments):
        first, *others = map(str, arguments)
        with pytest.raises(SystemExit) as stop:
            main([*first.split(), *others])
        out, err = capsys.readouterr()
        return Outcome(int(stop.value.code or 0), out, err)

    return run


@pytest.fixture
def succeeds(call):
    """Call `sceneloom` with arguments, which has to end well."""

    def run(*arguments):
        outcome = call(*arguments)
        assert outcome.code == 0, outcome.err
        return outcome

    return run


@pytest.fixture
def reported(succeeds):
    """What `sceneloom` reports to machines when it is called with arguments."""
    return lambda *arguments: json.loads(succeeds(*arguments, "--json").out)


@pytest.fixture
def refuses(call):
    """Call `sceneloom` with arguments, which has to end with a code and an error that holds a text."""

    def run(code, text, *arguments):
        outcome = call(*arguments)
        assert (outcome.code, text in outcome.err) == (code, True), outcome
        return outcome

    return run


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """Three sweeps of a coarse lidar and one small camera, as PNG images."""
    folder = tmp_path_factory.mktemp("recordings") / "drive"
    sceneloom.write(small_drive().scene, folder, images="png")
    return folder


@pytest.fixture
def inline(monkeypatch):
    """Workers in this process, which need not be started."""

    class Inline:
        def __init__(self, *_):
            self.ended = []

        @property
        def free(self):
            return 1 - len(self.ended)

        def submit(self, task):
            self.ended.append((task, run_task(task)))

        def finished(self, _):
            ended, self.ended = self.ended, []
            return ended

        def stop(self):
            self.ended.clear()

    monkeypatch.setattr("sceneloom.batch.running.ProcessPool", Inline)


def write_boxes(drive, folder):
    """Write what detectors report of a simulated drive as records; the file of boxes in space, that of its images."""
    files = folder / "boxes3d.jsonl", folder / "boxes2d.jsonl"
    found = ((detect_3d(drive), boxes_3d_record), (detect_2d(drive), boxes_2d_record))
    for path, (reports, record) in zip(files, found, strict=True):
        path.write_text("\n".join(format_json(record(r.boxes, sensor_id=0, seq=k)) for k, r in enumerate(reports)))
    return files


def commands(command, words=()):
    """Every command from one on, groups too: its name, with those of its groups, and itself."""
    yield " ".join(words), command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            assert found is not None, name
            yield from commands(found, (*words, name))


def verbs(command):
    """Every verb below a group."""
    return [(name, found) for name, found in commands(command) if not isinstance(found, click.Group)]
