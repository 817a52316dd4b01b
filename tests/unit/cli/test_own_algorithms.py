"""Algorithms that are plain functions, or functions of a file, without any package around them."""

import pickle
from dataclasses import fields, replace

import numpy as np
import pytest

import sceneloom
from sceneloom.colouring import fuse_by_projection
from sceneloom.errors import ArrayError, OptionError
from sceneloom.fusion import FusionConfiguration
from sceneloom.fusion.algorithms import FusionType, algorithm, chosen_algorithm
from sceneloom.pipeline.tracking import TrackingSettings

FILE = """
from dataclasses import replace
import numpy as np
import helper_beside
from sceneloom.colouring import fuse_by_projection

def red(points_world, requests, visibility, *, trajectory=None):
    found = fuse_by_projection(points_world, requests, visibility, trajectory=trajectory)
    seen = found.camera_index < 255
    return replace(found, colors=np.where(seen[:, None], helper_beside.RED, found.colors))

def short(points_world):
    return None

def boxes(pair):
    return None

number = 7
"""


@pytest.fixture(scope="module")
def drive():
    return sceneloom.simulate_street(3, frames=2).scene


@pytest.fixture
def file(tmp_path):
    (tmp_path / "helper_beside.py").write_text("import numpy\nRED = numpy.uint8([255, 0, 0])\n", "utf-8")
    path = tmp_path / "mine.py"
    path.write_text(FILE, "utf-8")
    return path


def green(points_world, requests, visibility, *, trajectory=None):
    found = fuse_by_projection(points_world, requests, visibility, trajectory=trajectory)
    colors = found.colors.copy()
    colors[found.camera_index < 255] = [0, 255, 0]
    return replace(found, colors=colors)


def colours_of(path):
    with sceneloom.open(path) as scene:
        points = [frame.points for lidar in scene.lidars for frame in lidar.frames]
        return np.unique(np.concatenate([p.colors[p.camera_index < 255] for p in points]), axis=0).tolist()


def test_a_function_fuses(drive, tmp_path):
    report = sceneloom.fuse(drive, tmp_path / "a.sfs", algorithm=green)
    assert report.fused == 2
    assert report.coloured_percent > 0
    assert colours_of(tmp_path / "a.sfs") == [[0, 255, 0]]


def test_a_function_of_a_file_fuses(drive, tmp_path, file):
    sceneloom.fuse(drive, tmp_path / "a.sfs", algorithm=f"{file}:red")
    assert colours_of(tmp_path / "a.sfs") == [[255, 0, 0]]
    configuration = FusionConfiguration(fusion_algorithm=f"{file}:red")
    found = list(sceneloom.iter_fused(drive, configuration=configuration))
    assert len(found) == 2
    assert {tuple(c) for c in found[0].points.colors[found[0].points.camera_index < 255].tolist()} == {
        (255, 0, 0)
    }


def test_a_function_of_a_file_is_found_by_other_processes(file):
    chosen = chosen_algorithm(FusionType.SENSOR_DATA, f"{file}:red")
    assert pickle.loads(pickle.dumps(chosen)) == chosen


def test_the_command_line_takes_a_function_of_a_file(call, recording, tmp_path, file):
    done = call("fuse", recording, "-o", tmp_path / "a.sfs", "--algorithm", f"{file}:red", "--quiet")
    assert (done.code, done.err) == (0, "")
    assert colours_of(tmp_path / "a.sfs") == [[255, 0, 0]]


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ("{file}:nothing", r"no function 'nothing' in the file; it has boxes, red, short"),
        ("{file}:number", "number is a int; expected a function"),
        ("{file}:short", r"expected a function \(points_world, requests, visibility, \*, trajectory=None\)"),
        ("{file}x/none.py:red", "no such file; expected FILE.py:FUNCTION"),
        ("{broken}:red", "it cannot be loaded: ZeroDivisionError: division by zero"),
        ("{leaving}:red", "it cannot be loaded: SystemExit: 3"),
        ("{file}", "no function is named; expected FILE.py:FUNCTION"),
        ("{file}:", "no function is named; expected FILE.py:FUNCTION"),
    ],
)
def test_what_cannot_be_an_algorithm_is_named_as_bad_usage(call, recording, tmp_path, file, chosen, message):
    broken, leaving = tmp_path / "broken.py", tmp_path / "leaving.py"
    broken.write_text("1 / 0\n", "utf-8")
    leaving.write_text("raise SystemExit(3)\n", "utf-8")
    stated = chosen.format(file=file, broken=broken, leaving=leaving)
    done = call("fuse", recording, "-o", tmp_path / "a.sfs", "--algorithm", stated)
    assert done.code == 2
    assert "Traceback" not in done.err
    with pytest.raises(OptionError, match=message):
        algorithm(FusionType.SENSOR_DATA, chosen_algorithm(FusionType.SENSOR_DATA, stated))


def raising(points_world, requests, visibility, *, trajectory=None):
    return points_world["no such"]


def returning(value):
    def function(points_world, requests, visibility, *, trajectory=None):
        return value

    return function


def shortened(points_world, requests, visibility, *, trajectory=None):
    found = fuse_by_projection(points_world, requests, visibility, trajectory=trajectory)
    return replace(found, colors=found.colors[1:])


def without_views(points_world, requests, visibility, *, trajectory=None):
    return replace(fuse_by_projection(points_world, requests, visibility, trajectory=trajectory), views=())


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (raising, OptionError, r"algorithm raising: IndexError: .*test_own_algorithms.py, line \d+"),
        (returning(None), OptionError, "returned a NoneType; expected sceneloom.colouring.ColouredPoints"),
        (shortened, ArrayError, r"algorithm shortened: colors"),
        (without_views, OptionError, r"0 views of \d images; expected one of each"),
        (7, OptionError, "algorithm 7: a int; expected a function"),
        (lambda points: None, OptionError, "expected a function"),
    ],
)
def test_a_function_that_does_not_do_its_part_is_named(drive, tmp_path, function, error, message):
    with pytest.raises(error, match=message):
        sceneloom.fuse(drive, tmp_path / "a.sfs", algorithm=function)
    assert not (tmp_path / "a.sfs").exists()


def test_detection_fusion_takes_functions_of_one_pair():
    chosen = chosen_algorithm(FusionType.DETECTIONS, lambda pair: None)
    with pytest.raises(OptionError, match=r"returned a NoneType; expected sceneloom.detections.FusedBoxes"):
        chosen(None)
    with pytest.raises(OptionError, match=r"expected a function \(pair\)"):
        chosen_algorithm(FusionType.DETECTIONS, lambda: None)
    assert "algorithm" in {field.name for field in fields(TrackingSettings)}


def test_a_client_of_the_service_cannot_have_a_file_executed(tmp_path, file):
    from sceneloom.db34t.interface import FusionInterface

    marker = tmp_path / "executed"
    file.write_text(f"open({str(marker)!r}, 'w')\n", "utf-8")
    with FusionInterface(inline=True) as interface:
        assert not interface.set_property("fusion_algorithm", f"{file}:red")
    assert not marker.exists()
