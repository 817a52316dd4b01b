"""From one format to another, through the scene."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.formats.loss import LossReport
from sceneloom.formats.table import format_and_place, format_for_output, format_named
from sceneloom.scene import Notice


class ConversionReport(msgspec.Struct, frozen=True, kw_only=True):
    """One conversion.

    Attributes:
        source, source_format: what was read, and as what.
        target, target_format: what was written, and as what.
        notices: what was assumed, repaired or left out on reading.
        losses: what the target could not hold.
    """

    source: str
    source_format: str
    target: str
    target_format: str
    notices: tuple[Notice, ...]
    losses: LossReport


def convert(
    source: str | Path,
    target: str | Path,
    *,
    to: str | None = None,
    overwrite: bool = False,
    reading: Mapping[str, Any] | None = None,
    **writing: Any,
) -> ConversionReport:
    """Read a recording or a scene and write it in another format, without fusing anything.

    Args:
        source: a file or folder.
        target: a file or folder; its suffix chooses the format unless `to` names it.
        to: name of the target's format.
        overwrite: whether a target that exists may be replaced.
        reading: reading options of the source's format.
        writing: writing options of the target's format.

    Raises:
        UnknownFormatError: no format fits the source.
        DataError: the source is wrong.
        OutputError: the target exists, or cannot be written.
    """
    reader, origin = format_and_place(source)
    place = Path(target)
    writer = format_for_output(place) if to is None else format_named(to)
    with reader.open(origin, **(reading or {})) as scene:
        losses = writer.write(scene, place, overwrite=overwrite, **writing)
        return ConversionReport(
            source=str(source),
            source_format=reader.name,
            target=str(target),
            target_format=writer.name,
            notices=scene.notices,
            losses=losses,
        )
