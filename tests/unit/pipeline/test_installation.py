"""What an installation says of itself."""

import importlib
import importlib.metadata
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from sceneloom.errors import how_to_install
from sceneloom.kernels import cache
from sceneloom.pipeline import installation
from sceneloom.pipeline.installation import Status, examine_installation, find_packages


def findings(group):
    return {one.name: one for one in examine_installation().findings if one.group == group}


def test_this_installation_is_sound_and_says_its_versions():
    found = examine_installation()
    assert found.is_sound
    stated = {(one.group, one.name): one.stated for one in found.findings}
    assert stated["packages", "numpy"] == importlib.metadata.version("numpy")
    assert stated["versions", "Python"].startswith(f"{sys.version_info.major}.{sys.version_info.minor}.")
    assert stated["codecs", "H.264, written"] == "there"


REQUIREMENTS = [
    "numpy>=2.0",
    "scipy>=999.1",
    "fsspec[http]>=2024.2; extra == 'cloud'",
    "no-such-package>=1; extra == 'mcap'",
    "pytest>=8.2; extra == 'dev'",
]


def test_packages_are_looked_for_as_the_metadata_name_them(monkeypatch):
    monkeypatch.setattr(installation, "requires", lambda _: REQUIREMENTS)
    found = {one.name: one for one in find_packages()}
    assert sorted(found) == ["fsspec", "no-such-package", "numpy", "scipy"]
    assert found["numpy"].problem is None
    assert "expected 999.1 or newer" in found["scipy"].problem
    assert (found["no-such-package"].extra, found["no-such-package"].installed) == ("mcap", None)


def test_what_is_needed_and_broken_makes_it_unsound_and_a_missing_extra_does_not(monkeypatch):
    monkeypatch.setattr(installation, "requires", lambda _: REQUIREMENTS[3:4])
    assert examine_installation().is_sound
    extra = findings("extras")["mcap"]
    assert (extra.status, extra.remedy) == (Status.MISSING, how_to_install("mcap"))
    monkeypatch.setattr(installation, "requires", lambda _: REQUIREMENTS[1:2])
    broken = examine_installation()
    assert not broken.is_sound
    assert findings("packages")["scipy"].remedy == "pip uninstall scipy, then pip install 'scipy>=999.1'"


def test_a_package_that_cannot_be_imported_is_broken(monkeypatch, tmp_path):
    folder = tmp_path / "crooked-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: crooked\nVersion: 1.0\n")
    (tmp_path / "crooked.py").write_text("raise OSError('libcrooked.so: cannot open')")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(installation, "requires", lambda _: ["crooked>=1"])
    (found,) = find_packages()
    assert found.problem == "cannot be imported: libcrooked.so: cannot open"


def test_a_folder_that_is_not_installed_says_so(monkeypatch):
    def absent(_):
        raise importlib.metadata.PackageNotFoundError

    monkeypatch.setattr(installation, "requires", absent)
    assert "not installed" in findings("packages")["sceneloom"].stated


def test_kernels_count_as_compiled_once_there_is_an_index_of_their_present_source(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    cold = cache.find_kernel_cache()
    assert (cold.folder, cold.compiled, cold.is_warm, cold.writable) == (tmp_path, 0, False, True)
    python = f"py{sys.version_info.major}{sys.version_info.minor}"
    below = tmp_path / "kernels_5f3a"
    below.mkdir()
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


def test_kept_kernels_are_those_of_the_content_of_their_sources_and_not_of_their_age(tmp_path):
    package = Path(cache.__file__).parent
    copied = tmp_path / "voxels.py"
    copied.write_bytes((package / "voxels.py").read_bytes())
    known = cache.source_digest(package / "voxels.py")
    assert cache.source_digest(copied) == known
    changed = tmp_path / "changed.py"
    changed.write_bytes(copied.read_bytes() + b"\n")
    assert cache.source_digest(changed) != known


@pytest.mark.parametrize("usable", [False, True])
def test_a_cache_that_cannot_be_written_is_no_good(monkeypatch, tmp_path, usable):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "cache"))
    if not usable:
        monkeypatch.setattr("sceneloom.kernels.cache._can_write", lambda _: False)
    found = findings("kernels")["compiled kernels"]
    assert found.status is (Status.MISSING if usable else Status.BROKEN)
    assert "NUMBA_CACHE_DIR" in found.remedy
