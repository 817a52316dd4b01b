"""Read a release with the models of Segments.ai's package, and print what these hold of it."""

import json
import sys
from pathlib import Path

from segments import typing as models

release = json.loads(Path(sys.argv[1]).read_text("utf-8"))
dataset = release["dataset"]
sample = dataset["samples"][0]
label = sample["labels"]["ground-truth"]["attributes"]
kind = {
    "pointcloud-cuboid-sequence": models.PointcloudSequenceCuboidLabelAttributes,
    "pointcloud-segmentation-sequence": models.PointcloudSequenceSegmentationLabelAttributes,
}[dataset["task_type"]]
reported = {
    "sample": models.PointcloudSequenceSampleAttributes(**sample["attributes"]).model_dump(mode="json"),
    "label": kind(**label).model_dump(mode="json"),
    "task": models.TaskAttributes(**dataset["task_attributes"]).model_dump(mode="json"),
    "type": models.TaskType(dataset["task_type"]).value,
}
sys.stdout.write("\n" + json.dumps(reported))
