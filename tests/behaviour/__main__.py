"""Run the commands, and record or compare what they write: `python -m tests.behaviour [--record] [NAME ...]`.

`--record` makes the snapshot anew, `tests/behaviour/snapshot.json`. Without it, what differs from the snapshot is
printed, location by location; "within rounding" where counts and sums agree to 1e-9 and bytes do not. Names run only
these commands and those that they need. Uses as many processes as there are processors.
"""

import argparse
import concurrent.futures
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from tests.behaviour.commands import COMMANDS, RENAMED_FIELDS, RENAMED_OPTIONS, Command
from tests.behaviour.contents import contents, fields

SNAPSHOT = Path(__file__).with_name("snapshot.json")
_DATA = Path(os.environ.get("SCENELOOM_DATA", Path(__file__).parents[3] / "shared" / "data")).resolve()
_SECONDS = 900.0


def run(command: Command, folder: Path) -> dict[str, Any]:
    """Run one command in a process of its own; its outputs stay in the folder for those that need them.

    Returns:
        exit code, what it printed as JSON, and what it wrote.
    """
    out = folder / command.name
    out.mkdir()
    places = {name: str(folder / name) for name in command.needs} | {"data": str(_DATA), "out": str(out)}
    words = [RENAMED_OPTIONS.get(word, word) for word in shlex.split(command.words)]
    words = [part for word in words for part in word.split()]
    words = [word.format(**places) for word in words]
    done = subprocess.run(
        [sys.executable, "-m", "sceneloom", *words, "--json"],
        capture_output=True,
        cwd=out,
        timeout=_SECONDS,
        check=False,
    )
    try:
        said: Any = json.loads(done.stdout)
    except json.JSONDecodeError:
        said = None
    printed: dict[str, list[Any]] = {}
    for location, value in fields(said, RENAMED_FIELDS):
        printed.setdefault(location, []).append(value)
    lines = done.stderr.decode(errors="replace").strip().splitlines()
    return {
        "code": done.returncode,
        "printed": {location: _printed(values) for location, values in sorted(printed.items())},
        "written": contents(out, RENAMED_FIELDS),
        "ended": lines[-1][-300:] if done.returncode and lines else "",
    }


def _printed(values: list[Any]) -> Any:
    texts = sorted({value for value in values if isinstance(value, str)})
    if texts:
        return {"count": len(values), "texts": texts[:40]}
    numbers = np.concatenate([np.ravel(np.asarray(value, np.float64)) for value in values])
    return {"count": len(numbers), "sums": [float(numbers.sum()), float(np.abs(numbers).sum())]}


def run_all(names: list[str]) -> dict[str, Any]:
    """Run the named commands, or all, each after those that it needs, as many side by side as there are processors."""
    known = {command.name: command for command in COMMANDS}
    wanted: set[str] = set()
    todo = names or list(known)
    while todo:
        name = todo.pop()
        wanted.add(name)
        todo += [need for need in known[name].needs if need not in wanted]
    found: dict[str, Any] = {}
    with (
        tempfile.TemporaryDirectory(prefix="behaviour-") as folder,
        concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool,
    ):
        waiting = [command for command in COMMANDS if command.name in wanted]
        running: dict[concurrent.futures.Future[dict[str, Any]], str] = {}
        while waiting or running:
            for command in [one for one in waiting if all(need in found for need in one.needs)]:
                waiting.remove(command)
                running[pool.submit(run, command, Path(folder))] = command.name
            done, _ = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
            for future in done:
                name = running.pop(future)
                if future.exception() is not None:
                    pool.shutdown(wait=False, cancel_futures=True)
                    sys.stderr.write(f"{name}: cannot be measured\n")
                found[name] = future.result()
                ended = found[name]["ended"]
                sys.stderr.write(f"{len(found)}/{len(wanted)} {name}: exit {found[name]['code']} {ended}\n")
    return dict(sorted(found.items()))


def differences(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """Say what of one command differs.

    Returns:
        a line each; those that begin with `~` agree within rounding.
    """
    lines = []
    if before["code"] != after["code"]:
        lines.append(f"exit code {before['code']} -> {after['code']} ({after['ended']})")
    for part in ("printed", "written"):
        old = {RENAMED_FIELDS.get(key, key): value for key, value in before[part].items()}
        new = after[part]
        lines += [f"{part} {key}: gone" for key in old if key not in new]
        lines += [f"{part} {key}: new" for key in new if key not in old]
        for key in sorted(old.keys() & new.keys()):
            if old[key] != new[key]:
                near = old[key]["count"] == new[key]["count"] and "sums" in old[key] and "sums" in new[key]
                near = near and np.allclose(old[key]["sums"], new[key]["sums"], rtol=1e-9, atol=1e-9)
                near = near and any(new[key]["sums"])
                lines.append(f"{'~ ' if near else ''}{part} {key}: {_short(old[key])} -> {_short(new[key])}")
    return lines


def _short(value: dict[str, Any]) -> str:
    return f"{value['count']} of {value.get('texts') or value.get('sums')}"[:160]


def main() -> None:
    """Record, or compare and exit with 1 where something differs by more than rounding."""
    parser = argparse.ArgumentParser(prog="python -m tests.behaviour", description=__doc__)
    parser.add_argument("--record", action="store_true", help="make the snapshot anew")
    parser.add_argument("names", nargs="*", help="only these commands")
    options = parser.parse_args()
    begun = time.monotonic()
    found = run_all(options.names)
    if options.record:
        before = json.loads(SNAPSHOT.read_text()) if options.names and SNAPSHOT.exists() else {}
        SNAPSHOT.write_text(
            json.dumps(dict(sorted((before | found).items())), indent=0, ensure_ascii=False) + "\n"
        )
        sys.stdout.write(f"{len(found)} commands recorded in {time.monotonic() - begun:.0f} s\n")
        return
    snapshot = json.loads(SNAPSHOT.read_text())
    real = 0
    for name, after in found.items():
        lines = differences(snapshot[name], after) if name in snapshot else ["is not in the snapshot"]
        real += any(not line.startswith("~") for line in lines)
        sys.stdout.writelines(f"{name}: {line}\n" for line in lines)
    sys.stdout.write(f"{len(found)} commands, {real} differ, {time.monotonic() - begun:.0f} s\n")
    sys.exit(bool(real))


if __name__ == "__main__":
    main()
