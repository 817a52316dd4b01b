"""What `--help` shows: options in groups, examples at the end, and which verb may have been meant."""

import difflib
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

if TYPE_CHECKING:
    from sceneloom.scene.scene import Scene

GROUPS = {"main": "Options", "input": "Input", "output": "Output", "general": "General"}
"""The groups of options in their order, and what help calls them."""


class Option(click.Option):
    """An option of a verb, in one of `GROUPS`; a rare one is shown by `--help-all` only."""

    def __init__(self, *arguments: Any, group: str = "main", rare: bool = False, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.group, self.rare = group, rare

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """What a shell offers: names of formats, and of what the drive has that the command line names."""
        found = _COMPLETED.get(str(self.name))
        if found is None:
            return super().shell_complete(ctx, incomplete)
        return [CompletionItem(name) for name in found(ctx) if name.startswith(incomplete)]


def _formats(*, written: bool) -> list[str]:
    from sceneloom.formats.base.registry import format_names, written_formats

    return sorted(written_formats() if written else format_names())


def _sensors(ctx: click.Context) -> list[str]:
    return _of_drive(ctx, lambda scene: [str(sensor.id) for sensor in scene.sensors])


def _trajectories(ctx: click.Context) -> list[str]:
    return [*_of_drive(ctx, lambda scene: list(scene.trajectories)), "gnss", "lidar", "identity"]


def _of_drive(ctx: click.Context, names: "Callable[[Scene], list[str]]") -> list[str]:
    """Names out of the drive that is typed already; none where there is none, or it cannot be opened."""
    from sceneloom.errors import SceneloomError
    from sceneloom.formats.base.registry import open_scene

    for word in ctx.args:  # an option that has no value yet ends parsing, and leaves the arguments here
        if Path(word).exists():
            with suppress(SceneloomError, OSError), open_scene(word) as scene:
                return names(scene)
    return []


_COMPLETED: dict[str, Callable[[click.Context], list[str]]] = {
    "format": lambda _: _formats(written=False),
    "to": lambda _: _formats(written=True),
    **dict.fromkeys(("sensors", "without", "sensor", "lidar", "lidars", "camera", "cameras"), _sensors),
    **dict.fromkeys(("trajectory", "est_name", "ref_name"), _trajectories),
}  # by names of parameters


_SHOW_ALL = "show-all"  # entry of a context's `meta`: rare options are shown, too


def _show_all(ctx: click.Context, _: click.Parameter, asked: bool) -> None:
    if asked and not ctx.resilient_parsing:
        ctx.meta[_SHOW_ALL] = True
        click.echo(ctx.get_help(), color=ctx.color)
        ctx.exit()


class Verb(click.Command):
    """A verb whose help has its options in groups, and ends with examples: words that follow it, or whole lines."""

    def __init__(self, *arguments: Any, examples: Sequence[str] = (), **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.examples = tuple(examples)

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """The parameters, with `--help-all` before `--help` where something is rare."""
        found = super().get_params(ctx)
        if any(getattr(parameter, "rare", False) for parameter in found):
            text = "Show rare options, too, and exit."
            show_all = Option(
                ["--help-all"],
                group="general",
                is_flag=True,
                is_eager=True,
                expose_value=False,
                help=text,
                callback=_show_all,
            )
            found.insert(len(found) - 1, show_all)
        return found

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, group by group."""
        rows: dict[str, list[tuple[str, str]]] = {group: [] for group in GROUPS}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx) if isinstance(parameter, click.Option) else None
            if record is None or (getattr(parameter, "rare", False) and not ctx.meta.get(_SHOW_ALL)):
                continue
            rows[getattr(parameter, "group", "general")].append(record)
        for group, records in rows.items():
            if records:
                with formatter.section(GROUPS[group]):
                    formatter.write_dl(records)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples."""
        super().format_epilog(ctx, formatter)
        if self.examples:
            with formatter.section("Examples"):
                for example in self.lines_of(ctx.command_path):
                    formatter.write(f"{'':{formatter.current_indent}}{example}\n")

    def lines_of(self, called: str) -> list[str]:
        """The examples as lines in which the verb is called so."""
        return [words if "sceneloom" in words else f"{called} {words}".rstrip() for words in self.examples]


class Verbs(click.Group):
    """Verbs under one name; of a word that is none of them, those that it resembles are named."""

    command_class = Verb

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the verb that the first word names."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            near = difflib.get_close_matches(args[0], self.list_commands(ctx), n=3, cutoff=0.5)
            if not near or args[0].startswith("-"):
                raise
            raise click.UsageError(f"{error.message} Did you mean {' or '.join(near)}?", ctx) from error
