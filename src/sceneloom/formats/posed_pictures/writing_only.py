"""What formats share that are written and never read."""

from pathlib import Path
from typing import Any

from sceneloom.errors import OptionError
from sceneloom.scene import Scene


def refuse_reading(name: str, path: Path, options: dict[str, Any]) -> Scene:
    """Refuse to open a path.

    Raises:
        OptionError: always.
    """
    del options
    raise OptionError(
        f"{path}: {name} is only written; its poses hold no times that a drive could be read from"
    )
