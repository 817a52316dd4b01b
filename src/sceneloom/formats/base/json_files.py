"""Files of JSON that are read whole."""

from pathlib import Path
from typing import TypeVar

import msgspec

from sceneloom.errors import DataError
from sceneloom.formats.base.files import read_bytes

_Kind = TypeVar("_Kind")


def read_json(path: Path, kind: type[_Kind]) -> _Kind:
    """Read a JSON file of one kind.

    Raises:
        DataError: it is missing, no JSON, or a value is missing or of another kind.
    """
    if not path.is_file():
        raise DataError(path, "", "is not there")
    try:
        return msgspec.json.decode(read_bytes(path), type=kind)
    except msgspec.ValidationError as error:
        problem, _, location = str(error).partition(" - at `")
        raise DataError(path, location.rstrip("`"), problem) from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(path, "", f"is no JSON: {error}") from error
