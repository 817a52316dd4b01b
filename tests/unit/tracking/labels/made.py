"""Tracks made by hand or taken from the truth of simulated drives, for the tests of labels."""

import numpy as np

from sceneloom.scene import Support, Track, Tracks

FOLLOWED = ("car", "pedestrian", "cyclist")


def made(number=1, label="car", *, count=21, period_ns=100_000_000, speed=8.0, **changes):
    """A car of 4.2 m that drives straight along x, seen by both detectors; any column can be replaced."""
    times = 1_000_000_000 + period_ns * np.arange(count, dtype=np.int64)
    along = speed * (times - times[0]) * 1e-9
    columns = {
        "timestamps_ns": times,
        "centers": np.column_stack([along, np.zeros(count), np.full(count, 0.8)]),
        "sizes_lwh": np.tile([4.2, 1.8, 1.6], (count, 1)),
        "yaws": np.zeros(count),
        "velocities": np.tile([speed, 0.0, 0.0], (count, 1)),
        "yaw_rates": np.zeros(count),
        "covariances": np.tile(0.01 * np.eye(10), (count, 1, 1)),
        "scores": np.full(count, 0.9),
        "supports": np.full(count, Support.BOTH, np.uint8),
    }
    return Track(number, label, **{**columns, **changes})


def followed(drive, timestamps_ns):
    """What a perfect tracker would state of a simulated drive."""
    truth = drive.truth.boxes(timestamps_ns)
    found = []
    for i, (instance, label) in enumerate(zip(truth.instances.tolist(), truth.labels, strict=True)):
        rows = np.flatnonzero(truth.present[:, i])
        if len(rows) > 1 and label in FOLLOWED:
            columns = {
                "timestamps_ns": truth.timestamps_ns[rows],
                "centers": truth.centers_world[rows, i],
                "sizes_lwh": np.tile(truth.sizes_lwh[i], (len(rows), 1)),
                **{name: getattr(truth, name)[rows, i] for name in ("yaws", "velocities", "yaw_rates")},
            }
            found.append(made(instance, label, count=len(rows), **columns))
    return Tracks(tuple(found))
