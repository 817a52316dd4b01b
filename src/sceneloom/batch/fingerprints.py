"""Whether what was done with a drive would be the same now."""

from collections.abc import Mapping
from hashlib import blake2b
from typing import Any

from sceneloom.formats.fingerprints import fingerprint
from sceneloom.version import __version__

__all__ = ["configuration", "fingerprint"]


def configuration(verb: str, call: str, options: Mapping[str, Any]) -> str:
    """Tell what is done with a drive from anything else: the verb, its options, our version."""
    told = repr((__version__, verb, call, sorted((name, repr(value)) for name, value in options.items())))
    return blake2b(told.encode("utf-8", "surrogateescape"), digest_size=16).hexdigest()
