"""The drives of a data set: folders that hold several of them, as many data sets are handed out."""

from collections.abc import Sequence
from pathlib import Path

from sceneloom.errors import SceneloomError
from sceneloom.formats.table import format_named, formats_that_may_be


def drives_of(path: Path, *, read_as: str | None = None) -> Sequence[Path | str]:
    """Name the drives of a data set that has several.

    Args:
        path: a folder, or any other path.
        read_as: name of its format, where its content shall not decide.

    Returns:
        of each its own folder, or the name that the option `sequence` of its format takes. Empty where the path is one
        drive, or not known as a data set; opening it reports more.
    """
    if not path.is_dir():
        return ()
    forms = formats_that_may_be(path) if read_as is None else [format_named(read_as)]
    sets = [form.drives for form in forms if form.drives is not None and form.sniff(path)]
    if len(sets) != 1:
        return ()
    try:
        found = sets[0](path)
    except SceneloomError:
        return ()
    return found if len(found) > 1 else ()
