"""Check an OpenLABEL file against the schema of VCD, and print where VCD puts the corners of its boxes."""

import json
import sys
from pathlib import Path

import jsonschema
from vcd import core, scl, utils
from vcd.schema import openlabel_schema

content = json.loads(Path(sys.argv[1]).read_text("utf-8"))
errors = [error.message for error in jsonschema.Draft7Validator(openlabel_schema).iter_errors(content)]
label = core.OpenLABEL()
label.load_from_file(sys.argv[1])
scene = scl.Scene(label)
corners = {}
for uid, entry in content["openlabel"]["objects"].items():
    for number, frame in content["openlabel"]["frames"].items():
        data = frame.get("objects", {}).get(uid, {}).get("object_data", {})
        for cuboid in data.get("cuboid", []):
            local = utils.generate_cuboid_points_ref_4x8(cuboid["val"])
            transform, _ = scene.get_transform(cuboid["coordinate_system"], "world", frame_num=int(number))
            corners[f"{entry['name']} {number}"] = (transform @ local)[:3].T.tolist()
lidar_to_world = [
    scene.get_transform("top", "world", frame_num=int(n))[0].tolist() for n in content["openlabel"]["frames"]
]
names = [entry["name"] for entry in content["openlabel"]["objects"].values()]
last = list(content["openlabel"]["objects"])[-1]
data = label.get_frame(0)["objects"][last]["object_data"]
reported = {
    "errors": errors,
    "corners": corners,
    "lidar_to_world": lidar_to_world,
    "objects": names,
    "loaded": {kind: len(data[kind]) for kind in sorted(data)},
}
sys.stdout.write(json.dumps(reported))
