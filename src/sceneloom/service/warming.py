"""Compiles and loads all that requests can need before a server listens: the first one waits as long as the last."""

import logging
import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from typing import Any

import numpy as np

from sceneloom.cameras.table import MODELS
from sceneloom.fusion.interface import FusionInterface
from sceneloom.fusion.messages.boxes import Boxes2d, Boxes3d
from sceneloom.fusion.messages.calibration_data import CalibrationData
from sceneloom.fusion.messages.records import SentRecord
from sceneloom.fusion.messages.sensor_data import ImageData, PointCloudData
from sceneloom.fusion.messages.timestamps import Timestamp
from sceneloom.kernels.cache import compile_kernels, declaring_modules, find_kernel_cache, lacks_kernels

LOG = logging.getLogger(__name__)

_FORWARD = (0.0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1)
_WIDTH, _HEIGHT = 64, 48


_Process = subprocess.Popen[str]


def warm_up(started: Callable[[_Process], object] = id) -> int:
    """Compile and load all kernels that requests can reach; gives how many results a small pair of each type gave.

    Every kernel has its types written down. What is imported with the interface is what it can call, and camera
    models, which properties choose.

    Args:
        started: receives each process that compiles, which may be killed: this compiles the rest itself.
    """
    for model in MODELS.values():
        import_module(model.module)
    modules = declaring_modules()
    _compile_apart([name for name in modules if lacks_kernels(name)], started)
    compile_kernels(modules)
    with FusionInterface(inline=True) as fusion:
        fusion.set_calibration(
            CalibrationData(
                image_size=(_WIDTH, _HEIGHT),
                intrinsic_matrix=(50.0, 0, 31.5, 0, 50.0, 23.5, 0, 0, 1),
                reference_frame=0,
                extrinsic_matrix=_FORWARD,
            )
        )
        for record in _records():
            fusion.send(record)
        fusion.flush()
        return fusion.waiting_results


def _compile_apart(modules: list[str], started: Callable[[_Process], object]) -> None:
    """Compile modules in processes side by side, as the compiler takes one thread; they are kept, and loaded here.

    What fails there fails again, and is reported, when it is compiled here.
    """
    processes = min(os.cpu_count() or 1, len(modules))
    if processes < 2 or not find_kernel_cache().writable:
        return
    with ThreadPoolExecutor(processes) as pool:
        list(pool.map(_compile, [modules[k::processes] for k in range(processes)], [started] * processes))


def _compile(modules: list[str], started: Callable[[_Process], object]) -> None:
    """Compile modules in a process of their own."""
    code = (
        "import importlib, sys; from sceneloom.kernels.cache import compile_kernels\n"
        "for name in sys.argv[1:]:\n"
        "    importlib.import_module(name); print(name, flush=True); compile_kernels([name])"
    )
    command = [sys.executable, "-c", code, *modules]
    with subprocess.Popen(  # noqa: S603 - our own program
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        started(process)
        for line in process.stdout or ():
            LOG.info("compiling for this machine; it is kept", extra={"fields": {"module": line.strip()}})


def _records() -> list[SentRecord]:
    common: dict[str, Any] = {"sensor_id": 0, "seq": 0, "timestamp": Timestamp(1, 0)}
    of_one: dict[str, Any] = {
        "id": np.zeros(1, np.int32),
        "class_names": ("car",),
        "confidence": np.full(1, 0.5, np.float32),
    }
    point = np.array([[10.0, 0, 0]], np.float32)
    return [
        ImageData(
            **common,
            height=_HEIGHT,
            width=_WIDTH,
            encoding="rgb8",
            channel=3,
            data=np.zeros(_HEIGHT * _WIDTH * 3, np.uint8),
        ),
        PointCloudData(**common, number=1, fields=("x", "y", "z"), fields_number=3, data=point),
        Boxes2d(**common, **of_one, corners_xyxy=np.array([[25, 18, 38, 30]], np.uint32)),
        Boxes3d(
            **common,
            **of_one,
            centers=point,
            sizes_lwh=np.full((1, 3), 2.0, np.float32),
            directions=np.array([[1, 0, 0]], np.float32),
            velocities=np.zeros(1, np.float32),
        ),
    ]
