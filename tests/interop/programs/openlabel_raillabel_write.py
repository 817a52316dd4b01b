"""Write an OpenLABEL file with RailLabel, and print what is in it."""

import json
import sys
from decimal import Decimal
from pathlib import Path

import raillabel
from raillabel.format import Camera, IntrinsicsPinhole, Lidar, Point3d, Quaternion, Size3d, Transform
from raillabel.scene_builder import SceneBuilder

builder = SceneBuilder.empty().add_object(object_type="person").add_sensor("rgb_center").add_sensor("lidar")
builder = builder.add_frame(frame_id=3, timestamp=1_632_321_743.1)
builder = builder.add_cuboid(
    pos=Point3d(10.0, -2.0, 1.0),
    size=Size3d(0.6, 0.7, 1.8),
    quat=Quaternion(0.0, 0.0, 0.0, 1.0),
    frame_id=3,
    sensor_id="lidar",
)
scene = builder.result
matrix = (500.0, 0.0, 320.0, 0.0, 0.0, 510.0, 241.0, 0.0, 0.0, 0.0, 1.0, 0.0)
scene.sensors["rgb_center"] = Camera(
    IntrinsicsPinhole(camera_matrix=matrix, distortion=(-0.1, 0.0, 0.0, 0.0, 0.0), width_px=640, height_px=480)
)
scene.sensors["lidar"] = Lidar(extrinsics=Transform(Point3d(1.0, 2.0, 3.0), Quaternion(0.0, 0.0, 0.0, 1.0)))
scene.frames[3].timestamp = Decimal("1632321743.100000072")
raillabel.save(scene, Path(sys.argv[1]))
sys.stdout.write(
    json.dumps(
        {
            "size_and_position": [0.6, 0.7, 1.8, 11.0, 0.0, 4.0],
            "timestamps_ns": [1_632_321_743_100_000_072],
            "fx_cy": [500.0, 241.0],
        }
    )
)
