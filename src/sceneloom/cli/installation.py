"""`sceneloom doctor`: what this installation can do; `sceneloom completion`: what a shell needs to complete verbs."""

import os
from itertools import groupby
from pathlib import Path
from types import MappingProxyType

import click
from click.shell_completion import get_completion_class

from sceneloom.cli.help import Verb
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer, print_json, print_table
from sceneloom.cli.running import verb
from sceneloom.errors import OptionError

_MARKS = {"good": "ok", "missing": "--", "broken": "BROKEN"}


@click.command(cls=Verb, examples=("", "--compile"))
@option("--compile", "Compile all numeric kernels first: for images of containers, and for services.")
@verb
def doctor(printer: Printer, **given: bool) -> int:
    """Report what this installation can do and what it lacks; exit 1 if something needed is broken."""
    from sceneloom.kernels.cache import compile_all
    from sceneloom.pipeline.installation import examine_installation

    if given["compile"]:
        compile_all()
    report = examine_installation()
    if printer.as_json:
        print_json({"sound": report.is_sound, "findings": report.findings})
        return int(not report.is_sound)
    for group, findings in groupby(report.findings, key=lambda finding: finding.group):
        rows = [
            (_MARKS[one.status], one.name, ": ".join(filter(None, (one.stated, one.remedy))))
            for one in findings
            if not printer.quiet or one.status != "good"
        ]
        if rows:
            click.echo(group)
            print_table(rows)
    if not report.is_sound:
        click.echo("sceneloom: something that is needed is broken; what to do stands beside it", err=True)
    return int(not report.is_sound)


_INSTALLED = MappingProxyType(
    {
        "bash": 'eval "$(sceneloom completion bash)"  # in ~/.bashrc',
        "zsh": 'eval "$(sceneloom completion zsh)"  # in ~/.zshrc',
        "fish": "sceneloom completion fish > ~/.config/fish/completions/sceneloom.fish",
    }
)  # how each shell takes it in


@click.command(
    cls=Verb,
    examples=(
        'eval "$(sceneloom completion bash)"',
        "sceneloom completion fish > ~/.config/fish/completions/sceneloom.fish",
    ),
)
@click.argument("shell", type=click.Choice(list(_INSTALLED)), required=False)
def completion(shell: str | None) -> None:
    """Print what SHELL needs to complete verbs, options and their values.

    bash: `eval "$(sceneloom completion bash)"` in ~/.bashrc; zsh: the same with zsh in ~/.zshrc; fish: `sceneloom
    completion fish > ~/.config/fish/completions/sceneloom.fish`. Without SHELL: for the one that $SHELL names.
    """
    from sceneloom.cli.main import sceneloom

    chosen = shell or Path(os.environ.get("SHELL", "")).name
    maker = get_completion_class(chosen) if chosen in _INSTALLED else None
    if maker is None:
        raise OptionError(f"$SHELL names {chosen!r}; expected one of {', '.join(_INSTALLED)}: give one")
    script = maker(sceneloom, {}, "sceneloom", "_SCENELOOM_COMPLETE")
    # not by `source()`, which starts bash to ask for its version
    click.echo(script.source_template % script.source_vars())
    if os.isatty(1):
        click.echo(f"to use it: {_INSTALLED[chosen]}", err=True)
