"""What MkDocs calls while it builds the site: pages out of the program, links out of `docs/`, and a last look."""

import ast
import json
import posixpath
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from commands import command_pages
from layout import spaced
from links import PROJECT, page_of, with_site_links
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from outside import fetched_from_elsewhere
from reference import reference_pages
from rules import rules_page

_FRONT_PAGES = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")
_origins: dict[str, str] = {}
"""The file of the checkout that each generated page came from, by its location on the site."""


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that no file in `docs/` holds, and copies of files that pages link to."""
    _origins.clear()
    for location, text in _generated().items():
        files.append(File.generated(config, location, content=text))
    for file in _linked_files(files):
        copy = (PROJECT / file).read_bytes()
        files.append(File.generated(config, page_of(file), content=copy))
    return files


def _generated() -> dict[str, str]:
    from sceneloom.cli.main import sceneloom as program

    pages = {**command_pages(program, "sceneloom"), **reference_pages(), "reference/rules.md": rules_page()}
    for name in _FRONT_PAGES:
        pages[page_of(name)] = (PROJECT / name).read_text("utf-8")
        _origins[page_of(name)] = name
    for path in sorted((PROJECT / "examples").rglob("*")):
        text = _example(path)
        if text is not None:
            file = path.relative_to(PROJECT).as_posix()
            pages[page_of(file)] = text
            _origins[page_of(file)] = file
    pages["examples/index.md"] = _listed_examples(pages)
    return pages


def _example(path: Path) -> str | None:
    """The page of an example; None of files that are none."""
    if path.suffix == ".py" and path.parent == PROJECT / "examples":
        source = path.read_text("utf-8")
        return f"# {path.name}\n\n{ast.get_docstring(ast.parse(source)) or ''}\n\n```python\n{source}```\n"
    if path.suffix == ".ipynb":
        return "\n\n".join(_cells(path)) + "\n"
    return path.read_text("utf-8") if path.suffix == ".md" else None


def _cells(path: Path) -> Iterator[str]:
    """The cells of a notebook as Markdown."""
    for cell in json.loads(path.read_text("utf-8"))["cells"]:
        text = "".join(cell["source"])
        yield text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```"


def _listed_examples(pages: dict[str, str]) -> str:
    rows = []
    for location, text in sorted(pages.items()):
        if location.startswith("examples/") and location.count("/") <= 2:
            title, _, rest = text.partition("\n\n")
            name = title.removeprefix("# ").strip()
            first = "" if rest.startswith("```") else rest.split("\n")[0]
            rows.append(f"| [{name}]({location.removeprefix('examples/')}) | {first} |")
    table = "\n".join(["| example | content |", "| --- | --- |", *rows])
    return f"# Examples\n\nEach runs as it stands, on simulated data, and is run by the tests.\n\n{table}\n"


def _linked_files(files: Files) -> list[str]:
    """The files outside `docs/` that pages link to and that are no pages."""
    wanted: set[str] = set()
    for file in files.documentation_pages():
        with_site_links(file.content_string, _origin(file.src_uri), file.src_uri, wanted.add)
    known = {file.src_uri for file in files}
    return sorted(name for name in wanted if page_of(name) not in known)


def _origin(location: str) -> str:
    return _origins.get(location, posixpath.join("docs", location))


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:  # noqa: ARG001 - MkDocs' names
    """Let links lead to pages, and blocks begin where readers see them begin."""
    location = page.file.src_uri
    return spaced(with_site_links(markdown, _origin(location), location, lambda _: None))


def on_nav(nav: Any, config: Any, files: Files) -> Any:  # noqa: ARG001 - MkDocs' names
    """Refuse a page that nobody would find."""
    listed = {page.file.src_uri for page in nav.pages}
    lost = [file.src_uri for file in files.documentation_pages() if file.src_uri not in listed]
    if lost:
        raise PluginError(f"pages that stand in no part of the navigation: {', '.join(lost)}")
    return nav


def on_config(config: Any) -> Any:
    """Complete the navigation: each part that ends with `…` gets the pages of its folder that it does not name."""
    docs = Path(config["docs_dir"])
    pages = sorted(path.relative_to(docs).as_posix() for path in docs.rglob("*.md"))
    generated = sorted(_generated())
    config["nav"] = _completed(config["nav"], pages, generated)
    return config


def _completed(nav: list[Any], pages: list[str], generated: list[str]) -> list[Any]:
    named = set(_locations(nav))
    parts = []
    for part in nav:
        ((title, entries),) = part.items()
        if isinstance(entries, list):
            patterns = [entry for entry in entries if isinstance(entry, str) and "*" in entry]
            entries = [entry for entry in entries if entry not in patterns]
            for pattern in patterns:
                found = [
                    p for p in [*pages, *generated] if Path(p).match(pattern) and p.count("/") == pattern.count("/")
                ]
                entries += [
                    {_title(p): p} if p.startswith(("commands/", "reference/")) else p for p in found if p not in named
                ]
        parts.append({title: entries})
    return parts


def _locations(nav: Any) -> Iterator[str]:
    for part in nav if isinstance(nav, list) else nav.values():
        if isinstance(part, str):
            yield part
        else:
            yield from _locations(part)


def _title(location: str) -> str:
    stem = location.rsplit("/", maxsplit=1)[-1].removesuffix(".md")
    return stem.replace("-", " ", 1) if location.startswith(("commands/edit-", "commands/eval-")) else stem


def on_post_build(config: Any) -> None:
    """Refuse a site that would fetch anything from elsewhere."""
    site = Path(config["site_dir"])
    for path in [*site.rglob("*.html"), *site.rglob("*.css")]:
        found = fetched_from_elsewhere(path.read_text("utf-8"))
        if found is not None:
            raise PluginError(f"{path.relative_to(site)} would fetch {found[:120]}")
