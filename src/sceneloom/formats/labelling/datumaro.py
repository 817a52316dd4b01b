"""Datumaro's JSON, read and written: what is drawn in images, and cuboids in point clouds.

Source: "Datumaro format" of the documentation of Datumaro.
"""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.errors import DataError
from sceneloom.formats.base.losses import Losses, LossReport, field_losses
from sceneloom.formats.base.output import FolderKind
from sceneloom.formats.labelling.drawn import (
    KEYFRAME,
    MOST_FOLDERS,
    RBBOX,
    TRACK,
    Drawn,
    Frame,
    Json,
    Kind,
    Labels,
    Sheet,
    corners_of,
    image_roots,
    ordered_points,
    take_attributes,
)
from sceneloom.formats.labelling.spec import DATUMARO, DATUMARO_FILES, file_in, is_datumaro
from sceneloom.geometry.euler import AngleUnit, cuboid_angles_from_rotation, rotation_from_cuboid_angles
from sceneloom.geometry.rigid import matrix_from_quaternion, quaternion_from_matrix
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import key_of

_ORDER = "xyz"  # of the three angles: Rx Ry Rz, that of three.js, with which CVAT draws


def read_datumaro(path: Path, *, lenient: bool = False, rate_hz: float | str | None = None) -> Scene:
    """Read a file, or the one in a folder.

    Args:
        rate_hz: frames per second where nothing states times.

    Raises:
        OptionError: the rate is no number above 0.
        DataError: it is no such file, or there are several in the folder.
    """
    files = [one for one in file_in(path, *DATUMARO_FILES) if is_datumaro(one)]
    if len(files) != 1:
        names = ", ".join(str(one.relative_to(path)) for one in files)
        raise DataError(path, "", f"{names or 'no file of Datumaro'}; expected the path of one file")
    labels = Labels.of(files[0], "datumaro", lenient=lenient, rate_hz=rate_hz)
    labels.roots = image_roots(files[0], files[0].stem)
    with labels.ledger.telling():
        _read(Json.read(files[0]), labels)
        return labels.scene()


def _read(document: Json, labels: Labels) -> None:
    classes = [dict(one.members()) for one in document["categories"]["label"]["labels"].each()] if (
        "label" in document["categories"]
    ) else []  # fmt: skip
    names = [str(one.get("name", k)) for k, one in enumerate(classes)]
    labels.spec = {"tool": "datumaro", "labels": names, "datumaro": classes} if names else {}
    points: dict[int, tuple[str, ...]] = {}
    for entry in document["categories"]["points"]["items"].each() if "points" in document["categories"] else ():
        points[entry["label_id"].whole()] = tuple(one.text() for one in entry["labels"].each())
    items = list(document["items"].each())
    stated = Counter(
        one["id"].value for item in items for one in item["annotations"].each() if type(one["id"].value) is int
    )
    for k, item in enumerate(items):
        frame = labels.add_frame(_frame(item, k))
        for annotation in item["annotations"].each():
            try:
                one = _of_annotation(annotation, frame, names, points, labels)
                if one is None:
                    continue
                identifier = annotation["id"].value
                if one.track is None and type(identifier) is int and identifier > 0 and stated[identifier] == 1:
                    one.track = identifier
                labels.drawn.append(one)
            except DataError as error:
                labels.ledger.fault("annotations", error)


def _frame(item: Json, k: int) -> Frame:
    attributes = item["attr"]
    number = attributes["frame"].whole(k) if attributes.value is not None else k
    time_ns = attributes["timestamp_ns"].value if attributes.value is not None else None
    stated = time_ns if type(time_ns) is int else None
    if "point_cloud" in item:
        return Frame(number, item["point_cloud"]["path"].text(""), 0, 0, stated, cloud=True)
    if "image" in item:
        image = item["image"]
        height, width = (int(one) for one in image["size"].numbers(2)) if "size" in image else (0, 0)
        return Frame(number, image["path"].text("") or f"{item['id'].text('')}.jpg", width, height, stated)
    return Frame(number, f"{item['id'].text('')}.jpg", 0, 0, stated)


_FLAT = ("polygon", "polyline", "points")


def _of_annotation(
    annotation: Json, frame: int, classes: list[str], points: Mapping[int, tuple[str, ...]], labels: Labels
) -> Drawn | None:
    label_id = annotation["label_id"].value
    label = classes[label_id] if type(label_id) is int and 0 <= label_id < len(classes) else None
    if label is None and label_id is not None:
        labels.skipped("labels", annotation["label_id"].location, "numbers of classes that the file does not name")
    kind = annotation["type"].text()
    one = Drawn(Kind.TAG, frame, None, label)
    match kind:
        case "label":
            pass
        case "caption":
            one.attributes["caption"] = annotation["caption"].text()
        case "bbox":
            one.kind, one.values = Kind.BOX, annotation["bbox"].numbers(4)
        case "mask":
            one.kind, one.values = Kind.MASK, annotation["rle"].mask()
        case "cuboid_3d":
            angles = annotation["rotation"].numbers(3)
            rotation = rotation_from_cuboid_angles(angles, unit=AngleUnit.RADIANS, order=_ORDER)
            parts = annotation["position"].numbers(3), annotation["scale"].numbers(3), quaternion_from_matrix(rotation)
            one.kind, one.values = Kind.CUBOID, np.concatenate(parts)
        case "skeleton" | "points" | "polygon" | "polyline":
            _take_vertices(one, annotation, kind, points.get(label_id, ()) if label is not None else ())
        case _:
            message = f"annotations of the type {kind[:40]!r} are not read"
            labels.skipped("types-unknown", annotation.location, message)
            return None
    take_attributes(one, annotation["attributes"].members(), labels)
    for name, field in (("z_order", "z_order"), ("group_id", "group")):
        if found := annotation[field].whole(0):
            one.attributes[name] = found
    return one


def _take_vertices(one: Drawn, annotation: Json, kind: str, names: tuple[str, ...]) -> None:
    values, width = annotation["points"].numbers(), 3 if kind == "skeleton" else 2
    if len(values) % width or not len(values):
        raise annotation["points"].fault("triples x, y, visibility" if width == 3 else "pairs x, y")
    rows = values.reshape(-1, width)
    if RBBOX in annotation:
        row = annotation[RBBOX].numbers(5)
        one.kind, one.values = Kind.ROTATED, np.array([*row[:4], np.radians(row[4])])
    elif kind in ("polygon", "polyline"):
        one.kind, one.values = Kind(kind), rows
    else:
        seen = annotation["visibility"].numbers(len(rows)) if kind == "points" and "visibility" in annotation else None
        flags = rows[:, 2] if width == 3 else np.full(len(rows), 2.0) if seen is None else seen
        if not np.isin(flags, (0, 1, 2)).all():
            raise annotation["visibility"].fault("0, 1 or 2 for each point")
        one.kind, one.values = Kind.POINTS, np.column_stack([rows[:, :2], flags])
        one.names = names if len(names) == len(rows) else ()


# writing

_FOLDER = FolderKind(
    "folder of Datumaro",
    (
        "annotations/default\\.json",
        *("/".join(["images", "default", *[".*"] * depth]) for depth in range(1, MOST_FOLDERS + 1)),
    ),
    marker="annotations/default\\.json",
)


def write_datumaro(scene: Scene, path: Path, *, images: str = "copy", overwrite: bool = False) -> LossReport:
    """Write a file, or a folder with annotations/default.json and images/default where the path is no `.json`.

    Cuboids are in items of their own, one for each sweep of the first lidar, in the frame of the scene's annotations.

    Args:
        images: "copy" writes images into the folder, "none" their names only.

    Raises:
        OptionError: there is no such choice.
        OutputError: the output exists, or cannot be written.
    """
    sheet = Sheet.of(scene, Losses(field_losses(scene, DATUMARO.supports)), cuboids=True)
    content = msgspec.json.encode(_document(sheet))

    def write(draft: Path) -> None:
        draft.write_bytes(content)

    return sheet.write(
        path, ".json", "annotations/default.json", _FOLDER, write,
        images=images, overwrite=overwrite, folder="images/default",
    )  # fmt: skip


def _document(sheet: Sheet) -> dict[str, Any]:
    names, classes = sheet.point_names(), sheet.labels()
    listed = sheet.spec().get("datumaro")
    stated = {one.get("name"): one for one in listed if isinstance(one, Mapping)} if isinstance(listed, list) else {}
    found: dict[str | None, dict[str, None]] = {}
    for drawn in sheet.drawn:
        for one in drawn:
            found.setdefault(one.label, {}).update(dict.fromkeys(one.attributes))
    labels = [
        {"name": name, "parent": "", **stated.get(name, {}), "attributes": list(found.get(name, {}))}
        for name in classes
    ]
    points = [
        {"label_id": classes.index(name), "labels": listed, "joints": []} for name, listed in names.items() if name
    ]
    own, items, number = sheet.identified(), [], 0
    taken = {key[1] for key in own}
    for frame, drawn in zip(sheet.frames, sheet.drawn, strict=True):
        annotations = []
        for one in drawn:
            is_own = one.track is not None and key_of(one.track) in own
            number += not is_own
            while not is_own and number in taken:
                number += 1
            annotations.append(
                {
                    "id": one.track if is_own else number,
                    "type": "",
                    "attributes": {
                        **{
                            name: value for name, value in one.attributes.items() if name not in ("z_order", "group_id")
                        },
                        **({} if is_own else {TRACK: one.track}),
                        **({} if one.keyframe else {KEYFRAME: False}),
                    },
                    "group": one.attributes.get("group_id", 0),
                    "label_id": None if one.label is None else classes.index(one.label),
                    "z_order": one.attributes.get("z_order", 0),
                    **_fields(one, names.get(one.label or "", [])),
                }
            )
        path = frame.name
        media = (
            {"point_cloud": {"path": path}}
            if frame.cloud
            else {"image": {"path": path, **({"size": [frame.height, frame.width]} if frame.height else {})}}
        )
        attr = {"frame": frame.number, "timestamp_ns": frame.timestamp_ns}
        items.append({"id": path.rpartition(".")[0] or path, "annotations": annotations, "attr": attr, **media})
    clouds, all_of = sum(frame.cloud for frame in sheet.frames), len(sheet.frames)
    return {
        "dm_format_version": "1.0",
        "media_type": 2 if not clouds else 6 if clouds == all_of else 1,
        "info": {},
        "categories": {
            "label": {"labels": labels, "attributes": []},
            **({"points": {"items": points}} if points else {}),
        },
        "items": items,
    }


def _fields(one: Drawn, names: list[str]) -> dict[str, Any]:  # noqa: PLR0911 - one for each kind
    match one.kind:
        case Kind.BOX:
            return {"type": "bbox", "bbox": one.values.tolist()}
        case Kind.MASK:
            return {"type": "mask", "rle": one.values.record()}
        case Kind.POLYGON | Kind.POLYLINE:
            return {"type": str(one.kind), "points": one.values.reshape(-1).tolist()}
        case Kind.ROTATED:
            rbbox = [*one.values[:4].tolist(), float(np.degrees(one.values[4]))]
            return {"type": "polygon", "points": corners_of(one.values).reshape(-1).tolist(), RBBOX: rbbox}
        case Kind.POINTS:
            rows = ordered_points(one, names)
            flags = [int(flag) for flag in rows[:, 2]]
            return {"type": "points", "points": rows[:, :2].reshape(-1).tolist(), "visibility": flags}
        case Kind.CUBOID:
            rotation = matrix_from_quaternion(one.values[6:])
            angles = cuboid_angles_from_rotation(rotation, unit=AngleUnit.RADIANS, order=_ORDER)
            position, scale = one.values[:3].tolist(), one.values[3:6].tolist()
            return {"type": "cuboid_3d", "position": position, "rotation": angles.tolist(), "scale": scale}
        case _:
            is_caption = isinstance(one.attributes.get("caption"), str)
            return {"type": "caption", "caption": one.attributes["caption"]} if is_caption else {"type": "label"}
