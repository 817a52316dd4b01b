"""The kernels that jobs need are named rightly, and no job on a simple drive meets another one."""

import subprocess
import sys
from dataclasses import replace
from importlib import import_module

import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.kernels import cache
from sceneloom.pipeline import warm_up
from sceneloom.simulate import CameraSpec, simulate_street


@pytest.mark.parametrize("job", ["fuse", "depth", "colour", "demo"])
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
from sceneloom.kernels import cache
from sceneloom.pipeline import warm_up
asked, met = [], []
warm_up.compile_ahead = asked.extend
cache._is_kept = lambda function: False
import sceneloom
with cache.reporting_compiling(lambda name, _: met.append(name)), sceneloom.open(sys.argv[1]) as scene:
    warm_up.compile_for("fuse", scene)
    sceneloom.fuse(scene, sys.argv[2])
print([name for name in met if name not in asked])
"""


def test_fusing_meets_no_kernel_that_was_not_asked_for(tmp_path):
    import sceneloom

    camera = CameraSpec(Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5))
    sceneloom.write(simulate_street(1, frames=2, cameras=(camera,)).scene, tmp_path / "drive")
    command = [sys.executable, "-c", PROGRAM, str(tmp_path / "drive"), str(tmp_path / "drive.sfs")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
