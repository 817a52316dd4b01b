"""COCO: instances and keypoints, read and written, with ids of tracks as custom fields.

Source: "Data format" of cocodataset.org, and the COCO API; `track_id` as in CVAT's and TAO's files.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import DataError
from sceneloom.formats.base.losses import Losses, LossReport, field_losses
from sceneloom.formats.base.output import FolderKind
from sceneloom.formats.labelling.drawn import (
    MOST_FOLDERS,
    RBBOX,
    TRACK,
    Drawn,
    Frame,
    Json,
    Kind,
    Labels,
    Sheet,
    bounds_of,
    corners_of,
    image_roots,
    json_attributes,
    ordered_points,
    take_attributes,
)
from sceneloom.formats.labelling.spec import COCO, COCO_FILES, file_in, is_coco
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import key_of

_KNOWN = {"id", "image_id", "category_id", "bbox", "segmentation", "area", "iscrowd", "keypoints", "num_keypoints",
    "attributes", RBBOX, "polyline"}  # fmt: skip
_DERIVED_PX = 1.0
"""A box within a pixel of what masks, polygons or keypoints cover is theirs, and not stated besides [px]."""


def read_coco(path: Path, *, lenient: bool = False, rate_hz: float | str | None = None) -> Scene:
    """Read a file, or the one in a folder.

    Args:
        rate_hz: frames per second where nothing states times.

    Raises:
        OptionError: the rate is no number above 0.
        DataError: it is no such file, or there are several in the folder.
    """
    files = [one for one in file_in(path, *COCO_FILES) if is_coco(one)]
    if len(files) > 1:  # Datumaro writes several of one data set
        files = [one for one in files if one.name.startswith("instances_")] or files
    if len(files) != 1:
        names = ", ".join(str(one.relative_to(path)) for one in files)
        raise DataError(path, "", f"{names or 'no file of COCO'}; expected the path of one file")
    file = files[0]
    labels = Labels.of(file, "coco", lenient=lenient, rate_hz=rate_hz)
    subset = file.stem.partition("_")[2]
    labels.roots = image_roots(file, subset, file.stem, "default", "train", "val", "test")
    with labels.ledger.telling():
        _read(Json.read(file), labels)
        return labels.scene()


def _read(document: Json, labels: Labels) -> None:
    categories: dict[int, Json] = {}
    for category in document["categories"].each():
        categories[category["id"].whole()] = category
        category["name"].text()
    frames: dict[Any, int] = {}
    for k, image in enumerate(document["images"].each()):
        time_ns = image["timestamp_ns"].value
        frames[image["id"].identifier()] = labels.add_frame(
            Frame(
                image["frame_id"].whole(k), image["file_name"].text(""), image["width"].whole(0),
                image["height"].whole(0), time_ns if type(time_ns) is int else None,
            )
        )  # fmt: skip
    listed = [dict(category.members()) for category in categories.values()]
    labels.spec = {"tool": "coco", "labels": [one["name"] for one in listed], "coco": listed}
    for annotation in document["annotations"].each():
        try:
            if "segments_info" in annotation:
                message = "masks of panoptic files are in PNG files, which are not read"
                labels.skipped("panoptic", annotation.location, message)
                continue
            image_id = annotation["image_id"]
            if image_id.identifier() not in frames:
                raise image_id.fault("the id of an image")
            category_id = annotation["category_id"]
            if category_id.value is not None and category_id.whole() not in categories:
                raise category_id.fault("the id of a category")
            stated = categories.get(category_id.value)
            labels.drawn += _of_annotation(annotation, frames[image_id.value], stated, labels)
        except DataError as error:
            labels.ledger.fault("annotations", error)


def _of_annotation(annotation: Json, frame: int, category: Json | None, labels: Labels) -> list[Drawn]:
    """The shapes of an annotation, all of one object."""
    label = None if category is None else category["name"].text() or None
    shapes = list(_shapes(annotation, category))
    found = [Drawn(kind, frame, values, label, names=names, part=part) for kind, values, names, part in shapes]
    if not found and "caption" in annotation:
        found = [Drawn(Kind.TAG, frame, None, label)]
    members = {name: value for name, value in annotation.members().items() if name not in _KNOWN}
    own = annotation["id"].value
    for one in found:
        one.track = own if isinstance(own, str | int) and not isinstance(own, bool) else None
        take_attributes(one, {**annotation["attributes"].members(), **members}, labels)
        if annotation["iscrowd"].value == 1:
            one.attributes["iscrowd"] = True
    return found


_Shape = tuple[Kind, Any, tuple[str, ...], int]


def _shapes(annotation: Json, category: Json | None) -> Iterator[_Shape]:
    covered: list[Float64Array] = []
    segmentation = annotation["segmentation"]
    if RBBOX in annotation:
        row = annotation[RBBOX].numbers(5)
        covered.append(bounds_of(corners_of(np.array([*row[:4], np.radians(row[4])]))))
        yield Kind.ROTATED, np.array([*row[:4], np.radians(row[4])]), (), 1
    elif isinstance(segmentation.value, dict):
        mask = segmentation.mask()
        covered.append(mask.box())
        yield Kind.MASK, mask, (), 1
    else:
        rings = [_vertices(ring) for ring in segmentation.each()]
        if rings:
            covered.append(bounds_of(np.concatenate(rings)))
        yield from ((Kind.POLYGON, ring, (), k) for k, ring in enumerate(rings, 1))
    keypoints = annotation["keypoints"]
    if keypoints.value:
        points = keypoints.numbers()
        if len(points) % 3:
            raise keypoints.fault("triples x, y, visibility")
        points = points.reshape(-1, 3)
        if not np.isin(points[:, 2], (0, 1, 2)).all():
            raise keypoints.fault("visibilities of 0, 1 or 2")
        listed = None if category is None else category["keypoints"].value
        names = listed if isinstance(listed, list) and len(listed) == len(points) else range(len(points))
        if (points[:, 2] > 0).any():
            covered.append(bounds_of(points[points[:, 2] > 0]))
        yield Kind.POINTS, points, tuple(map(str, names)), 1
    box = annotation["bbox"]
    if box.value:
        row = box.numbers(4)
        if not any(np.abs(row - other).max() <= _DERIVED_PX for other in covered):
            yield Kind.BOX, row, (), 1


def _vertices(ring: Json) -> Float64Array:
    found = ring.numbers()
    if len(found) % 2 or len(found) < 2:
        raise ring.fault("pairs x, y")
    return found.reshape(-1, 2)


# writing

_FOLDER = FolderKind(
    "folder of COCO",
    (
        "annotations/instances_default\\.json",
        *("/".join(["images", *[".*"] * depth]) for depth in range(1, MOST_FOLDERS + 1)),
    ),
    marker="annotations/instances_default\\.json",
)


def write_coco(scene: Scene, path: Path, *, images: str = "copy", overwrite: bool = False) -> LossReport:
    """Write a file, or a folder with annotations/instances_default.json and images where the path is no `.json`.

    Args:
        images: "copy" writes images into the folder, "none" their names only.

    Raises:
        OptionError: there is no such choice.
        OutputError: the output exists, or cannot be written.
    """
    sheet = Sheet.of(scene, Losses(field_losses(scene, COCO.supports)))
    content = msgspec.json.encode(_document(sheet))

    def write(draft: Path) -> None:
        draft.write_bytes(content)

    return sheet.write(
        path, ".json", "annotations/instances_default.json", _FOLDER, write,
        images=images, overwrite=overwrite,
    )  # fmt: skip


def _document(sheet: Sheet) -> dict[str, Any]:
    names, listed = sheet.point_names(), sheet.spec().get("coco")
    stated = {one.get("name"): one for one in listed if isinstance(one, Mapping)} if isinstance(listed, list) else {}
    unlabelled = any(one.label is None for drawn in sheet.drawn for one in drawn)
    free = max([one["id"] for one in stated.values() if type(one.get("id")) is int], default=0) + 1
    categories: dict[str, dict[str, Any]] = {}
    for name in [*sheet.labels(), *([""] if unlabelled else [])]:
        category = {"id": free, "name": name, "supercategory": "", **stated.get(name, {})}
        if name in names and len(category.get("keypoints") or ()) < len(names[name]):
            category |= {"keypoints": names[name], "skeleton": category.get("skeleton") or []}
        free += category["id"] == free
        categories[name] = category
    sheet.report_kinds(Kind.POLYLINE, what="a polyline has no field in COCO")
    sheet.report_kinds(Kind.TAG, what="a class of an image has no field in COCO")
    annotations: list[dict[str, Any]] = []
    own, number = sheet.identified(), 0
    taken = {key[1] for key in own}
    for k, drawn in enumerate(sheet.drawn):
        for parts in _objects(drawn):
            first = parts[0]
            number += 1
            while number in taken:
                number += 1
            track: dict[str, Any] = {}
            annotation = {"id": number, "image_id": k + 1, "category_id": categories[first.label or ""]["id"]}
            if first.track is not None and key_of(first.track) in own:
                annotation["id"] = first.track
                number -= 1
            else:
                track = {TRACK: first.track}
            annotations.append(annotation | _fields(parts, names.get(first.label or "", []), track))
    frames = [
        {
            "id": k + 1, "file_name": frame.name, "width": frame.width, "height": frame.height,
            "frame_id": frame.number, "timestamp_ns": frame.timestamp_ns,
        }
        for k, frame in enumerate(sheet.frames)
    ]  # fmt: skip
    return {
        "info": {"description": ""},
        "licenses": [],
        "categories": [*categories.values()],
        "images": frames,
        "annotations": annotations,
    }


def _objects(drawn: list[Drawn]) -> Iterator[list[Drawn]]:
    """The shapes of each object in a frame, in lists that an annotation holds: all but two boxes or two masks."""
    objects: dict[Any, list[Drawn]] = {}
    for one in drawn:
        if one.kind not in (Kind.POLYLINE, Kind.TAG):
            alone = one.kind not in (Kind.BOX, Kind.POINTS, Kind.POLYGON) or (
                one.kind is not Kind.POLYGON and one.part > 1
            )
            objects.setdefault(
                (key_of(one.track or ""), one.label, (one.kind, one.part) if alone else None), []
            ).append(one)
    yield from objects.values()


def _fields(parts: list[Drawn], names: list[str], track: dict[str, Any]) -> dict[str, Any]:
    fields: dict[str, Any] = {"segmentation": [], "iscrowd": 0}
    attributes: dict[str, Any] = {}
    box: Float64Array | None = None
    area = 0.0
    for one in parts:
        attributes |= json_attributes(one)
        match one.kind:
            case Kind.BOX:
                box = one.values
            case Kind.MASK:
                fields["segmentation"] = one.values.record()
                box, area = one.values.box(), float(one.values.area)
            case Kind.POLYGON:
                fields["segmentation"].append(one.values.reshape(-1).tolist())
                area += _area(one.values)
            case Kind.ROTATED:
                corners = corners_of(one.values)
                fields["segmentation"] = [corners.reshape(-1).tolist()]
                fields[RBBOX] = [*one.values[:4].tolist(), float(np.degrees(one.values[4]))]
                area, box = _area(corners), bounds_of(corners)
            case _:
                points = ordered_points(one, names)
                fields["keypoints"] = points.reshape(-1).tolist()
                fields["num_keypoints"] = int((points[:, 2] > 0).sum())
    if box is None:
        shown = [one.values[one.values[:, 2] > 0] for one in parts if one.kind is Kind.POINTS]
        rows = [one.values for one in parts if one.kind is Kind.POLYGON] or [row for row in shown if len(row)]
        box = bounds_of(np.concatenate([row[:, :2] for row in rows])) if rows else np.zeros(4)
    if attributes.pop("iscrowd", None) is True:
        fields["iscrowd"] = 1
    return {**fields, "bbox": box.tolist(), "area": area or float(box[2] * box[3]), "attributes": attributes | track}


def _area(ring: Float64Array) -> float:
    x, y = ring.T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2)
