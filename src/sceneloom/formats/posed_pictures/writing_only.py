"""What formats share that are written and never read."""

from pathlib import Path
from typing import Any

from sceneloom.errors import OptionError
from sceneloom.formats.holdings import Holds
from sceneloom.formats.posed_pictures.holdings import HOLDS
from sceneloom.scene.scene import Scene


class WrittenOnly:
    """A format of posed pictures, which nothing is read from."""

    called: str
    """What messages call it."""
    reads = False
    along_trajectory = True
    holds: Holds = HOLDS

    def recognises(self, path: Path) -> bool:
        """Recognise nothing: the format is only written."""
        del path
        return False

    def open(self, path: Path, **options: Any) -> Scene:
        """Refuse to read.

        Raises:
            OptionError: always.
        """
        del options
        raise OptionError(
            f"{path}: {self.called} is only written; its poses hold no times that a drive could be read from"
        )
