"""Files of YAML that are read whole, those of OpenCV among them."""

import re
from pathlib import Path
from typing import Any

from sceneloom.errors import DataError, MissingExtraError, how_to_install
from sceneloom.formats.base.files import read_bytes

_LARGEST = 16_000_000
_TOO_DEEP = re.compile(r"(?:[\[{]\s*|- ){65}")
"""Collections in one another without anything between them; files of people have six, thousands take the parser
seconds."""

_OPENCV_HEAD, _OPENCV_TAG = re.compile(r"\A%YAML:1\.0[^\n]*"), re.compile(r"!!opencv-[\w-]+")
"""What OpenCV writes and no YAML has. Source: "XML/YAML/JSON file storages" of the OpenCV documentation."""


def read_yaml(path: Path) -> Any:
    """Read a YAML file; matrices of OpenCV become mappings with rows, cols, dt and data.

    Raises:
        DataError: it cannot be read, is no YAML, or nested too deep.
        MissingExtraError: the parser is not installed.
    """
    try:
        from ruamel.yaml import YAML
        from ruamel.yaml.error import YAMLError
    except ImportError as missing:
        raise MissingExtraError(f"{missing}; install the extra: {how_to_install('ros')}") from missing
    try:
        content = read_bytes(path)
        if len(content) > _LARGEST:
            raise DataError(path, "", f"cannot be read: {len(content)} bytes; expected at most {_LARGEST}")
        text = content.decode("utf-8-sig")
        if _TOO_DEEP.search(text):
            raise DataError(path, "", "cannot be read: nested deeper than 64 levels")
        return YAML(typ="safe").load(_OPENCV_TAG.sub("", _OPENCV_HEAD.sub("", text)))
    except UnicodeDecodeError as error:
        raise DataError(path, f"byte {error.start}", "cannot be read: is no UTF-8 text; expected YAML") from error
    except YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f"line {mark.line + 1}, column {mark.column + 1}"
        problem = getattr(error, "problem", None) or str(error).partition("\n")[0]
        raise DataError(path, where, f"cannot be read: is no YAML: {problem}") from error
    except (OSError, ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
        raise DataError(path, "", f"cannot be read: {error}") from error
