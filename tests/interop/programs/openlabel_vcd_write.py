"""Write an OpenLABEL file with VCD, its reference program, and print where VCD puts the corners of its boxes."""

import json
import math
import sys

import numpy as np
from vcd import core, scl, types, utils

v = core.OpenLABEL()
v.add_metadata_properties({"annotator": "somebody"})
v.add_coordinate_system("odom", cs_type=types.CoordinateSystemType.scene_cs)
v.add_coordinate_system("vehicle-iso8855", cs_type=types.CoordinateSystemType.local_cs, parent_name="odom")


def pose(rz, t):
    m = np.eye(4)
    m[:3, :3] = utils.euler2R([rz, 0.1, -0.2])
    m[:3, 3] = t
    return m


lidar = pose(0.3, [1.0, 0.2, 1.9])
cam = np.array([[0, 0, 1, 1.5], [-1, 0, 0, 0.1], [0, -1, 0, 1.2], [0, 0, 0, 1.0]])


def P(m):
    return types.PoseData(val=list(map(float, m.flatten())), t_type=types.TransformDataType.matrix_4x4)


v.add_coordinate_system(
    "lidar", cs_type=types.CoordinateSystemType.sensor_cs, parent_name="vehicle-iso8855", pose_wrt_parent=P(lidar)
)
v.add_coordinate_system(
    "front", cs_type=types.CoordinateSystemType.sensor_cs, parent_name="vehicle-iso8855", pose_wrt_parent=P(cam)
)
v.add_stream("lidar", "clouds/", "top lidar", core.StreamType.lidar)
v.add_stream("front", "front.mp4", "front camera", core.StreamType.camera)
v.add_stream_properties(
    "front",
    intrinsics=types.IntrinsicsPinhole(
        width_px=640,
        height_px=480,
        camera_matrix_3x4=[500.0, 0.0, 320.0, 0.0, 0.0, 510.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        distortion_coeffs_1xN=[-0.1, 0.02, 0.001, -0.002, 0.003],
    ),
)
car = v.add_object("car1", "Car")
rng = np.random.default_rng(3)
reported = {"euler": [], "world": []}
for k in range(3):
    ego = pose(0.2 * k, [5.0 * k, 1.0 * k, 0.0])
    v.add_transform(
        k,
        types.Transform(
            "vehicle-iso8855",
            "odom",
            types.TransformData(val=list(map(float, ego.flatten())), t_type=types.TransformDataType.matrix_4x4),
        ),
    )
    v.add_frame_properties(frame_num=k, timestamp=f"2024-01-01T00:00:0{k}.25Z")
    c9 = [10.0 + k, 2.0, 0.5, 0.05, -0.1, 0.4 + 0.1 * k, 4.5, 1.9, 1.6]
    v.add_object_data(car, types.cuboid("shape", c9, "lidar"), k)
    box = types.bbox("shape2d", [100.0 + k, 80.0, 40.0, 30.0], "front")
    box.add_attribute(types.boolean("truncated", k == 1))
    v.add_object_data(car, box, k)
    v.add_object_data(car, types.num("speed", 1.5 * k), k)
    v.add_object_data(car, types.poly2d("mask", (0, 0, 10, 0, 10, 10), types.Poly2DType.MODE_POLY2D_ABSOLUTE, True), k)
    reported["euler"].append(c9)
walker = v.add_object("walker", "Pedestrian", frame_value=[(0, 2)])
q = [0.0, 0.0, math.sin(0.35), math.cos(0.35)]
v.add_object_data(walker, types.cuboid("shape", [3.0, -4.0, 0.9, *q, 0.6, 0.7, 1.8], "odom"), (0, 2))
v.add_object_data(walker, types.text("pose", "stationary"))
v.add_object_data(walker, types.vec("colour", [1, 2, 3]))
act = v.add_action("crossing", "Crossing", frame_value=(1, 2))
ev = v.add_event("starts", "Start", frame_value=(1, 1))
v.add_relation_subject_object(
    "rel",
    "isSubjectOfAction",
    subject_type=core.ElementType.object,
    subject_uid=walker,
    object_type=core.ElementType.action,
    object_uid=act,
)
v.save(sys.argv[1])
scene = scl.Scene(v)
for k in range(3):
    t, _ = scene.get_transform("lidar", "odom", frame_num=k)
    local = utils.generate_cuboid_points_ref_4x8(reported["euler"][k])
    reported["world"].append((t @ local)[:3].T.tolist())
sys.stdout.write(json.dumps({"corners_odom": reported["world"]}))
