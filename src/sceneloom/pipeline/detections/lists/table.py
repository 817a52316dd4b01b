"""Which forms of lists there are, and which of them a file is written in: its content decides."""

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from sceneloom.errors import DataError, UnknownFormatError
from sceneloom.formats.files import file_faults, open_file
from sceneloom.formats.ledger import Ledger
from sceneloom.pipeline.detections.lists import json_lines, kitti_text, nuscenes
from sceneloom.pipeline.detections.lists.context import ListContext, ListForm
from sceneloom.scene.detections import Boxes2D, Boxes3D

FORMS: tuple[ListForm, ...] = (json_lines.FORM, nuscenes.FORM, kitti_text.LISTS, kitti_text.RESULTS)
"""All forms; at most one of them recognises a file."""

_HEAD = 65536

Boxes = TypeVar("Boxes", Boxes3D, Boxes2D)


def form_of(path: Path) -> ListForm | None:
    """The form of a file; None for an empty one, in which nothing was found.

    Raises:
        DataError: it cannot be read.
        UnknownFormatError: no form recognises it.
    """
    with file_faults(path), open_file(path) as file:
        head = file.read(_HEAD).decode("utf-8-sig", "replace").lstrip()
    if not head:
        return None
    for form in FORMS:
        if form.recognises(head):
            return form
    known = "; ".join(f"{form.name}, {form.looks_like}" for form in FORMS)
    raise UnknownFormatError(
        path, "line 1", f"{head.splitlines()[0][:60]!r}; expected a list of boxes: {known}"
    )


def read_boxes_3d(path: Path | str, context: ListContext, ledger: Ledger) -> Sequence[Boxes3D]:
    """Read the boxes in space of a lidar's detector, by sweep, in the order of time and in the lidar's frame.

    Args:
        path: a file of any of the forms.
        context: what it does not state itself.
        ledger: reported what was assumed, and in a lenient reading of faults.

    Raises:
        DataError: the file cannot be read, is of no form that has such boxes, or is faulty.
    """
    path = Path(path)
    form = form_of(path)
    if form is None:
        return [Boxes3D.empty(t, sensor_id=context.sensor_id) for t in context.timestamps_ns.tolist()]
    if form.read_3d is None:
        raise DataError(path, "", f"is of the form {form.name}, which has no boxes in space")
    return form.read_3d(path, context, ledger)


def read_boxes_2d(path: Path | str, context: ListContext, ledger: Ledger) -> Sequence[Boxes2D]:
    """Read the boxes of a camera's detector, by image, in the order of time.

    Args:
        path, context, ledger: as of `read_boxes_3d`.

    Raises:
        DataError: the file cannot be read, is of no form that has such boxes, or is faulty.
    """
    path = Path(path)
    form = form_of(path)
    if form is None:
        return [Boxes2D.empty(t, sensor_id=context.sensor_id) for t in context.timestamps_ns.tolist()]
    if form.read_2d is None:
        raise DataError(path, "", f"is of the form {form.name}, which has no boxes in images")
    return form.read_2d(path, context, ledger)
