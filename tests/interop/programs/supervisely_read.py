"""Read a project with Supervisely's package, and print where it has cuboids, tags, points and images."""

import json
import sys

import supervisely as sly

kind = {"episodes": sly.PointcloudEpisodeProject, "clouds": sly.PointcloudProject}[sys.argv[2]]
project = kind(sys.argv[1], sly.OpenMode.READ)
reported = {"classes": {c.name: c.geometry_type.geometry_name() for c in project.meta.obj_classes}, "datasets": {}}


def vector(value):
    return [value.x, value.y, value.z]


def figure_row(figure):
    geometry = figure.geometry
    row = {"object": figure.parent_object.key().hex, "label": figure.parent_object.obj_class.name}
    if geometry.geometry_name() == "cuboid_3d":
        return row | {name: vector(getattr(geometry, name)) for name in ("position", "rotation", "dimensions")}
    return row | {"indices": list(geometry.indices)}


def tag_row(tag):
    return [tag.meta.name, tag.value, getattr(tag, "frame_range", None)]


for dataset in project.datasets:
    frames, tags = [], {}
    names = list(dataset.get_items_names())
    if sys.argv[2] == "episodes":
        annotation = dataset.get_ann(project.meta)
        by_index = {frame.index: frame for frame in annotation.frames}
        names.sort(key=dataset.get_frame_idx)
        frames = [[figure_row(f) for f in by_index[k].figures] if k in by_index else [] for k in range(len(names))]
        tags = {o.key().hex: [tag_row(t) for t in o.tags] for o in annotation.objects}
        tags["dataset"] = [tag_row(t) for t in annotation.tags]
    else:
        names.sort()  # a project of clouds has no order
        for name in names:
            annotation = dataset.get_ann(name, project.meta)
            frames.append([figure_row(f) for f in annotation.figures])
    images = {}
    for name in names:
        for path, info in dataset.get_related_images(name):
            images[path.split("/")[-1]] = info["meta"]
    reported["datasets"][dataset.name] = {"names": names, "frames": frames, "tags": tags, "images": images}
sys.stdout.write("\n" + json.dumps(reported))
