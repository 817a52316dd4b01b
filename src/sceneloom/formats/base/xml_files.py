"""Files of XML that are read whole."""

from pathlib import Path
from xml.etree import ElementTree as ET

from sceneloom.errors import DataError


def xml_root(path: Path, content: bytes) -> ET.Element:
    """Parse the content of an XML file, without the entities by which XML does harm.

    Raises:
        DataError: it declares entities, or is no XML.
    """
    if b"<!ENTITY" in content:
        raise DataError(path, "", "declares entities; expected plain XML")
    try:
        return ET.fromstring(content)  # noqa: S314 - entities were refused
    except (ET.ParseError, ValueError, LookupError) as error:
        line, column = getattr(error, "position", (0, 0))
        raise DataError(path, f"line {line}, column {column + 1}" if line else "", f"is no XML: {error}") from error
