"""The kernels that jobs need are named rightly, and no job on a simple drive meets another one."""

import subprocess
import sys
from dataclasses import replace
from importlib import import_module

import pytest

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.kernels import cache
from sceneloom.pipeline import warm_up
from sceneloom.simulate import CameraSpec, simulate_street


@pytest.mark.parametrize("job", ["fuse", "depth", "colour", "demo", "calibrate"])
def test_all_kernels_that_a_job_names_are_there(job, monkeypatch):
    asked = []
    monkeypatch.setattr(warm_up, "compile_ahead", asked.extend)
    models = ("brown_conrady", "kannala_brandt18", "fisheye")
    cameras = tuple(CameraSpec(Camera(model, 96, 64, 60.0, 60.0, 47.5, 31.5)) for model in models)
    warm_up.compile_for(job, simulate_street(1, frames=2, cameras=cameras).scene)
    assert len(asked) == len(set(asked)) > 15
    for name in asked:
        import_module(name.split(":")[0])
        assert name in cache.declared_kernels()


@pytest.mark.parametrize("job", ["detections", "track"])
def test_all_kernels_for_boxes_are_there(job, monkeypatch):
    asked = []
    monkeypatch.setattr(warm_up, "compile_ahead", asked.extend)
    warm_up.compile_for_boxes(job)
    for name in asked:
        import_module(name.split(":")[0])
    assert len(asked) == len(set(asked)) > 15
    assert set(asked) <= set(cache.declared_kernels())


def test_a_camera_of_an_unknown_model_is_left_to_the_job_that_refuses_it(monkeypatch):
    asked = []
    monkeypatch.setattr(warm_up, "compile_ahead", asked.extend)
    scene = simulate_street(1, frames=2).scene
    cameras = {camera.id: replace(camera, camera=replace(camera.camera, model="own")) for camera in scene.cameras}
    warm_up.compile_for("fuse", replace(scene, sensors=tuple(cameras.get(s.id, s) for s in scene.sensors)))
    assert cameras
    assert not [name for name in asked if "cameras" in name]


PROGRAM = """
import sys
from sceneloom.cli.main import main
from sceneloom.kernels import cache
from sceneloom.pipeline import warm_up
asked, met = [], []
warm_up.compile_ahead = asked.extend
cache._is_kept = lambda function: False
with cache.reporting_compiling(lambda name, _: met.append(name)):
    try:
        main(sys.argv[1:])
    except SystemExit:
        pass
print([name for name in met if name not in asked], len(met) > 1, file=sys.stderr)
"""


def kernels_not_asked_for(*arguments):
    """What a verb says at its end: kernels that it met and had not asked for, and whether it met any."""
    command = [sys.executable, "-c", PROGRAM, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stderr.splitlines()[-1]


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    camera = CameraSpec(Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5))
    folder = tmp_path_factory.mktemp("warm") / "drive"
    sceneloom.write(simulate_street(1, frames=3, cameras=(camera,)).scene, folder)
    return folder


@pytest.mark.parametrize("verb", ["fuse", "colour", "calibrate", "edit deskew"])
def test_a_verb_meets_no_kernel_that_was_not_asked_for(verb, drive, tmp_path):
    output = () if verb == "calibrate" else ("-o", tmp_path / ("map.ply" if verb == "colour" else "drive.sfs"))
    assert kernels_not_asked_for(*verb.split(), drive, "--quiet", *output) == "[] True"


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["track", "fuse --type detection"])
def test_fusing_and_tracking_boxes_meets_no_kernel_that_was_not_asked_for(verb, data_dir, tmp_path):
    folder = data_dir / "real" / "kitti_tracking"
    words = (*verb.split(), folder, "--sequence", "0000", "--quiet", "-o", tmp_path / "objects")
    assert kernels_not_asked_for(*words) == "[] True"
