"""A coverage-guided fuzzer of the `.sfs` codec: whatever the bytes, the answer is values or an error of ours.

Run with `python -m tests.malformed.fuzz_sfs [--seconds 600] [FOLDER]`; it needs atheris. The folder collects the inputs
that reach something new, and in it, as files named `crash-…`, those that were answered otherwise. It begins with small
scenes of every sensor and every annotation. pytest does not run it; what it finds becomes a test of its own.
"""

import argparse
import contextlib
import copy
import functools
import json
import operator
import random
import sys
import tempfile
from pathlib import Path
from typing import Any

import atheris
from tests.conftest import _encode_sfs as encode_sfs
from tests.malformed.damage import ANNOTATIONS, ATTRIBUTES, OURS, SENSORS, header, locations, look_at_everything

with atheris.instrument_imports(include=["sceneloom.formats.sfs", "sceneloom.scene"]):
    from sceneloom.errors import SceneloomError
    from sceneloom.formats.sfs.salvage import salvage
    from sceneloom.formats.sfs.spec import FORMAT

LONGEST = 1 << 14
STRANGE = [None, True, -1, 0, 7, 2**31, 2**63, -(2**63), 10**30, 1e300, 0.5, float("nan"), float("inf"), "", "x", "0"]
STRANGE += ["sonar", "lidar", "camera", "cuboid", [], [None], [[]], [[0.5] * 7], {}, {"id": 1}, {"timestamps": [1]}]
"""What takes the position of values of a header."""


def seeds() -> dict[str, bytes]:
    """A small scene for each type of sensor and of annotation, and one of our own metadata."""
    found = {kind: header([kind], time_offset=5) for kind in SENSORS}
    found |= {kind: header(annotations=[kind], time_unit="nanoseconds") for kind in ANNOTATIONS}
    found["ours"] = header(["odometry"], attributes=ATTRIBUTES, metadata={"sceneloom": OURS})
    return {name: encode_sfs(content) for name, content in found.items()}


def owners(node: Any) -> list[tuple[Any, Any]]:
    """What holds each value of a header, and under which key."""
    return [(functools.reduce(operator.getitem, path[:-1], node), path[-1]) for path in locations(node)]


def changed(content: bytes, longest: int, seed: int) -> bytes:
    """Change a value of the header into another, take it out or put it in twice; else change bytes."""
    rng = random.Random(seed)
    stop = content.find(b"\0")
    try:
        values = json.loads(content[:stop])
        for _ in range(rng.randint(1, 3)):
            holder, key = rng.choice(owners(values))
            other, its_key = rng.choice(owners(values))
            dice = rng.random()
            if dice < 0.2:
                del holder[key]
            elif dice < 0.3 and isinstance(holder, list):
                holder.append(copy.deepcopy(holder[key]))
            elif dice < 0.6:
                holder[key] = copy.deepcopy(other[its_key])
            else:
                holder[key] = copy.deepcopy(rng.choice(STRANGE))
        found = json.dumps(values, separators=(",", ":")).encode() + content[stop:]
    except (ValueError, IndexError, RecursionError):
        found = b""
    if not found or len(found) > longest or rng.random() < 0.2:
        return bytes(atheris.Mutate(content, longest))
    return found


def use(path: Path) -> None:
    """Open a file in every way, touch all that is in it, and salvage it."""
    FORMAT.sniff(path)
    for lenient in (False, True):
        with contextlib.suppress(SceneloomError), FORMAT.open(path, lenient=lenient) as scene:
            look_at_everything(scene)
            repr(scene.annotations)
    with contextlib.suppress(SceneloomError):
        target = path.with_suffix(".out.sfs")
        salvage(path, target, overwrite=True)
        FORMAT.open(target).close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=600)
    parser.add_argument("folder", type=Path, nargs="?")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = asked.folder or Path(scratch) / "inputs"
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in seeds().items():
            (folder / f"seed-{name}").write_bytes(content)
        path = Path(scratch) / "scene.sfs"

        def try_one(content: bytes) -> None:
            path.unlink(missing_ok=True)
            path.write_bytes(content)
            use(path)

        limits = [f"-max_total_time={asked.seconds}", f"-max_len={LONGEST}", "-timeout=20", "-rss_limit_mb=2048"]
        arguments = [sys.argv[0], *limits, f"-artifact_prefix={folder}/", str(folder)]
        atheris.Setup(arguments, try_one, custom_mutator=changed)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
