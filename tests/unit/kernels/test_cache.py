"""Kernels that are compiled ahead, in processes side by side."""

import os
import subprocess
import sys

from sceneloom.kernels import cache

KERNELS = [
    "sceneloom.kernels.voxels:number_cubes",
    "sceneloom.kernels.packed:unpack",
    "sceneloom.cameras.perspective:Pinhole.project_points",
]


def test_kernels_are_compiled_ahead_kept_and_not_compiled_again(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    told = []
    with cache.reporting_compiling(lambda name, left: told.append((name, left))):
        cache.compile_ahead([*KERNELS, KERNELS[0]])
        assert sorted(told) == sorted(zip(KERNELS, (3, 2, 1), strict=True))
        cache.compile_ahead(KERNELS)
    assert len(told) == 3
    program = (
        "import numpy as np; from sceneloom.kernels import cache; told = []\n"
        "with cache.reporting_compiling(lambda name, left: told.append(name)):\n"
        "    from sceneloom.cameras import Camera, project\n"
        "    project(Camera('pinhole', 8, 8, 5.0, 5.0, 3.5, 3.5), np.array([[0.0, 0.0, 2.0]]))\n"
        "print(told)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    cache.compile_ahead(["sceneloom.kernels.voxels:no_such", "sceneloom.no.module:at_all"])


def test_a_process_that_ends_takes_one_kernel_with_it_and_no_more(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    started = []
    cache.compile_ahead(KERNELS, started=lambda process: started.append(process) or started[0].kill())
    kept = [path.name for path in tmp_path.rglob("*.nbi")]
    assert len(started) == 2
    assert len([name for name in KERNELS if any(name.split(":")[1] in one for one in kept)]) == 2
    cache.compile_ahead(["sceneloom.kernels.poses:transform_by_path", *KERNELS], started=lambda one: one.kill())


def test_machine_code_is_made_of_what_python_calls_alone(tmp_path):
    program = (
        "from numba.core.codegen import JITCodeLibrary\n"
        "from sceneloom.kernels.cache import compile_kernels\n"
        "import sceneloom.cameras.perspective\n"
        "made, make = [], JITCodeLibrary._finalize_specific\n"
        "JITCodeLibrary._finalize_specific = lambda library: (made.append(library.name), make(library))\n"
        "compile_kernels(['sceneloom.cameras.perspective:Pinhole.project_points'])\n"
        "print(made)\n"
        "print(JITCodeLibrary._finalize_final_module.__qualname__)\n"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment)
    made, restored = done.stdout.splitlines()
    assert made == "['Pinhole.project_points']"
    assert restored == "CPUCodeLibrary._finalize_final_module"


def test_kept_kernels_are_loaded_without_what_only_compiling_needs():
    program = (
        "import sys, numpy\n"
        "from sceneloom.kernels.boxes import find_points_in_boxes\n"
        "from sceneloom.kernels.cache import compile_kernels\n"
        "compile_kernels(['sceneloom.kernels.boxes:find_points_in_boxes'])\n"
        "print('numba.typed.typeddict' in sys.modules)\n"
    )
    printed = [
        subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    ]
    assert printed[1] == "False\n"
