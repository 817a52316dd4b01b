"""Lists of records in protobuf messages: a message for each record, arrays over all of them on our side."""

import math
from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any

import numpy as np

from sceneloom.fusion.messages.basic_types import shown
from sceneloom.fusion.messages.records import ListLayout


def read_list(repeated: Any, layout: ListLayout, common: Mapping[str, Any]) -> dict[str, Any]:
    """Read the records of a repeated field.

    Args:
        common: what the list says of all of its records.

    Returns:
        By attribute, what a list of records is made of.

    Raises:
        DataError: a record says something else than the list, or a vector has another length.
    """
    messages = list(repeated)
    _check_shared(messages, layout, common)
    values: dict[str, Any] = {"class_names": tuple(map(attrgetter("class"), messages))}
    for column in layout.columns:
        name = column.names[0]
        if len(column.names) > 1:
            rows = list(map(attrgetter(*column.names), messages))
        elif column.shape:
            rows = [tuple(row) for row in map(attrgetter(name), messages)]
            if column.optional and not any(rows):
                continue
            _check_lengths(rows, math.prod(column.shape), layout, name)
        else:
            rows = list(map(attrgetter(name), messages))
        values[column.attribute] = np.array(rows, column.dtype).reshape(len(rows), *column.shape)
    for name, attribute in layout.ids.items():
        values[attribute] = tuple(
            getattr(message, name) if message.HasField(name) else None for message in messages
        )
    return values


def _check_shared(messages: Sequence[Any], layout: ListLayout, common: Mapping[str, Any]) -> None:
    """Check that each record of a list says of itself what the list says of all."""
    timestamp = common["timestamp"]
    if timestamp is None:
        return
    seqs = [(name, common[shared]) for name, shared in layout.shared.items() if name != "timestamp"]
    expected = (timestamp.s, timestamp.ns, *(seq for _, seq in seqs))
    reported = attrgetter("timestamp.s", "timestamp.ns", *(name for name, _ in seqs))
    if not set(map(reported, messages)) - {expected}:
        return
    k, found = next((k, found) for k, found in enumerate(map(reported, messages)) if found != expected)
    wrong = found[:2] != expected[:2]
    name = "timestamp" if wrong else seqs[0][0]
    value = f"{found[0]}.{found[1]:09d}" if wrong else found[2]
    problem = f"{value}; expected {timestamp if wrong else expected[2]} as all of them"
    raise layout.table.fault(f"{layout.group}[{k}].{name}", problem)


def _check_lengths(rows: Sequence[tuple[Any, ...]], length: int, layout: ListLayout, name: str) -> None:
    k = next((k for k, row in enumerate(rows) if len(row) != length), None)
    if k is not None:
        kind = layout.table.row(name).type
        raise layout.table.fault(f"{layout.group}[{k}].{name}", f"{shown(rows[k])}; expected {kind}")
