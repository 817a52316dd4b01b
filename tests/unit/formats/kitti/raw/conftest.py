"""A drive of KITTI's raw data, written by hand: two frames, a camera, a lidar and an OXTS unit."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

DAY, DRIVE = "2011_09_26", "2011_09_26_drive_0001_sync"

CAM_TO_CAM = """calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
S_02: 40 30
K_02: 50 0 19 0 51 14 0 0 1
D_02: -0.3 0.1 0.001 -0.002 -0.02
R_02: 0.9998 -0.02 0 0.02 0.9998 0 0 0 1
T_02: 0.06 0.01 -0.002
S_rect_02: 36 28
R_rect_00: 0.99995 0.01 0 -0.01 0.99995 0 0 0 1
R_rect_02: 1 0 0 0 1 0 0 0 1
P_rect_02: 48 0 17 2.88 0 48 13 0.5 0 0 1 0.003
"""
VELO_TO_CAM = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0.01 -0.08 -0.27\ndelta_f: 0 0\ndelta_c: 0 0\n"
IMU_TO_VELO = "calib_time: 25-May-2012 16:47:16\nR: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n"
TIMESTAMPS = "2011-09-26 13:02:25.594360375\n2011-09-26 13:02:25.698214100\n"
STARTS = "2011-09-26 13:02:25.544360375\n2011-09-26 13:02:25.648214100\n"
ENDS = "2011-09-26 13:02:25.644360375\n2011-09-26 13:02:25.748214100\n"
OXTS = (
    "49.0 8.0 110.0 0.01 -0.02 {yaw} 1 2 3 4 5 0.1 0.2 9.8 0.3 0.4 9.7 0.01 0.02 0.03 0.04 0.05 0.06 "
    "0.5 0.07 4 10 5 4 0\n"
)
TRACKLETS = """<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>
<!DOCTYPE boost_serialization>
<boost_serialization signature="serialization::archive" version="9">
<tracklets class_id="0" tracking_level="0" version="0"><count>1</count><item_version>1</item_version>
<item class_id="1" tracking_level="0" version="1"><objectType>Car</objectType><h>1.5</h><w>1.6</w><l>4</l>
<first_frame>0</first_frame><poses class_id="2" tracking_level="0" version="0"><count>2</count>
<item_version>2</item_version>
<item><tx>10</tx><ty>2</ty><tz>-1.7</tz><rx>0</rx><ry>0</ry><rz>0.5</rz><state>2</state><occlusion>0</occlusion>
<occlusion_kf>0</occlusion_kf><truncation>1</truncation><amt_occlusion>-1</amt_occlusion></item>
<item><tx>9</tx><ty>2</ty><tz>-1.7</tz><rx>0</rx><ry>0</ry><rz>0.6</rz><state>1</state><occlusion>1</occlusion>
<occlusion_kf>0</occlusion_kf><truncation>0</truncation><amt_occlusion>-1</amt_occlusion></item>
</poses><finished>1</finished></item></tracklets></boost_serialization>
"""
POINTS = np.array(
    [[-9, -0.001, 0, 0.1], [0, -5, 1, 0.25], [8, 0, -1, 0.5], [0, 6, 1, 0.75], [-7, 0.001, 0, 1.0]],
    np.float32,
)
"""Behind on the right, right, ahead, left, behind on the left: in the order in which the scanner rotates."""

TEXTS = {
    f"{DAY}/calib_cam_to_cam.txt": CAM_TO_CAM,
    f"{DAY}/calib_velo_to_cam.txt": VELO_TO_CAM,
    f"{DAY}/calib_imu_to_velo.txt": IMU_TO_VELO,
    f"{DAY}/{DRIVE}/image_02/timestamps.txt": TIMESTAMPS,
    f"{DAY}/{DRIVE}/velodyne_points/timestamps.txt": TIMESTAMPS,
    f"{DAY}/{DRIVE}/velodyne_points/timestamps_start.txt": STARTS,
    f"{DAY}/{DRIVE}/velodyne_points/timestamps_end.txt": ENDS,
    f"{DAY}/{DRIVE}/oxts/timestamps.txt": TIMESTAMPS,
    f"{DAY}/{DRIVE}/oxts/data/0000000000.txt": OXTS.format(yaw=0.3),
    f"{DAY}/{DRIVE}/oxts/data/0000000001.txt": OXTS.format(yaw=0.4),
    f"{DAY}/{DRIVE}/tracklet_labels.xml": TRACKLETS,
}


@pytest.fixture
def raw_folder(tmp_path) -> Callable[..., Path]:
    """Write the folder of the day's, some of its texts replaced or, with None, left out; the name of the drive too."""

    def write(
        changed: dict[str, str | None] | None = None, *, drive: str = DRIVE, size: tuple[int, int] = (36, 28)
    ) -> Path:
        root = tmp_path / "kitti"
        named = {f"{DAY}/{name}".replace("DRIVE", DRIVE): text for name, text in (changed or {}).items()}
        for name, text in (TEXTS | named).items():
            if text is not None:
                location = root / name.replace(DRIVE, drive)
                location.parent.mkdir(parents=True, exist_ok=True)
                location.write_text(text)
        folder = root / DAY / drive
        for kind in ("image_02", "velodyne_points"):
            (folder / kind / "data").mkdir(parents=True, exist_ok=True)
        for k in range(2):
            image = np.full((size[1], size[0], 3), 40 * k + np.arange(3), np.uint8)
            Image.fromarray(image).save(folder / "image_02" / "data" / f"{k:010d}.png")
            POINTS.tofile(folder / "velodyne_points" / "data" / f"{k:010d}.bin")
        return root

    return write


@pytest.fixture
def raw_points() -> np.ndarray:
    """The points of each sweep, (5, 4) float32."""
    return POINTS
