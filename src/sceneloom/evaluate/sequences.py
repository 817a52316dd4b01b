"""The sequences of results and of the truth, which must be the same."""

from collections.abc import Mapping

from sceneloom.errors import OptionError
from sceneloom.evaluate.objects import ObjectTable


def check_sequences(results: Mapping[str, ObjectTable], truth: Mapping[str, ObjectTable]) -> None:
    """Refuse results and truth of different sequences.

    Raises:
        OptionError: they are not the same on both sides, or there is none.
    """
    if not truth:
        raise OptionError("the truth has no sequence")
    for side, names in (("results", set(truth) - set(results)), ("truth", set(results) - set(truth))):
        if names:
            raise OptionError(f"{side} without the sequences {', '.join(sorted(names))}")
