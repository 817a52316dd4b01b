"""Makes the pickled frames beside it, by hand, with pandas: `python make_frames.py FOLDER`.

Those in `frames` were written by pandas 1.0.5 (that of PandaSet's time), 2.2.3 and 3.1.1; sceneloom needs none of them.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

FIRST_S = 1_557_539_924.5


def lidar(k):
    count = 12 + k
    row = np.arange(count)
    frame = pd.DataFrame(
        {
            "x": 100.0 + row * 1.25 + k,
            "y": -40.0 + row * 0.5,
            "z": row / 8.0,
            "i": (row * 20 % 256).astype(np.float64),
            "t": FIRST_S + 0.1 * k + row * 0.001,
            "d": np.where(row < 8, 0, 1),
        }
    )
    frame.index.name = "index"
    return frame


def cuboids(k):
    nothing = float("nan") if k else None
    return pd.DataFrame(
        {
            "uuid": ["car-0", "car-1", "walker"],
            "label": ["Car", "Car", "Pedestrian"],
            "yaw": [0.25 + 0.1 * k, 0.25, -1.0],
            "stationary": [False, False, True],
            "camera_used": [-1, 2 * k, -1],
            "position.x": [10.0 + k, 10.5 + k, 3.0],
            "position.y": [20.0, 20.0, -4.0],
            "position.z": [1.0, 1.0, 0.5],
            "dimensions.x": [1.9, 1.9, 0.6],
            "dimensions.y": [4.6, 4.6, 0.7],
            "dimensions.z": [1.6, 1.6, 1.8],
            "attributes.object_motion": ["Moving", "Moving", nothing],
            "cuboids.sibling_id": ["car-1", "car-0", "-"],
            "cuboids.sensor_id": [0, 1, -1],
            "attributes.pedestrian_age": [nothing, nothing, "Adult" if k else "Child"],
        }
    )


def semseg(k):
    return pd.DataFrame({"class": np.arange(12 + k) % 3 + 5})


if __name__ == "__main__":
    for k in range(2):
        for make in (lidar, cuboids, semseg):
            target = Path(sys.argv[1]) / f"{make.__name__}_{k}.pkl.gz"
            target.parent.mkdir(parents=True, exist_ok=True)
            make(k).to_pickle(target)
