"""What a browser would fetch from elsewhere while it shows a page: nothing, or the site is not built."""

import re

_FETCHED = re.compile(
    r"<(?:script|img|iframe|video|audio|source)\b[^>]*\bsrc=[\"']?(?:https?:)?//[^\"'\s>]+"
    r"|<link\b[^>]*\brel=[\"']?(?:stylesheet|preconnect|preload|icon|dns-prefetch)[^>]*\bhref=[\"']?(?:https?:)?//[^>]*>"
    r"|@import\s+[\"'(]*(?:https?:)?//[^\"')]*|url\([\"']?(?:https?:)?//[^)]*\)"
)


def fetched_from_elsewhere(page: str) -> str | None:
    """The first thing in a page or a style sheet that would be fetched; None where nothing is."""
    found = _FETCHED.search(page)
    return None if found is None else found[0]
