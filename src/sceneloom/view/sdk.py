"""The Rerun SDK, imported when it is first needed, and kept from talking to anyone."""

import importlib.util
import os
import platform
import subprocess
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from sceneloom.errors import MissingExtraError, how_to_install

_FOLDERS = ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME", "XDG_STATE_HOME")
"""Where programs of a desktop keep what they remember.

Source: XDG Base Directory Specification 0.8.
"""


_PROXIES = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY")
_NOBODY = "http://127.0.0.1:1"
"""A proxy that is not there: what would go through it goes nowhere."""
_NEAR = "127.0.0.1,localhost"


@cache
def sdk() -> Any:
    """Import `rerun`.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import rerun
    except ImportError as error:
        raise MissingExtraError(f"viewing needs rerun-sdk: {how_to_install('view')}") from error
    return rerun


@cache
def blueprint_sdk() -> Any:
    """Import `rerun.blueprint`, of which layouts are made.

    Raises:
        MissingExtraError: it is not installed.
    """
    sdk()
    import rerun.blueprint

    return rerun.blueprint


def viewer_command(*options: str) -> list[str]:
    """The words that run Rerun's own program, which is installed with its SDK.

    The program itself and not the Python module that starts it: a program that is ended would leave its child behind.

    Raises:
        MissingExtraError: it is not installed.
    """
    sdk()
    found = importlib.util.find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise MissingExtraError(f"Rerun's viewer is missing: {how_to_install('view')}")
    name = "rerun.exe" if platform.system() == "Windows" else "rerun"
    return [str(Path(found.origin).with_name(name)), *options]


def silent_environment(
    folder: Path, given: Mapping[str, str] | None = None, *, offline: bool = True
) -> dict[str, str]:
    """Give an environment in which Rerun's program sends no usage data and writes to `folder` only.

    The program sends none after its own command `analytics disable`, which it keeps in its folder of settings: that is
    a folder of ours here, so that nothing is written to the home folder, and what a person has set there stays as is.
    It would still ask for its newest version and for examples; that goes to a proxy that is not there.

    Args:
        folder: an empty folder that lives as long as the program.
        given: the environment to begin with; None for this process's.
        offline: let the program reach this machine only.
    """
    environment = {**(os.environ if given is None else given), **dict.fromkeys(_FOLDERS, str(folder))}
    if offline:
        # both spellings are in use, and the small one counts more
        for name in _PROXIES:
            environment |= {name: _NOBODY, name.lower(): _NOBODY}
        environment |= {"NO_PROXY": _NEAR, "no_proxy": _NEAR}
    if platform.system() == "Darwin":
        environment["HOME"] = str(folder)
    subprocess.run(  # noqa: S603 - our own words
        viewer_command("analytics", "disable"),
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=True,
    )
    return environment
