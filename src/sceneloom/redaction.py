"""Addresses and messages without what is nobody else's business: secrets in addresses, folders of one's machine."""

import re
from pathlib import Path

HIDDEN = "***"

_NAMES = (
    r"x-(?:amz|goog|oss|ms)-[a-z0-9-]+",
    r"awsaccesskeyid|googleaccessid|key-pair-id|policy|expires",
    r"sig|signature|sv|se|sp|sr|st|skoid|sktid|ske|sks|skv|spr|sip",
    r"[a-z0-9_.-]*(?:token|secret|password|passwd|credential|api[-_]?key|access[-_]?key|account[-_]?key)[a-z0-9_.-]*",
    r"auth|authorization|code|key|pwd",
)
"""Names of a query whose values are secrets, or parts of a signature.

Source: query authentication of AWS Signature 4 and of Cloud Storage, shared access signatures of Azure Storage.
"""

_USER = re.compile(r"(?P<scheme>[a-zA-Z][a-zA-Z0-9+.-]*://)[^/?#\s'\"<>]*@")
_SECRET = re.compile(
    rf"(?P<name>(?:[?&;]|%3F|%26)(?:{'|'.join(_NAMES)})(?:=|%3D))[^&\s'\"<>)\],;]*", re.IGNORECASE
)
_HEADER = re.compile(
    r"(?P<name>\b(?:authorization|proxy-authorization|x-amz-security-token|cookie|aws_secret_access_key|"
    r"aws_session_token|accountkey|sharedaccesssignature)['\"]?\s*[:=]\s*['\"]?)"
    r"(?:(?:bearer|basic|token)\s+)?[^\s'\",;]+",
    re.IGNORECASE,
)


def redacted(text: object) -> str:
    """Give text, an address or a message with addresses in it, without its secrets."""
    plain = str(text)
    if "://" not in plain and _HEADER.search(plain) is None:
        return plain
    found = _USER.sub(rf"\g<scheme>{HIDDEN}@", plain)
    return _HEADER.sub(rf"\g<name>{HIDDEN}", _SECRET.sub(rf"\g<name>{HIDDEN}", found))


def without_folders(text: str, source: str) -> str:
    """Give text about a drive without the folders above it, as it goes into files that are handed on.

    Args:
        text: a message, a location in the drive, or a whole document.
        source: the path of the drive as it was given; several are joined by " + ".
    """
    plain = text
    for each in source.split(" + "):
        if "://" in each or not ("/" in each or "\\" in each):
            continue
        path = Path(each)
        for parent in {str(path.parent), str(path.absolute().parent)}:
            if parent not in {"/", ".", ""}:
                plain = plain.replace(f"{parent}/", "").replace(f"{parent}\\", "")
    return plain
