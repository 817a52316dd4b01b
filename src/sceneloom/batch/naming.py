"""What the outputs of a run are called: by their drives, each differently."""

from collections import Counter
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit

from sceneloom.batch.inputs import READING
from sceneloom.batch.jobs import NOTHING, Input
from sceneloom.formats.file_names import file_stems
from sceneloom.formats.table import PART
from sceneloom.formats.urls import is_url


def output_names(inputs: Sequence[Input], suffix: str) -> tuple[str, ...]:
    """Name outputs by their drives; where these share a name, by the folders above, too.

    Args:
        inputs: the drives.
        suffix: what all names end in.
    """
    parts = [_parts(drive) for drive in inputs]
    depths = [1] * len(parts)
    while True:
        names = ["_".join(own[-depth:]) for own, depth in zip(parts, depths, strict=True)]
        counts = Counter(names)
        deeper = [
            min(depth + 1, len(own)) if counts[name] > 1 else depth
            for own, depth, name in zip(parts, depths, names, strict=True)
        ]
        if deeper == depths:
            # what is left alike is numbered, and made fit for file systems
            return tuple(stem + suffix for stem in file_stems(names))
        depths = deeper


def drive_names(inputs: Sequence[Input]) -> tuple[str, ...]:
    """Name drives as their outputs are, without a suffix, and alike for all parts of one in time."""
    reading = [{name: value for name, value in one.options.items() if name not in PART} for one in inputs]
    whole = [
        Input(location=one.location, options=own or NOTHING) for one, own in zip(inputs, reading, strict=True)
    ]
    keys = [(one.location, *sorted(one.options.items())) for one in whole]
    once = dict(zip(keys, whole, strict=True))
    names = dict(zip(once, output_names(tuple(once.values()), ""), strict=True))
    return tuple(names[key] for key in keys)


def _parts(drive: Input) -> tuple[str, ...]:
    text = (
        unquote(urlsplit(drive.location).path)
        if is_url(drive.location)
        else drive.location.replace("\\", "/")
    )
    path = PurePosixPath(text.rstrip("/"))
    parts = [part for part in path.parts if part not in {"/", ".", ".."}] or ["drive"]
    parts[-1] = path.stem or parts[-1]
    parts[-1] = "_".join([parts[-1], *(_word(name, value) for name, value in sorted(drive.options.items()))])
    return tuple(parts)


def _word(name: str, value: Any) -> str:
    """What counts for a drive alone, as a word."""
    if name.startswith(READING):
        return name.removeprefix(READING) if value is True else str(value)
    return f"{name}{value:g}"
