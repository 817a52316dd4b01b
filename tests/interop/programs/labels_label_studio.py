"""What the SDK of Label Studio says of tasks: masks of brushes, boxes of videos by frames; and a brush of its own."""

import json
import sys
from pathlib import Path

import numpy as np
from label_studio_sdk._extensions.label_studio_tools.postprocessing.video import extract_key_frames
from label_studio_sdk.converter import brush

found = {"masks": {}, "videos": {}}
for path in sys.argv[1:]:
    for task in json.loads(Path(path).read_text("utf-8")):
        results = task["annotations"][0]["result"]
        for one in results:
            if one["type"] == "brushlabels":
                shape = (one["original_height"], one["original_width"], 4)
                ys, xs = np.nonzero(np.reshape(brush.decode_rle(one["value"]["rle"]), shape)[:, :, 3])
                found["masks"][one["id"]] = [int(xs.min()), int(ys.min()), int(xs.max()), int(ys.max()), len(xs)]
        for one in extract_key_frames([one for one in results if one["type"] == "videorectangle"]):
            size = one["original_width"], one["original_height"]
            rows = {
                row["frame"]: [row[key] * size[k % 2] / 100 for k, key in enumerate(("x", "y", "width", "height"))]
                for row in one["value"]["sequence"]
            }
            found["videos"][one["id"]] = rows
pixels = np.zeros((48, 64), np.uint8)
pixels[5:20, 7:30] = 255
pixels[10:12, 9:15] = 0
found["brush"] = list(map(int, brush.mask2rle(pixels)))
sys.stdout.write(json.dumps(found) + "\n")
