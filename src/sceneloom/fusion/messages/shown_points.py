"""Points as viewers of the Foxglove schemas colour them: red, green, blue and alpha, a byte each.

Source: the Foxglove schemas, `PointCloud.fields`: "red, green, blue, and alpha are optional for customizing each
point's color".
"""

from collections.abc import Sequence
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array
from sceneloom.fusion.messages.packed_points import PackedField

_SHOWN = MappingProxyType({"r": "red", "g": "green", "b": "blue"})
_ALPHA = "alpha"
_OPAQUE = 255


def pack_shown(names: Sequence[str], table: Float32Array) -> tuple[tuple[PackedField, ...], AnyArray]:
    """Pack points for viewers: colours of whole numbers from 0 to 255 as bytes, all else as it is.

    Args:
        names: the fields of table 6.
        table: (N, len(names)) float32.

    Returns:
        The fields in the order of `names`, alpha last, and the (N, stride) uint8 points.
    """
    colors = [k for k, name in enumerate(names) if name in _SHOWN]
    if len(colors) != len(_SHOWN) or not _are_bytes(table[:, colors]):
        fields = tuple(PackedField(name, 4 * k, "float32") for k, name in enumerate(names))
        return fields, np.ascontiguousarray(table, "<f4").view(np.uint8).reshape(len(table), 4 * len(names))
    others = [k for k in range(len(names)) if k not in colors]
    stop = 4 * len(others)
    rows = np.empty((len(table), stop + 4), np.uint8)
    rows[:, :stop] = np.ascontiguousarray(table[:, others], "<f4").view(np.uint8).reshape(len(table), stop)
    rows[:, stop : stop + 3] = table[:, colors]
    rows[:, stop + 3] = _OPAQUE
    floats, bytes_ = iter(range(0, stop, 4)), iter(range(stop, stop + 3))
    fields = tuple(
        PackedField(_SHOWN[name], next(bytes_), "uint8")
        if name in _SHOWN
        else PackedField(name, next(floats), "float32")
        for name in names
    )
    return (*fields, PackedField(_ALPHA, stop + 3, "uint8")), rows


def without_shown_names(
    names: Sequence[str], table: Float32Array, fields: Sequence[PackedField]
) -> tuple[tuple[str, ...], Float32Array]:
    """Give points that were packed so the names of table 6 again, without an alpha that says nothing."""
    bytes_ = {field.name for field in fields if field.dtype == "uint8"}
    if not {*_SHOWN.values()} <= bytes_ or {*_SHOWN} & {*names}:
        return tuple(names), table
    plain = {shown: name for name, shown in _SHOWN.items()}
    kept = [
        k
        for k, name in enumerate(names)
        if name != _ALPHA or _ALPHA not in bytes_ or not (table[:, k] == _OPAQUE).all()
    ]
    return tuple(plain.get(names[k], names[k]) for k in kept), np.ascontiguousarray(table[:, kept])


def _are_bytes(colors: Float32Array) -> bool:
    # NaN is in no range
    return bool(((colors >= 0) & (colors <= _OPAQUE) & (colors == np.floor(colors))).all())
