"""What serving needs: kernels that are loaded before the first result, and the extra of the package."""

import subprocess
import sys

from sceneloom.service.warming import warm_up


def test_both_fusions_give_a_result():
    assert warm_up() == 2


WITHOUT_GRPC = """
import sys
sys.modules["grpc"] = None
from sceneloom.cli.main import main
main(["serve"])
"""


def test_without_the_extra_the_verb_says_how_to_get_it():
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_GRPC], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 1
    assert done.stdout == ""
    assert "pip install 'sceneloom[serve]'" in done.stderr
    assert "Traceback" not in done.stderr
