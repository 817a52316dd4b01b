"""A page for every command of the command line, out of the program itself."""

import re
from collections.abc import Iterator

import click

from sceneloom.cli.help import GROUPS, Verb

Pages = dict[str, str]
"""The text of each page, by its location on the site."""


def command_pages(program: click.Group, name: str) -> Pages:
    """Make the pages of all commands, and one that lists them.

    Args:
        program: the command line.
        name: what it is called in a shell.
    """
    pages, rows = {}, []
    for words, command in commands(program):
        location = f"commands/{'-'.join(words)}.md"
        pages[location] = _page(command, " ".join((name, *words)))
        rows.append(
            f"| [`{name} {' '.join(words)}`]({location.removeprefix('commands/')}) | {_cell(_first_line(command))} |"
        )
    listing = "\n".join(["| command | purpose |", "| --- | --- |", *rows])
    pages["commands/index.md"] = f"# Commands\n\n{_text(program)}\n\n{listing}\n"
    return pages


def commands(group: click.Group, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """Give all commands with the words that call them."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if isinstance(command, click.Group):
            yield from commands(command, (*words, name))
        elif command is not None:
            yield (*words, name), command


def _page(command: click.Command, called: str) -> str:
    arguments = [p for p in command.params if isinstance(p, click.Argument)]
    options = [p for p in command.params if isinstance(p, click.Option) and not p.hidden]
    usage = " ".join(
        [
            called,
            *(f"[{a.human_readable_name}]" if not a.required else a.human_readable_name for a in arguments),
            "[OPTIONS]",
        ]
    )
    tables = ""
    for group, title in GROUPS.items():
        own = [option for option in options if getattr(option, "group", "main") == group]
        if own:
            rows = "\n".join(f"| {_names(option)} | {_cell(_stated(option))} |" for option in own)
            tables += f"\n## {title}\n\n| option | meaning |\n| --- | --- |\n{rows}\n"
    examples = "\n".join(command.lines_of(called)) if isinstance(command, Verb) else ""
    shown = f"\n## Examples\n\n```sh\n{examples}\n```\n" if examples else ""
    return f"# {called}\n\n{_text(command)}\n\n```sh\n{usage}\n```\n{shown}{tables}"


def _first_line(command: click.Command) -> str:
    return (command.help or "").strip().split("\n\n")[0].replace("\n", " ").strip()


def _text(command: click.Command) -> str:
    """The help of a command as paragraphs."""
    paragraphs = re.split(r"\n\s*\n", (command.help or "").replace("\b", "").replace("\f", "").strip())
    return "\n\n".join(" ".join(line.strip() for line in paragraph.splitlines()) for paragraph in paragraphs)


def _names(option: click.Option) -> str:
    """The names of an option with what it takes."""
    context = click.Context(click.Command("any"))
    value = "" if option.is_flag else f" {option.make_metavar(context)}"
    names = ", ".join(sorted((*option.opts, *option.secondary_opts), key=len))
    required = " (required)" if option.required else ""
    return f"`{names}{value}`{required}"


def _stated(option: click.Option) -> str:
    text = option.help or ""
    default = option.default
    if option.show_default and isinstance(default, str | int | float):
        text += f" [default: {default}]"
    return text


def _cell(text: str) -> str:
    """A text as a cell of a table."""
    return text.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")
