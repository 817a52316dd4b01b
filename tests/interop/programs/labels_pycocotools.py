"""What pycocotools says of a file of COCO: of each annotation its box, and the pixels of its mask."""

import json
import sys
from contextlib import redirect_stdout

import numpy as np
from pycocotools.coco import COCO

with redirect_stdout(sys.stderr):
    coco = COCO(sys.argv[1])
rows = []
for one in coco.loadAnns(coco.getAnnIds()):
    row = {"image": coco.imgs[one["image_id"]]["file_name"], "box": one["bbox"], "attributes": one["attributes"]}
    if isinstance(one["segmentation"], dict):
        ys, xs = np.nonzero(coco.annToMask(one))
        row["mask"] = [int(xs.min()), int(ys.min()), int(xs.max()), int(ys.max()), len(xs)]
    elif one["segmentation"]:
        row["pixels"] = int(coco.annToMask(one).sum())
    if one.get("keypoints"):
        row["keypoints"] = one["keypoints"]
    rows.append(row)
sys.stdout.write(json.dumps(rows) + "\n")
