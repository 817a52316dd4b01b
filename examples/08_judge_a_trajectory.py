"""Judge trajectories: satellite fixes, and what GNSS and IMU give together, against the truth of a simulated drive.

Each is compared after a shift and a rotation about the vertical, which is what such methods leave open. The truth goes
into a TUM file and comes back number for number; `sceneloom eval trajectory` and `sceneloom convert` do the same from
files.

    python examples/08_judge_a_trajectory.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np

import sceneloom
from sceneloom.simulate import LidarSpec

if __name__ == "__main__":
    where = Path(sys.argv[1] if len(sys.argv) > 1 else "judged")
    where.mkdir(exist_ok=True)
    drive = sceneloom.simulate_street(7, frames=60, lidar=LidarSpec(beams=1, steps=8), cameras=())
    sceneloom.write(drive.scene, where / "drive", overwrite=True)

    truth = sceneloom.read_trajectory(where / "drive")
    for name in ("fixes", "gnss"):
        report = sceneloom.evaluate_trajectory(f"{where / 'drive'}:{name}", truth, align="yaw", rpe_deltas=["10m"])
        away, (motion,) = report.absolute.translation, report.relative
        print(
            f"{name}: {report.pairs} pairs over {report.path_length:.0f} m, {away.rms:.3f} m off (rms), "
            f"{motion.translation_percent:.2f} % per 10 m"
        )

    losses = sceneloom.write_trajectory(truth, where / "truth.tum", overwrite=True)
    again = sceneloom.read_trajectory(where / "truth.tum")
    print("lost in the TUM file:", len(losses), "fields")
    print("the same numbers:", np.array_equal(again.positions, truth.positions))
