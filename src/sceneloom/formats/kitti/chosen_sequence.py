"""Which of several sequences is meant."""

from collections.abc import Iterable
from pathlib import Path

from sceneloom.errors import OptionError


def sequences_called(sequences: Iterable[str], wanted: str) -> list[str]:
    """Those of some sequences that a name means; its leading zeros need not be stated."""
    return [name for name in sequences if wanted and wanted.lstrip("0") == name.lstrip("0")]


def choose_sequence(path: Path, sequences: tuple[str, ...], wanted: str | None) -> str:
    """The only sequence, or the wanted one; leading zeros need not be stated.

    Raises:
        OptionError: there are several and none was chosen, or the chosen one is not there.
    """
    names = ", ".join(sequences) or "none"
    if wanted is not None:
        chosen = sequences_called(sequences, wanted)
        if len(chosen) != 1:
            raise OptionError(f"sequence {wanted!r}: {path} has {names}")
        return chosen[0]
    if len(sequences) != 1:
        raise OptionError(f"{path} has several sequences: {names}; choose one with `--sequence NAME`")
    return sequences[0]
