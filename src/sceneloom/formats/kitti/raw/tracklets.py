"""Tracklets of KITTI's raw data: boxes in the lidar's frame through frames that follow each other, as XML."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import DataError
from sceneloom.formats.files import read_bytes
from sceneloom.formats.kitti.number_lines import LARGEST

FILE = "tracklet_labels.xml"

POSE_FIELDS = ("tx", "ty", "tz", "rx", "ry", "rz", "state", "occlusion", "occlusion_kf", "truncation")
FURTHER_FIELDS = ("amt_occlusion", "amt_occlusion_kf", "amt_border_l", "amt_border_r", "amt_border_kf")
"""What stands in each pose: location of the bottom's middle and angles in the lidar's frame, and how it is seen; in
further fields, what several annotators stated of it, which old files lack. Source: the development kit's
tracklets.h."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracklet:
    """One object.

    Attributes:
        label: its class.
        size_hwl: height, width, length [m].
        first_frame: number of its first frame.
        poses: (N, 15) float64, `POSE_FIELDS` and `FURTHER_FIELDS`, one row a frame; -1 where nothing is reported.
    """

    label: str
    size_hwl: tuple[float, float, float]
    first_frame: int
    poses: Float64Array


def read_tracklets(path: Path) -> list[Tracklet]:
    """Read a file of tracklets.

    Raises:
        DataError: it is no such file, or a number of it is none.
    """
    content = read_bytes(path)
    if re.search(rb"<!ENTITY", content):
        raise DataError(path, "", "declares entities; expected plain XML")
    try:
        root = ET.fromstring(content)  # noqa: S314 - entities, by which XML does harm, were refused
    except (ET.ParseError, ValueError, LookupError) as error:
        raise DataError(path, "", f"is no XML: {error}") from error
    listed = root.find("tracklets")
    if listed is None:
        raise DataError(path, root.tag, "holds no `tracklets`; expected boost_serialization/tracklets")
    return [_tracklet(path, f"tracklets/item[{k}]", item) for k, item in enumerate(listed.findall("item"))]


def _tracklet(path: Path, location: str, item: ET.Element) -> Tracklet:
    label = (item.findtext("objectType") or "").strip()
    if not label:
        raise DataError(path, location, "no objectType; expected a class, as Car")
    height, width, length = (_number(path, location, item, name) for name in "hwl")
    if min(height, width, length) <= 0:
        raise DataError(path, location, f"h {height:g}, w {width:g}, l {length:g}; expected sizes above 0")
    first = _number(path, location, item, "first_frame")
    if first != int(first) or first < 0:
        raise DataError(path, f"{location}/first_frame", f"{first:g}; expected a whole number of 0 or more")
    poses = item.find("poses")
    rows = [] if poses is None else poses.findall("item")
    if not rows:
        raise DataError(path, f"{location}/poses", "holds none; expected one for each frame")
    return Tracklet(label, (height, width, length), int(first), _poses(path, f"{location}/poses", rows))


def _poses(path: Path, location: str, rows: Sequence[ET.Element]) -> Float64Array:
    values = np.full((len(rows), len(POSE_FIELDS) + len(FURTHER_FIELDS)), -1.0)
    for k, row in enumerate(rows):
        for column, name in enumerate(POSE_FIELDS):
            values[k, column] = _number(path, f"{location}/item[{k}]", row, name)
        for column, name in enumerate(FURTHER_FIELDS, len(POSE_FIELDS)):
            if row.find(name) is not None:
                values[k, column] = _number(path, f"{location}/item[{k}]", row, name)
    return values


def _number(path: Path, location: str, item: ET.Element, name: str) -> float:
    text = item.findtext(name)
    try:
        value = float(text or "")
    except ValueError:
        value = float("nan")
    if not abs(value) <= LARGEST:
        shown = "nothing" if text is None else repr(text[:40])
        raise DataError(path, f"{location}/{name}", f"{shown}; expected a number within ±{LARGEST:g}")
    return value


def format_tracklets(tracklets: Sequence[Tracklet]) -> str:
    """The text of a file of tracklets, as boost's archives have it."""
    lines = [
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>',
        "<!DOCTYPE boost_serialization>",
        '<boost_serialization signature="serialization::archive" version="9">',
        '<tracklets class_id="0" tracking_level="0" version="0">',
        f"\t<count>{len(tracklets)}</count>",
        "\t<item_version>1</item_version>",
    ]
    for k, tracklet in enumerate(tracklets):
        lines += _tracklet_lines(tracklet, is_first=k == 0)
    return "\n".join([*lines, "</tracklets>", "</boost_serialization>", ""])


def _tracklet_lines(tracklet: Tracklet, *, is_first: bool) -> list[str]:
    from xml.sax.saxutils import escape

    head, pose_head, list_head = "", "", ""
    if is_first:
        head, list_head = (f' class_id="{n}" tracking_level="0" version="{v}"' for n, v in ((1, 1), (2, 0)))
        pose_head = ' class_id="3" tracking_level="0" version="1"'
    height, width, length = tracklet.size_hwl
    lines = [
        f"\t<item{head}>",
        f"\t\t<objectType>{escape(tracklet.label)}</objectType>",
        f"\t\t<h>{height!r}</h>",
        f"\t\t<w>{width!r}</w>",
        f"\t\t<l>{length!r}</l>",
        f"\t\t<first_frame>{tracklet.first_frame}</first_frame>",
        f"\t\t<poses{list_head}>",
        f"\t\t\t<count>{len(tracklet.poses)}</count>",
        "\t\t\t<item_version>2</item_version>",
    ]
    for k, row in enumerate(tracklet.poses.tolist()):
        lines.append(f"\t\t\t<item{pose_head if k == 0 else ''}>")
        fields = zip((*POSE_FIELDS, *FURTHER_FIELDS), row, strict=True)
        lines += [f"\t\t\t\t<{name}>{_text(name, value)}</{name}>" for name, value in fields]
        lines.append("\t\t\t</item>")
    return [*lines, "\t\t</poses>", "\t\t<finished>1</finished>", "\t</item>"]


def _text(name: str, value: float) -> str:
    """A number of a pose: states are whole."""
    return repr(value) if name in POSE_FIELDS[:6] or value != int(value) else str(int(value))
