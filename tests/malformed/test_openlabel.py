"""OpenLABEL files with parts exchanged, taken out or cut off: a scene or an error of ours, nothing else."""

import json
import random
from contextlib import suppress
from pathlib import Path

import pytest
from tests.malformed.damage import STRANGE, locations, replaced

from sceneloom.errors import SceneloomError
from sceneloom.formats.openlabel.spec import FORMAT

GOLDEN = Path(__file__).parents[1] / "interop" / "golden" / "openlabel_vcd.json"


@pytest.mark.parametrize("seed", range(2))
def test_parts_that_are_exchanged_give_a_scene_or_an_error_of_ours(tmp_path, seed):
    content = json.loads(GOLDEN.read_text())
    # what only we write besides, so that it is exchanged, too
    content["openlabel"]["metadata"]["sceneloom"] = {
        "object": {"0": {"id": "a", "stationary": True}, "1": {"id": 5, "shape": "polygon", "extras": {"b": 1}}},
        "event": {"0": {"id": "e", "start_ns": 5, "duration_ns": None}},
        "trajectory": "trajectory",
        "metadata": {"city": "x"},
    }
    choice, path = random.Random(seed), tmp_path / "strange.json"
    everywhere = list(locations(content))
    for _ in range(25):
        strange = choice.choice([*STRANGE, 0, 1e308, 10**17, [1, 2], ["a"], [[1]]])
        path.write_text(json.dumps(replaced(content, choice.choice(everywhere), strange)))
        for lenient in (False, True):
            with suppress(SceneloomError):
                FORMAT.open(path, lenient=lenient)


def test_a_file_that_is_cut_off_is_no_json(tmp_path):
    text = GOLDEN.read_text()
    for stop in range(30, len(text) - 2, 1997):
        path = tmp_path / "cut.json"
        path.write_text(text[:stop])
        with pytest.raises(SceneloomError, match="is no JSON"):
            FORMAT.open(path)
