"""Programs of others that judge what we do, in environments of their own."""

import os
import shutil

import pytest


def python_with(package: str, variable: str) -> str:
    """The interpreter that an environment variable names; who asks is skipped where it names none.

    Args:
        package: what is installed there, as stated when it is not.
        variable: its name.
    """
    interpreter = os.environ.get(variable, "")
    if not interpreter:
        pytest.skip(f"no interpreter with {package}: set {variable}")
    found = shutil.which(interpreter)
    if found is None:
        pytest.fail(f"{variable}={interpreter} is not a program")
    return found
