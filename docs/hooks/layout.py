"""Markdown as it is written for the eye, made such that the site's converter sees lists, tables and code in it."""

import re

_ITEM = re.compile(r"^\s*([-*]|\d+\.) ")
_FENCE = re.compile(r"^\s*(```|~~~)")


def spaced(markdown: str) -> str:
    """Put blank lines around tables, lists and code, where a block begins right after another one."""
    lines: list[str] = []
    fenced, before = False, ""
    for line in markdown.split("\n"):
        is_fence = bool(_FENCE.match(line))
        if not fenced and before.strip() and line.strip() and _begins(line, before, is_fence=is_fence):
            lines.append("")
        lines.append(line)
        if is_fence:
            fenced = not fenced
            # what follows the end of code begins anew
            before = "```" if not fenced else line
            continue
        before = line
    return "\n".join(lines)


def _begins(line: str, before: str, *, is_fence: bool) -> bool:
    """Whether a line begins a block that the line before does not belong to."""
    if _FENCE.match(before):
        return True
    if is_fence:
        return not line.startswith(" ")
    if line.startswith("|") != before.startswith("|"):
        return True
    if _ITEM.match(line):
        return not _ITEM.match(before) and not before.startswith(" ")
    return False
