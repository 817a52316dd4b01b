"""Outputs whose paths are URLs: written to disk first, put into their stores once the verb has ended well."""

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any, TextIO, cast

import click

_DRAFTS = "sceneloom.cli.uploads"


def draft_of(url: str) -> Path:
    """Give a path on disk for an output whose own is a URL; it is gone when the verb ends.

    Raises:
        click.BadParameter: nothing can be written there.
    """
    from tempfile import TemporaryDirectory

    from sceneloom.errors import OutputError
    from sceneloom.formats.remote.uploads import output_name

    context = click.get_current_context()
    if not getattr(context.command.callback, "uploads", False):
        raise click.BadParameter(f"{url} is a URL; this verb writes to disk only")
    try:
        name = output_name(url)
    except OutputError as error:
        raise click.BadParameter(str(error)) from error
    folder = context.with_resource(TemporaryDirectory(prefix="sceneloom-"))
    draft = Path(folder) / name
    _drafts(context)[draft] = url
    return draft


@contextmanager
def uploads(*, overwrite: bool) -> Iterator[None]:
    """Refuse outputs that are there before much is done; put all of them into their stores after it.

    Raises:
        OutputError: something is there already, or a store cannot be written to.
    """
    drafts = dict(_drafts(click.get_current_context()))
    if not drafts:
        yield
        return
    from sceneloom.errors import redacted
    from sceneloom.formats.remote.uploads import check_remote_output, upload

    for url in drafts.values():
        check_remote_output(url, overwrite=overwrite)
    names = {str(draft): redacted(url) for draft, url in drafts.items()}
    with redirect_stdout(cast("TextIO", _Renaming(sys.stdout, names))):
        yield
        for draft, url in drafts.items():
            upload(draft, url)


def _drafts(context: click.Context) -> dict[Path, str]:
    return cast("dict[Path, str]", context.meta.setdefault(_DRAFTS, {}))


class _Renaming:
    """A stream in which outputs have the names that the user gave them."""

    def __init__(self, stream: TextIO, names: Mapping[str, str]) -> None:
        self._stream, self._names = stream, names

    def write(self, text: str) -> int:
        """Write text with names exchanged."""
        for draft, url in self._names.items():
            text = text.replace(draft, url)
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
