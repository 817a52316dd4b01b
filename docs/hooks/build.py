"""What MkDocs calls while it builds the site: pages out of the program, links out of `docs/`, and a last look."""

import posixpath
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from commands import command_pages
from examples import example_page, listed_examples, notebook_images
from front import readme_sections
from layout import spaced
from links import PROJECT, page_of, with_site_links
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from outside import fetched_from_elsewhere
from reference import reference_pages
from rules import rules_page

_FRONT_PAGES = ("CHANGELOG.md", "CONTRIBUTING.md")
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
    for location, image in notebook_images():
        files.append(File.generated(config, location, content=image))
    return files


def _generated() -> dict[str, str]:
    from sceneloom.cli.main import sceneloom as program

    pages = {**command_pages(program, "sceneloom"), **reference_pages(), "reference/rules.md": rules_page()}
    for name in _FRONT_PAGES:
        pages[page_of(name)] = (PROJECT / name).read_text("utf-8")
        _origins[page_of(name)] = name
    for path in sorted((PROJECT / "examples").rglob("*")):
        text = example_page(path)
        if text is not None:
            file = path.relative_to(PROJECT).as_posix()
            pages[page_of(file)] = text
            _origins[page_of(file)] = file
    pages["examples/index.md"] = listed_examples(pages)
    return pages


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
    if location.startswith("reference/"):
        page.meta.setdefault("search", {"boost": 0.5})  # tasks and topics are found first
    text = with_site_links(markdown, _origin(location), location, lambda _: None)
    if location == "index.md":
        text += with_site_links(readme_sections(), "README.md", location, lambda _: None)
    return spaced(text)


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
    generated = sorted(_generated(), key=lambda location: "" if location.startswith("reference/") else location)
    config["nav"] = _completed(config["nav"], pages, generated)
    return config


def _completed(nav: list[Any], pages: list[str], generated: list[str]) -> list[Any]:
    named = set(_locations(nav))

    def completed(entries: list[Any]) -> Iterator[Any]:
        for entry in entries:
            if isinstance(entry, dict):
                yield {title: list(completed(e)) if isinstance(e, list) else e for title, e in entry.items()}
            elif "*" in entry:
                matching = (
                    p for p in [*pages, *generated] if Path(p).match(entry) and p.count("/") == entry.count("/")
                )
                yield from (_entry(p, generated) for p in matching if p not in named)
            else:
                yield entry

    return list(completed(nav))


def _entry(location: str, generated: list[str]) -> Any:
    """An entry of the navigation: a page, or a package with the pages of its classes."""
    folder, name = posixpath.split(location)
    if folder.startswith("reference/") and name == "index.md":
        classes = [p for p in generated if posixpath.dirname(p) == folder and p != location]
        return {posixpath.basename(folder): [location, *({_title(p): p} for p in classes)]}
    return {_title(location): location} if location.startswith(("commands/", "reference/")) else location


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
