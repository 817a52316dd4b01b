"""What an installation says of itself."""

import importlib
import importlib.metadata
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pytest
from PIL import Image

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.errors import how_to_install
from sceneloom.kernels import cache
from sceneloom.pipeline import installation, warm_up
from sceneloom.pipeline.installation import Status, examine_installation, find_packages
from sceneloom.simulate import CameraSpec, simulate_street


def findings(group):
    return {one.name: one for one in examine_installation().findings if one.group == group}


def test_this_installation_is_sound_and_packages_are_looked_for_as_the_metadata_name_them(monkeypatch, tmp_path):
    found = examine_installation()
    assert found.is_sound
    stated = {(one.group, one.name): one.stated for one in found.findings}
    assert stated["packages", "numpy"] == importlib.metadata.version("numpy")
    assert stated["versions", "Python"].startswith(f"{sys.version_info.major}.{sys.version_info.minor}.")
    assert stated["codecs", "H.264, written"] == "there"

    def require(*requirements):
        monkeypatch.setattr(installation, "requires", lambda _: requirements)

    require(*REQUIREMENTS)
    found = {one.name: one for one in find_packages()}
    assert sorted(found) == ["fsspec", "no-such-package", "numpy", "scipy"]
    assert found["numpy"].problem is None
    assert "expected 999.1 or newer" in found["scipy"].problem
    assert (found["no-such-package"].extra, found["no-such-package"].installed) == ("mcap", None)
    require(REQUIREMENTS[3])
    assert examine_installation().is_sound
    extra = findings("extras")["mcap"]
    assert (extra.status, extra.remedy) == (Status.MISSING, how_to_install("mcap"))
    require(REQUIREMENTS[1])
    assert not examine_installation().is_sound
    assert findings("packages")["scipy"].remedy == "pip uninstall scipy, then pip install 'scipy>=999.1'"
    (folder := tmp_path / "crooked-1.0.dist-info").mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: crooked\nVersion: 1.0\n")
    (tmp_path / "crooked.py").write_text("raise OSError('libcrooked.so: cannot open')")
    monkeypatch.syspath_prepend(str(tmp_path))
    require("crooked>=1")
    (broken,) = find_packages()
    assert broken.problem == "cannot be imported: libcrooked.so: cannot open"

    def absent(_):
        raise importlib.metadata.PackageNotFoundError

    monkeypatch.setattr(installation, "requires", absent)
    assert "not installed" in findings("packages")["sceneloom"].stated


REQUIREMENTS = [
    "numpy>=2.0",
    "scipy>=999.1",
    "fsspec[http]>=2024.2; extra == 'cloud'",
    "no-such-package>=1; extra == 'mcap'",
    "pytest>=8.2; extra == 'dev'",
]


def test_kernels_count_as_compiled_once_there_is_an_index_of_their_present_source(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    cold = cache.find_kernel_cache()
    assert (cold.folder, cold.compiled, cold.is_warm, cold.writable) == (tmp_path, 0, False, True)
    python = f"py{sys.version_info.major}{sys.version_info.minor}"
    (below := tmp_path / "kernels_5f3a").mkdir()
    source = Path(cache.__file__).parent / "voxels.py"
    index = below / f"voxels.number_cubes-22.{python}.nbi"
    index.write_bytes(b"of a source that was changed since")
    (below / "voxels.number_cubes-9.py27.nbi").write_bytes(cache.source_digest(source).encode())
    assert cache.find_kernel_cache().compiled == 0
    index.write_bytes(b"of" + cache.source_digest(source).encode())
    assert cache.find_kernel_cache().compiled == 1
    assert cache.find_kernel_cache().kernels == cold.kernels > 150
    asked = ["sceneloom.colouring.visibility", "sceneloom.cameras.perspective", "sceneloom.kernels.voxels"]
    others = ["sceneloom.kernels.cache", "sceneloom.cameras.camera", "numba.core", "sceneloom"]
    assert [cache.lacks_kernels(name) for name in (*asked, *others)] == [True] * 3 + [False] * 4
    # what counts is the content of a source, not its age
    for name, more in (("voxels.py", b""), ("changed.py", b"\n")):
        (tmp_path / name).write_bytes(source.read_bytes() + more)
        assert (cache.source_digest(tmp_path / name) == cache.source_digest(source)) is (not more)


KERNELS = """
from sceneloom.kernels.cache import kernel
@kernel("float64(float64)", nogil=True)
def doubled(value):
    return 2.0 * value
@kernel("float64(float64)", nogil=True)
def quadrupled(value):
    return doubled(doubled(value))
"""


def test_threads_may_call_a_kernel_for_the_first_time_at_the_same_time(monkeypatch, tmp_path):
    (tmp_path / "kernels_of_threads.py").write_text(KERNELS)
    monkeypatch.syspath_prepend(str(tmp_path))
    module = importlib.import_module("kernels_of_threads")
    start = threading.Barrier(8)

    def call(k):
        start.wait()
        return (module.doubled if k % 2 else module.quadrupled)(float(k))

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(call, range(8))) == [0.0, 2.0, 8.0, 6.0, 16.0, 10.0, 24.0, 14.0]


@pytest.mark.parametrize("usable", [False, True])
def test_a_cache_that_cannot_be_written_is_no_good(monkeypatch, tmp_path, usable):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "cache"))
    if not usable:
        monkeypatch.setattr("sceneloom.kernels.cache._can_write", lambda _: False)
    found = findings("kernels")["compiled kernels"]
    assert found.status is (Status.MISSING if usable else Status.BROKEN)
    assert "NUMBA_CACHE_DIR" in found.remedy


def test_all_kernels_that_a_job_names_are_there_and_unknown_cameras_left_to_the_job_that_refuses_them(monkeypatch):
    models = ("brown_conrady", "kannala_brandt18", "fisheye")
    cameras = tuple(CameraSpec(Camera(model, 96, 64, 60.0, 60.0, 47.5, 31.5)) for model in models)
    scene = simulate_street(1, frames=2, cameras=cameras).scene
    jobs = {job: lambda job=job: warm_up.compile_for(job, scene) for job in ("fuse", "depth", "colour")}
    jobs["calibrate"] = lambda: warm_up.compile_for("calibrate", scene)
    jobs |= {job: lambda job=job: warm_up.compile_for_boxes(job) for job in ("detections", "track")}
    for job, ask in jobs.items():
        asked = []
        monkeypatch.setattr(warm_up, "compile_ahead", asked.extend)
        ask()
        for name in asked:
            import_module(name.split(":")[0])
        assert len(asked) == len(set(asked)) > 15, job
        assert set(asked) <= set(cache.declared_kernels()), job
    asked = []
    monkeypatch.setattr(warm_up, "compile_ahead", asked.extend)
    own = tuple(replace(s, camera=replace(s.camera, model="own")) for s in scene.cameras)
    warm_up.compile_for("fuse", replace(scene, sensors=(*scene.lidars, *own)))
    assert len(own) == 3
    assert not [name for name in asked if "cameras" in name]


PROGRAM = """
import sys
from contextlib import contextmanager
from sceneloom.cli.main import main
from sceneloom.kernels import cache
from sceneloom.pipeline import warm_up
asked, met = [], []
warm_up.compile_ahead = asked.extend
warm_up.compiling_ahead = contextmanager(lambda names: (yield asked.extend(names) or id))
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


def test_the_demo_meets_no_kernel_that_was_not_asked_for_and_shows_an_image_first(tmp_path):
    assert kernels_not_asked_for("demo", "--frames", "2", "--keep", tmp_path, "--quiet") == "[] True"
    with Image.open(tmp_path / "first_image.png") as image:
        assert image.size == (800, 400)


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["track", "fuse --type detection"])
def test_fusing_and_tracking_boxes_meets_no_kernel_that_was_not_asked_for(verb, data_dir, tmp_path):
    folder = data_dir / "real" / "kitti_tracking"
    words = (*verb.split(), folder, "--sequence", "0000", "--quiet", "-o", tmp_path / "objects")
    assert kernels_not_asked_for(*words) == "[] True"
