"""A program of its own: which kernels a server compiles or loads after it was warmed up. Prints them as JSON.

With the argument "all" it is asked by the whole conformance kit over the network, too.
"""

import json
import sys
from dataclasses import replace

import numpy as np
from numba.core import event
from numba.core.dispatcher import Dispatcher
from tests.unit.db34t.sending import HEIGHT, WIDTH, boxes_2d, boxes_3d, calibration, cloud, image, send_all, timestamp

from sceneloom.cameras.camera import MODELS
from sceneloom.db34t.interface import FusionInterface
from sceneloom.scene.poses import Poses
from sceneloom.service.running import running_server, warm_up
from sceneloom.service.server import TrackedResults

PIXELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1}
SHUTTER = json.dumps({"0": {"kind": "lidar"}, "1": {"kind": "camera", "shutter_roll_s": 0.03}})


def compiled():
    """How many versions there are of each kernel that was imported."""
    return {
        f"{value.__module__}.{value.__name__}": len(value.signatures)
        for name, module in list(sys.modules.items())
        if name.startswith("sceneloom")
        for value in list(vars(module).values())
        if isinstance(value, Dispatcher) and value.signatures
    }


def camera_models():
    """The property `camera_models` for every model that there is."""
    for name, model in MODELS.items():
        coefficients = [0.01] * min(2, len(model.coefficient_names))
        intrinsics = {"fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5, "coefficients": coefficients}
        yield json.dumps({"1": {"model": name, "image_size": [WIDTH, HEIGHT], **intrinsics}})


def path():
    times = np.array([timestamp(k).nanoseconds for k in range(-1000, 2000, 50)])
    positions = np.column_stack([np.arange(len(times)) * 0.1, np.zeros((len(times), 2))])
    return Poses(times, positions, np.tile([0.0, 0, 0, 1], (len(times), 1)))


def session(properties=(), *, camera_model=None, cameras=(1,), moves=False, encoding="rgb8"):
    """Send all kinds of records, and follow the objects of the results."""
    channels = PIXELS[encoding]
    with FusionInterface() as fusion:
        if camera_model is not None:
            assert fusion.add_property("camera_models", "", "string")
            properties = (*properties, ("camera_models", camera_model))
        for name, value in properties:
            assert fusion.set_property(name, value)
        for camera_id in cameras:
            assert fusion.set_calibration(calibration(distortion_coeffs=(0.01, 0, 0, 0, 0)), camera_id=camera_id)
        assert not moves or fusion.send_motion(path())
        for seq in range(3):
            at = 100 * seq
            for camera_id in cameras:
                form = {
                    "encoding": encoding,
                    "channel": channels,
                    "data": np.zeros(HEIGHT * WIDTH * channels, np.uint8),
                }
                box = boxes_2d(at, seq, sensor_id=camera_id, x1=25 - 9 * seq, y1=18, x2=38, y2=30)
                send_all(fusion, replace(image(at, seq, sensor_id=camera_id), **form), box)
            rng = np.random.default_rng(seq)
            rows = np.hstack([rng.normal(0, 9, (300, 3)), rng.random((300, 2)) * 0.1])
            send_all(fusion, cloud(at, seq, rows, fields=("x", "y", "z", "time", "reflectivity")), boxes_3d(at, seq))
        fusion.flush()
        tracked = TrackedResults()
        assert list(fusion.results(0))
        assert [reported for result in fusion.results(1) for reported in tracked.take(result)]
        assert not [name for name in fusion.counters.counts() if name.startswith(("failed", "errors"))]


def sessions():
    session(cameras=(1, 2))
    session([("fusion_algorithm", "blending")], cameras=(1, 2), moves=True)
    session([("depth_kind", "range"), ("reference_frame", 0)], moves=True)
    session([("sensors", SHUTTER)], moves=True)
    for encoding in PIXELS:
        session(encoding=encoding)
    for camera_model in camera_models():
        session(camera_model=camera_model, moves=True)


def conformance():
    from sceneloom.db34t.conformance.examination import GrpcTransport, examine

    with running_server() as server, GrpcTransport.connected(server.address) as transport:
        assert examine(transport, address=server.address).failed_ids == ()


if __name__ == "__main__":
    warm_up()
    before = compiled()
    with event.install_recorder("numba:compile") as recorder:
        sessions()
        if "all" in sys.argv:
            conformance()
        events = len(recorder.buffer)
    after = compiled()
    later = [name for name in after if after[name] != before.get(name)]
    sys.stdout.write(json.dumps({"events": events, "later": later}))
