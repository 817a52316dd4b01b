"""Files of rigs with changes of any kind: a rig, or one error of ours."""

from collections import Counter

import numpy as np
import pytest
from tests.malformed.damage import STRANGE, locations, replaced
from tests.malformed.mutants import mutant_of
from tests.unit.formats.rig_files.test_reader import DS, FILES, basalt

from sceneloom.errors import SceneloomError
from sceneloom.formats.rig_files.reader import read_rig


def outcome(path, content):
    path.write_bytes(content)
    fault = ""
    try:
        read_rig(path)
    except SceneloomError as error:
        fault = str(error)
    assert not fault or str(path.parent) in fault, fault
    return "refused" if fault else "read"


@pytest.mark.parametrize("count", [60, pytest.param(3000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FILES)
def test_a_mutant_of_a_file_of_a_rig_is_read_or_refused_with_its_name(name, count, tmp_path):
    (tmp_path / "left.yaml").write_text(FILES["mei.yaml"])
    chance = np.random.default_rng([7, *name.encode()])
    whole = FILES[name].encode()
    assert outcome(tmp_path / name, whole) == "read"
    tried = Counter(outcome(tmp_path / name, mutant_of(whole, chance)) for _ in range(count))
    assert set(tried) == {"read", "refused"}
    for content in (b"", b"\xff\xfe", whole[: len(whole) // 2], b"[" * 100_000, b"<a>" * 100_000, b'{"a":' * 100_000):
        outcome(tmp_path / name, content)


def test_strange_values_in_the_position_of_any_value_of_a_calibration_are_refused_or_read(tmp_path):
    import msgspec

    sound = msgspec.json.decode(basalt("ds", DS))
    for path in locations(sound):
        for value in STRANGE:
            outcome(tmp_path / "basalt.json", msgspec.json.encode(replaced(sound, path, value)))
        outcome(tmp_path / "basalt.json", msgspec.json.encode(replaced(sound, path)))
