"""Lists of boxes in images, as CSV with a header or as JSON, as detectors of faces and licence plates write them."""

import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.editing.redact import ImageBox
from sceneloom.errors import DataError
from sceneloom.formats.base.files import read_bytes

_ALIASES: Mapping[str, str] = MappingProxyType(
    {
        "camera_id": "camera",
        "sensor": "camera",
        "sensor_id": "camera",
        "frame": "number",
        "picture": "number",
        "image": "number",
        "xmin": "x1",
        "ymin": "y1",
        "xmax": "x2",
        "ymax": "y2",
        "right": "x2",
        "bottom": "y2",
        "left": "x1",
        "top": "y1",
        "id": "track",
        "track_id": "track",
        "class": "label",
        "type": "label",
        "w": "width",
        "h": "height",
    }
)
"""Other words for the columns."""

_COLUMNS = (
    "camera, number or time or timestamp_ns, x1, y1, x2, y2 (or left, top, width, height), track, label"
)

_MOST_SECONDS = 9_000_000_000

_MOST_DIGITS = 40
"""What has more is no number or time of an image, and 1e99999999 would take hours to write out."""


def read_image_boxes(path: str | Path) -> tuple[ImageBox, ...]:
    """Read a list of boxes.

    A row names the camera's id (not needed where there is one camera), the image by its `number` from 0, its `time`
    [s] or its `timestamp_ns` on the scene's clock, and two corners [px], the image's own corner being (0, 0). Rows
    of one `track` are one thing. JSON holds such rows as objects in a list, or in a list named `boxes`.

    Raises:
        DataError: the file is neither, or a row of it cannot be followed.
    """
    location = Path(path)
    if not location.is_file():
        raise DataError(location, "", "no such file; expected a list of boxes as CSV or JSON")
    try:
        text = read_bytes(location).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(location, f"byte {error.start}", "is no UTF-8; expected CSV or JSON") from error
    is_json = text.lstrip()[:1] in {"[", "{"}
    rows = _json_rows(location, text) if is_json else _csv_rows(location, text)
    return tuple(_box(location, where, row) for where, row in rows)


def _json_rows(path: Path, text: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError(path, "", f"is no JSON: {error}") from error
    rows = found.get("boxes") if isinstance(found, dict) else found
    if not isinstance(rows, list):
        raise DataError(path, "", "expected a list of boxes, or an object with such a list as `boxes`")
    for k, row in enumerate(rows):
        if not isinstance(row, dict):
            raise DataError(path, f"boxes[{k}]", f"{row!r:.40}; expected an object with {_COLUMNS}")
        yield f"boxes[{k}]", _named(row)


def _csv_rows(path: Path, text: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    reader = csv.DictReader(text.splitlines(), skipinitialspace=True)
    try:
        columns = _named(dict.fromkeys(reader.fieldnames or ()))
        if not _says_corners(columns):
            raise DataError(path, "line 1", f"columns {', '.join(columns) or 'none'}; expected {_COLUMNS}")
        for row in reader:
            if None in row or None in row.values():
                raise DataError(
                    path, f"line {reader.line_num}", "has more or fewer values than there are columns"
                )
            yield f"line {reader.line_num}", _named(row)
    except csv.Error as error:
        raise DataError(path, f"line {reader.line_num}", f"is no CSV: {error}") from error


def _named(row: Mapping[str, Any]) -> dict[str, Any]:
    words = {str(name).strip().lower(): value for name, value in row.items()}
    return {_ALIASES.get(name, name): value for name, value in words.items()}


def _says_corners(row: Mapping[str, Any]) -> bool:
    return {"x1", "y1"} <= row.keys() and ({"x2", "y2"} <= row.keys() or {"width", "height"} <= row.keys())


def _box(path: Path, where: str, row: Mapping[str, Any]) -> ImageBox:
    if isinstance(row.get("box"), Sequence) and len(row["box"]) == 4 and not isinstance(row["box"], str):
        row = {**row, **dict(zip(("x1", "y1", "x2", "y2"), row["box"], strict=True))}
    if not _says_corners(row):
        raise DataError(path, where, f"has {', '.join(row)}; expected {_COLUMNS}")
    left, top = _number(path, where, row, "x1"), _number(path, where, row, "y1")
    if _there(row, "x2"):
        right, bottom = _number(path, where, row, "x2"), _number(path, where, row, "y2")
    else:
        right = left + _number(path, where, row, "width")
        bottom = top + _number(path, where, row, "height")
    if not (left <= right and top <= bottom):
        raise DataError(
            path, where, f"corners {left}, {top} and {right}, {bottom}; expected x1 <= x2 and y1 <= y2"
        )
    number, timestamp_ns = _moment(path, where, row)
    return ImageBox(
        (left, top, right, bottom),
        camera=_text(row, "camera"),
        number=number,
        timestamp_ns=timestamp_ns,
        track=_text(row, "track"),
        label=_text(row, "label"),
    )


def _there(row: Mapping[str, Any], name: str) -> bool:
    return row.get(name) not in (None, "")  # a cell of JSON may be a list, which no set can have


def _text(row: Mapping[str, Any], name: str) -> str | None:
    return str(row[name]).strip() if _there(row, name) else None


def _number(path: Path, where: str, row: Mapping[str, Any], name: str) -> float:
    value = _decimal(path, where, row, name)
    if abs(value) > _MOST_SECONDS:
        raise DataError(path, where, f"{name}: {row[name]!r}; expected pixels")
    return float(value)


def _decimal(path: Path, where: str, row: Mapping[str, Any], name: str) -> Decimal:
    stated = row.get(name)
    try:
        value = Decimal(str(stated).strip())
    except InvalidOperation as error:
        raise DataError(path, where, f"{name}: {stated!r}; expected a number") from error
    if isinstance(stated, bool) or not value.is_finite() or value.adjusted() > _MOST_DIGITS:
        raise DataError(path, where, f"{name}: {stated!r}; expected a finite number")
    return value


def _moment(path: Path, where: str, row: Mapping[str, Any]) -> tuple[int | None, int | None]:
    """The image's number, or else its time [ns]."""
    stated = [name for name in ("number", "time", "timestamp_ns") if _there(row, name)]
    if not stated:
        raise DataError(path, where, "does not state which image; expected number, time or timestamp_ns")
    value = _decimal(path, where, row, stated[0])
    whole = stated[0] != "time"
    if whole and value != int(value):
        raise DataError(path, where, f"{stated[0]}: {row[stated[0]]!r}; expected a whole number")
    if not whole and abs(value) > _MOST_SECONDS:
        raise DataError(path, where, f"time: {row['time']!r}; expected seconds on the scene's clock")
    if whole and abs(value) > _MOST_SECONDS * 1_000_000_000:
        raise DataError(
            path, where, f"{stated[0]}: {row[stated[0]]!r}; expected one that an image of the scene can have"
        )
    if stated[0] == "number":
        return int(value), None
    return None, int(value) if whole else int((value * 1_000_000_000).to_integral_value())
