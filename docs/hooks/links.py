"""Links between pages of the site and files outside `docs/`, which become pages or copies of their own."""

import posixpath
import re
from collections.abc import Callable
from pathlib import Path, PurePosixPath

PROJECT = Path(__file__).parents[2]
"""The checkout."""

FRONT = {"README.md": "index.md", "examples": "examples/index.md", "examples/notebooks": "examples/index.md"}
"""Files and folders that are pages under another name."""

_LINK = re.compile(r"(?P<start>!?\[[^\]]*\]\()(?P<target>[^)\s#]+)(?P<anchor>#[^)\s]*)?\)")
_FENCE = re.compile(r"^(```|~~~)")


def page_of(file: str) -> str:
    """The page of a file of the checkout, or what its copy is called, from the root of the site.

    Args:
        file: from the root of the checkout, with slashes.
    """
    path = PurePosixPath(file)
    if path.parts[0] == "docs":
        return str(PurePosixPath(*path.parts[1:]))
    if file in FRONT:
        return FRONT[file]
    if path.suffix in {".py", ".ipynb"} and path.parts[0] == "examples":
        return str(path.with_suffix(".md"))
    return file if path.suffix == ".md" else f"files/{file}"


def with_site_links(markdown: str, origin: str, page: str, wanted: Callable[[str], None]) -> str:
    """Let the links of a page lead to pages of the site.

    Args:
        markdown: the page.
        origin: the file that it came from, from the root of the checkout.
        page: where it stands on the site, from its root.
        wanted: reported each file outside `docs/` that a link leads to.
    """
    folder = posixpath.dirname(origin)

    def moved(match: re.Match[str]) -> str:
        target = match["target"]
        if re.match(r"[a-z]+:", target) or target.startswith("/"):
            return match[0]
        file = posixpath.normpath(posixpath.join(folder, target))
        if not (PROJECT / file).is_file() and file not in FRONT:
            return match[0]
        if not file.startswith("docs/") and file not in FRONT:
            wanted(file)
        goal = posixpath.relpath(page_of(file), posixpath.dirname(page) or ".")
        return f"{match['start']}{goal}{match['anchor'] or ''})"

    return _outside_fences(markdown, lambda text: _LINK.sub(moved, text))


def _outside_fences(markdown: str, change: Callable[[str], str]) -> str:
    """Change the lines that are no code."""
    lines, fenced = [], False
    for line in markdown.split("\n"):
        if _FENCE.match(line):
            fenced = not fenced
            lines.append(line)
        else:
            lines.append(line if fenced else change(line))
    return "\n".join(lines)
