"""Values of options that come as what they are from Python, and as texts from the command line."""

from sceneloom.errors import OptionError

_YES, _NO = ("true", "yes", "on", "1"), ("false", "no", "off", "0")


def as_flag(name: str, value: object) -> bool:
    """Take a value as true or false.

    Raises:
        OptionError: it is neither.
    """
    text = str(value).lower()
    if text not in (*_YES, *_NO):
        raise OptionError(f"{name} {value!r}; expected true or false")
    return text in _YES


def as_positive(name: str, value: float | str) -> float:
    """Take a value as a finite number above 0.

    Raises:
        OptionError: it is none.
    """
    try:
        number = float(value)
    except ValueError:
        number = 0.0
    if not 0.0 < number < float("inf"):
        raise OptionError(f"{name} {value}; expected a number above 0")
    return number
