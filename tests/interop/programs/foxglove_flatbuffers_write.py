"""Write `golden/foxglove_flatbuffers.mcap` and the same messages as JSON.

`python foxglove_flatbuffers_write.py FLATC FOLDER`: FLATC is the program `flatc` (2.0.8), which makes schemas (.bfbs)
of `foxglove.fbs` and messages of JSON; the package `mcap` puts them into a file. Schemas hold the tables that their
messages need.
"""

import io
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from mcap.writer import CompressionType, Writer
from PIL import Image

SECOND = 1_700_000_000


def time(k, nsec=0):
    return {"sec": SECOND + k, "nsec": nsec}


def xyz(x, y, z):
    return {"x": x, "y": y, "z": z}


def pose(x, y, z, *, turned=False):
    rotation = {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8} if turned else {"w": 1.0}
    return {"position": xyz(x, y, z), "orientation": rotation}


def jpeg():
    file = io.BytesIO()
    Image.new("RGB", (16, 8), (200, 30, 60)).save(file, "JPEG")
    return list(file.getvalue())


def points(k):
    import struct

    rows = [(1.5 + k, -2.0, 0.25, 7), (3.0, 4.0 + k, 0.5, 255), (10.0, 0.0, -1.0, 30)]
    return list(b"".join(struct.pack("<fffB3x", *row) for row in rows))


def messages():
    fields = [{"name": name, "offset": 4 * n, "type": 7} for n, name in enumerate("xyz")]
    fields.append({"name": "intensity", "offset": 12, "type": 1})
    matrix = [20.0, 0.0, 7.5, 0.0, 20.0, 3.5, 0.0, 0.0, 1.0]
    for k in range(3):
        transforms = [
            {"timestamp": time(k), "parent_frame_id": "world", "child_frame_id": "base_link",
             "translation": xyz(2.0 * k, 1.0, 0.0), "rotation": {"z": 0.6, "w": 0.8}},
            {"timestamp": time(k), "parent_frame_id": "base_link", "child_frame_id": "lidar",
             "translation": xyz(0.5, 0.0, 1.75), "rotation": {"w": 1.0}},
            {"timestamp": time(k), "parent_frame_id": "base_link", "child_frame_id": "front",
             "translation": xyz(1.0, 0.0, 1.5), "rotation": {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5}},
        ]  # fmt: skip
        yield "/tf", "FrameTransforms", {"transforms": transforms}
        yield "/lidar/points", "PointCloud", {
            "timestamp": time(k, 1000), "frame_id": "lidar", "pose": pose(0.0, 0.0, 0.0), "point_stride": 16,
            "fields": fields, "data": points(k),
        }  # fmt: skip
        image = {"timestamp": time(k, 500), "frame_id": "front", "data": jpeg(), "format": "jpeg"}
        yield "/front/image/compressed", "CompressedImage", image
        yield "/front/calibration", "CameraCalibration", {
            "timestamp": time(k), "frame_id": "front", "width": 16, "height": 8, "distortion_model": "plumb_bob",
            "d": [0.01, -0.02, 0.0, 0.0, 0.0], "k": matrix, "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            "p": [*matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0],
        }  # fmt: skip
        posed = {"timestamp": time(k), "frame_id": "world", "pose": pose(2.0 * k, 1.25, 0.0, turned=True)}
        yield "/odometry/pose", "PoseInFrame", posed
        yield "/gnss/fix", "LocationFix", {
            "timestamp": time(k), "frame_id": "base_link", "latitude": 48.5 + 1e-5 * k, "longitude": 11.25,
            "altitude": 501.0, "position_covariance": [0.5, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 2.0],
            "position_covariance_type": 2,
        }  # fmt: skip
        cube = {"pose": pose(12.0 + k, 3.0, 0.75, turned=True), "size": xyz(4.5, 1.75, 1.5)}
        entity = {
            "timestamp": time(k), "frame_id": "world", "id": "car-1", "cubes": [cube],
            "metadata": [{"key": "label", "value": "car"}, {"key": "colour", "value": "dark blue"}],
        }  # fmt: skip
        gone = [{"timestamp": time(k), "type": 0, "id": "car-0"}]
        yield "/cuboids", "SceneUpdate", {"entities": [entity], "deletions": gone}
        corners = [{"x": x, "y": y} for x, y in ((2.0, 1.0), (8.0, 1.0), (8.0, 5.0 + k), (2.0, 5.0 + k))]
        drawn = {"timestamp": time(k, 500), "type": 2, "points": corners, "metadata": [{"key": "id", "value": "b"}]}
        yield "/front/annotations", "ImageAnnotations", {"points": [drawn]}


def schema_text(name):
    """The statements that a table needs, and the table as the root."""
    text = Path(__file__).with_name("foxglove.fbs").read_text()
    found = {one[2]: one[0] for one in re.findall(r"(?ms)^((struct|table|enum) (\w+)[^{]*\{.*?\}\n)", text)}
    needed, waiting = {}, [name]
    while waiting:
        one = waiting.pop()
        needed[one] = found[one]
        waiting += [word for word in found if word not in needed and re.search(rf"\b{word}\b", found[one])]
    parts = [statement for one, statement in found.items() if one in needed]
    return f"namespace foxglove;\n{''.join(parts)}root_type {name};\n"


def main(flatc, folder):
    rows = list(messages())
    (folder / "foxglove_flatbuffers.json").write_text(json.dumps(rows, separators=(",", ":")) + "\n")
    with tempfile.TemporaryDirectory() as work, (folder / "foxglove_flatbuffers.mcap").open("wb") as stream:
        writer, channels = Writer(stream, compression=CompressionType.ZSTD), {}
        writer.start(profile="", library="flatc")
        for topic, name, message in rows:
            schema = Path(work, f"{name}.fbs")
            if name not in channels:
                schema.write_text(schema_text(name))
                subprocess.run([flatc, "-b", "--schema", "-o", work, str(schema)], check=True)
                content = schema.with_suffix(".bfbs").read_bytes()
                number = writer.register_schema(f"foxglove.{name}", "flatbuffer", content)
                channels[name] = writer.register_channel(topic, "flatbuffer", number)
            Path(work, "message.json").write_text(json.dumps(message))
            subprocess.run([flatc, "-b", "-o", work, str(schema), f"{work}/message.json"], check=True)
            stamp = re.search(r'"sec": (\d+), "nsec": (\d+)', json.dumps(message))
            time_ns = int(stamp[1]) * 10**9 + int(stamp[2])
            writer.add_message(channels[name], time_ns, Path(work, "message.bin").read_bytes(), time_ns)
        writer.finish()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
