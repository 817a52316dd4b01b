"""Sections of the README that the first page of the site ends with."""

import re

from links import PROJECT

_OF_THE_README = ("Formats", "In Python", "Measured", "Alternatives", "Citing")


def readme_sections() -> str:
    """The sections of the README that the first page ends with."""
    sections = re.split(r"^(?=## )", (PROJECT / "README.md").read_text("utf-8"), flags=re.MULTILINE)
    return "\n" + "".join(part for title in _OF_THE_README for part in sections if part.startswith(f"## {title}\n"))
