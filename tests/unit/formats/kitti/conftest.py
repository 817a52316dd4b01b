"""A small folder of KITTI's tracking benchmark, written by hand in both spellings."""

from collections.abc import Callable
from pathlib import Path

import pytest

P2 = "7.070493e+02 0 6.0e+02 3.5e+01 0 7.070493e+02 1.8e+02 7.0e-01 0 0 1 0"
R = "1 0 0 0 1 0 0 0 1"
VELODYNE = "0 -1 0 0 0 0 -1 -0.1 1 0 0 -0.3"
IMU = "1 0 0 -0.8 0 1 0 0.3 0 0 1 -0.8"
TRACKING = f"P2: {P2}\nR_rect {R}\nTr_velo_cam {VELODYNE}\nTr_imu_velo {IMU}\n\n"
OBJECT = f"P2: {P2}\nR0_rect: {R}\nTr_velo_to_cam: {VELODYNE}\nTr_imu_to_velo: {IMU}\n"
OXTS = "49.0 8.0 110.0 0 0 {yaw}" + " 0" * 24 + "\n"
FILES = {
    "calib/0007.txt": TRACKING,
    "oxts/0007.txt": "".join(OXTS.format(yaw=0.1 * k) for k in range(4)) + "\n",
    "det2d_a/Car/0007.txt": "0,10,20,110,220,0.75\n2,1,2,3,4,0.5\n",
    "det2d_a/Pedestrian/0007.txt": "",
    "det3d_b/Car/0007.txt": "2,2,0,0,9,9,-1.5,1.5,1.6,4.0,2.0,1.5,10.0,0.0,0.2\n",
    "det3d_b/Pedestrian/0007.txt": "2,1,0,0,9,9,3.5,1.8,0.6,0.8,-1.0,1.5,8.0,-1.5707963,0.2\n",
}


@pytest.fixture
def tracking_folder(tmp_path) -> Callable[..., Path]:
    """Write the folder, some of its files replaced or, with None, left out."""

    def write(**changed: str | None) -> Path:
        folder = tmp_path / "drive"
        named = {name.replace("__", "/") + ".txt": text for name, text in changed.items()}
        for name, text in (FILES | named).items():
            if text is not None:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_text(text)
        return folder

    return write


@pytest.fixture
def spellings() -> dict[str, str]:
    """The same calibration as the tracking and as the object benchmark spell it."""
    return {"tracking": TRACKING, "object": OBJECT}
