"""Camera models and mountings that single `frames` lines bring along; each different text is read once."""

from array import array
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np

from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.camera_models import CameraParameters
from sceneloom.formats.recording.columns import FrameColumns
from sceneloom.formats.recording.json_faults import DECODER_FAULTS, json_problem
from sceneloom.formats.recording.mounts import MatrixNumbers, rigid_transform
from sceneloom.geometry.rigid import RigidTransform

Value = TypeVar("Value")


def read_texts(
    frames: FrameColumns,
    rows: "array[int]",
    chosen: "array[int]",
    read: Callable[[bytes, int], Value],
    ledger: Ledger,
) -> dict[int, Value]:
    """Read every text that a camera's entries have.

    Args:
        frames: all frames lines, with all texts.
        rows: which frames line each entry is in.
        chosen: which text each entry has, -1 for none.
        read: reads a text, given the number of the first line that has it.
        ledger: takes faults.

    Returns:
        By index of the text; unusable ones are not in it.

    Raises:
        SceneloomError: a text is unusable and the reading is not lenient.
    """
    texts, numbers = list(frames.texts), np.asarray(chosen, np.int64)
    values: dict[int, Value] = {}
    indices, first_rows = np.unique(numbers, return_index=True)
    for index, row in zip(indices.tolist(), first_rows.tolist(), strict=True):
        if index < 0:
            continue
        try:
            values[index] = read(texts[index], frames.lines[rows[row]])
        except SceneloomError as error:
            ledger.fault("unusable-frame-parameters", error, count=int((numbers == index).sum()))
    return values


def read_parameters(text: bytes, line: int, *, path: Path) -> CameraParameters:
    """Read a `cameraParameters`.

    Raises:
        DataError: it is no object, or a value has the wrong type.
    """
    try:
        return msgspec.json.decode(text, type=CameraParameters).with_both_focal_lengths()
    except DECODER_FAULTS as error:
        problem = json_problem(error, text, prefix="frames[].cameraParameters")
        raise DataError(path, f"line {line}", problem) from error


def read_mount(text: bytes, line: int, *, path: Path, ledger: Ledger) -> RigidTransform:
    """Read an `imuToCamera` of a line; gives `ego_from_camera`.

    Raises:
        DataError: it is no matrix.
        CalibrationError: it is not rigid.
    """
    try:
        numbers = msgspec.json.decode(text, type=MatrixNumbers)
    except DECODER_FAULTS as error:
        problem = json_problem(error, text, prefix="frames[].imuToCamera")
        raise DataError(path, f"line {line}", problem) from error
    return rigid_transform(numbers, f"{path}: line {line}: frames[].imuToCamera", ledger).inverse()
