"""Lines of JSON: records of tables 7 and 8 of DB34/T 4101, one box or one frame's list of boxes a line."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.rig.csv_files import read_lines
from sceneloom.fusion.bare_boxes import joined
from sceneloom.fusion.messages.boxes import Box2d, Box3d, Boxes2d, Boxes3d
from sceneloom.fusion.messages.json_form import from_json
from sceneloom.fusion.messages.records import RECORD_KINDS
from sceneloom.fusion.messages.scene_form.boxes import boxes_2d_of, boxes_3d_of
from sceneloom.pipeline.detections.lists.context import ListContext, ListForm, sorted_by_time
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.warnings import WarningKind


def _recognises(head: str) -> bool:
    return head.startswith("{") and '"results"' not in head[:20_000].split("[", 1)[0]


def _read_3d(path: Path, context: ListContext, ledger: Ledger) -> Sequence[Boxes3D]:
    lists = [
        replace(boxes_3d_of(record, sensor_id=context.sensor_id), ids=None)
        for record in _records(path, context, ledger, (Boxes3d, Box3d))
    ]
    return _complete(lists, context, Boxes3D.empty)


def _read_2d(path: Path, context: ListContext, ledger: Ledger) -> Sequence[Boxes2D]:
    lists = [
        replace(boxes_2d_of(record, sensor_id=context.sensor_id), ids=None)
        for record in _records(path, context, ledger, (Boxes2d, Box2d))
    ]
    return _complete(lists, context, Boxes2D.empty)


def _complete(lists: list[Any], context: ListContext, empty: Any) -> list[Any]:
    """In the order of time, with lists of nothing for frames of the sensor between the first and last that have none.

    A detector that writes bare boxes cannot state that it found nothing.
    """
    if lists:
        known = {boxes.timestamp_ns for boxes in lists}
        first, last = min(known), max(known)
        missing = [t for t in context.timestamps_ns.tolist() if first <= t <= last and t not in known]
        tick_ns = _half_step(context)
        near = sorted(known)
        lists += [
            empty(t, sensor_id=context.sensor_id)
            for t in missing
            if min(abs(t - one) for one in near) > tick_ns
        ]
    return [lists[k] for k in sorted_by_time(lists)]


def _half_step(context: ListContext) -> int:
    steps = context.timestamps_ns[1:] - context.timestamps_ns[:-1]
    return int(steps.min()) // 2 if len(steps) else 0


def _records(
    path: Path, context: ListContext, ledger: Ledger, wanted: tuple[type[Any], type[Any]]
) -> Iterator[Any]:
    """The lists of boxes of a file; bare boxes of one frame are put together, wherever they stand.

    Raises:
        DataError: a line is no record of boxes, or of other ones.
    """
    single = wanted[1]
    lone: list[Any] = []
    others = 0
    for number, line in read_lines(path):
        try:
            record = _record(line, wanted)
        except DataError as error:
            location = ": ".join(filter(None, (f"line {number}", error.location)))
            ledger.fault("faulty-detections", DataError(path, location, error.problem))
            continue
        if isinstance(record, single):
            lone.append(record)
        elif context.number is None or record.sensor_id == context.number:
            yield record
        elif record.sensor_id not in context.others:
            others += 1
    if others:
        message = "lists whose sensor_id is that of no sensor here"
        ledger.note(WarningKind.SKIPPED, "other-sensors", str(path), message, count=others)
    lone.sort(key=_frame_of)  # stable: within a frame, the order of the file
    for _, same in groupby(lone, key=_frame_of):
        yield joined([box.alone(context.number or 0) for box in same])


def _frame_of(box: Box3d | Box2d) -> tuple[Any, int]:
    return box.timestamp, box.points_seq if isinstance(box, Box3d) else box.image_seq


def _record(line: str, wanted: tuple[type[Any], type[Any]]) -> Any:
    """The record of a line, of one of two types."""
    record = _any_record(line)
    if not isinstance(record, wanted):
        kinds = " or ".join(kind.__name__ for kind in wanted)
        raise DataError("record", "", f"a {type(record).__name__}; expected {kinds}")
    return record


def _any_record(line: str) -> Any:
    """The record of a line: under the name of its kind, or bare.

    Raises:
        DataError: it is none.
    """
    try:
        content = msgspec.json.decode(line)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise DataError("record", "", f"no JSON: {error}") from error
    if not isinstance(content, Mapping):
        raise DataError("record", "", "no JSON object; expected a record of boxes")
    if len(content) == 1 and (name := next(iter(content))) in RECORD_KINDS:
        return from_json(name, content[name])
    space = any(name in content for name in ("X", "x", "points_seq"))
    if "boxes" in content:
        inner = content["boxes"]
        space = isinstance(inner, list) and any(
            isinstance(box, Mapping) and ("X" in box or "x" in box) for box in inner
        )
        return from_json("boxes_3d" if space else "boxes_2d", content)
    return from_json("box_3d" if space else "box_2d", content)


FORM = ListForm(
    "json-lines",
    "lines of JSON, each a record of table 7 or 8 of DB34/T 4101, or a frame's list of them",
    _recognises,
    _read_3d,
    _read_2d,
)
