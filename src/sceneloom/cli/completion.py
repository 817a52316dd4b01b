"""`sceneloom completion`: what a shell needs to complete verbs and options."""

import os
from pathlib import Path
from types import MappingProxyType

import click
from click.shell_completion import get_completion_class

from sceneloom.errors import OptionError

_INSTALLED = MappingProxyType(
    {
        "bash": 'eval "$(sceneloom completion bash)"  # in ~/.bashrc',
        "zsh": 'eval "$(sceneloom completion zsh)"  # in ~/.zshrc',
        "fish": "sceneloom completion fish > ~/.config/fish/completions/sceneloom.fish",
    }
)
"""How each shell takes it in."""


@click.command()
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
        raise OptionError(f"$SHELL names {chosen!r}; expected one of {', '.join(_INSTALLED)}: state which")
    script = maker(sceneloom, {}, "sceneloom", "_SCENELOOM_COMPLETE")
    # not by `source()`, which starts bash to ask for its version
    click.echo(script.source_template % script.source_vars())
    if os.isatty(1):
        click.echo(f"to use it: {_INSTALLED[chosen]}", err=True)
