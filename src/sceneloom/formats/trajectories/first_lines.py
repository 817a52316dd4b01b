"""The beginning of a text file, by which its form is recognised."""

from pathlib import Path

from sceneloom.formats.files import file_faults, open_file

_BEGINNING = 65_536


def beginning(path: Path) -> str | None:
    """The first lines of a file that is a text, else None; a line that is cut off is left out.

    Raises:
        DataError: it cannot be read.
    """
    with file_faults(path), open_file(path) as file:
        raw = file.read(_BEGINNING + 1)
    if b"\0" in raw:
        return None
    whole = raw if len(raw) <= _BEGINNING else raw[: raw.rfind(b"\n") + 1]
    try:
        return whole.decode("utf-8-sig")
    except UnicodeDecodeError:
        return None


def first_values(text: str, delimiter: str | None) -> list[float] | None:
    """The numbers of the first line that is no comment; None where it holds anything else."""
    line = next(
        (line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), ""
    )
    try:
        return [float(cell) for cell in line.split(delimiter)]
    except ValueError:
        return None


def first_names(text: str) -> list[str] | None:
    """The names of columns in the first line, in lower case; None where it holds none."""
    line = next((line for line in text.splitlines() if line.strip()), "").lstrip("# \t")
    delimiter = next((sign for sign in ",;\t" if sign in line), None)
    names = [name.strip().strip('"').lower() for name in line.split(delimiter)]
    return None if any(not name or name[0] in "0123456789.-+{[" for name in names) else names
