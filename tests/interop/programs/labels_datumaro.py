"""What Datumaro says of a data set of labels, and data sets that it writes.

`read PATH FORMAT` prints items with their annotations as JSON; `write FOLDER FORMAT` makes one with boxes, an outline,
a mask and a cuboid, as far as the format has these, and prints the same of it.
"""

import json
import sys

import numpy as np
from datumaro.components.annotation import AnnotationType, Bbox, Cuboid3d, Label, LabelCategories, Mask, Points, Polygon
from datumaro.components.dataset import Dataset
from datumaro.components.dataset_base import DatasetItem
from datumaro.components.media import Image, PointCloud

WIDTH, HEIGHT = 60, 40


def described(dataset):
    names = [one.name for one in dataset.categories()[AnnotationType.label].items]
    for item in dataset:
        found = []
        for one in item.annotations:
            row = {"type": one.type.name, "label": None if one.label is None else names[one.label], "id": one.id}
            row["attributes"] = dict(one.attributes)
            if isinstance(one, Mask):
                rows, columns = np.nonzero(one.image)
                row["mask"] = [int(columns.min()), int(rows.min()), int(columns.max()), int(rows.max()), len(rows)]
            elif isinstance(one, Cuboid3d):
                row |= {"position": [*one.position], "rotation": [*one.rotation], "scale": [*one.scale]}
            elif not isinstance(one, Label):
                row["points"] = [*map(float, one.points)]
            found.append(row)
        yield {"id": item.id, "attributes": dict(item.attributes), "annotations": found}


def written(folder, form):
    pixels = np.zeros((HEIGHT, WIDTH), bool)
    pixels[5:20, 7:30] = True
    pixels[10:12, 9:15] = False
    kinds = {
        "cvat": "bp", "coco": "bpm", "datumaro": "bpmk", "yolo": "b", "kitti_raw": "c",
    }[form]  # fmt: skip
    items = []
    for k in range(3):
        shapes = {
            "b": Bbox(1.25 + k, 2.5, 10, 8.5, label=0, id=k + 1, attributes={"track_id": 4, "occluded": False}),
            "p": Polygon([20, 5, 30.5, 6 + k, 25, 30], label=1, id=k + 11, attributes={"occluded": False}),
            "m": Mask(pixels, label=1, id=k + 21),
            "k": Points([5, 6, 7.5, 8], [2, 1], label=0, id=k + 31),
            "c": Cuboid3d(
                [1.0 + k, 2, 3], [0, 0, 0.25], [4, 2, 1.5], label=0, attributes={"track_id": 1, "occluded": False}
            ),
        }
        if form == "kitti_raw":
            media = PointCloud.from_bytes(data=b"")
        else:
            media = Image.from_numpy(data=np.full((HEIGHT, WIDTH, 3), 40 * k, np.uint8))
        chosen = [shapes[kind] for kind in kinds]
        items.append(DatasetItem(f"{k:06d}", subset="train", media=media, annotations=chosen, attributes={"frame": k}))
    categories = {AnnotationType.label: LabelCategories.from_iterable(["car", "road"])}
    kind = PointCloud if form == "kitti_raw" else Image
    dataset = Dataset.from_iterable(items, categories=categories, media_type=kind)
    dataset.export(folder, form, save_media=form != "kitti_raw")
    return dataset


command, location, name = sys.argv[1:]
dataset = Dataset.import_from(location, name) if command == "read" else written(location, name)
sys.stdout.write(json.dumps([*described(dataset)]) + "\n")
