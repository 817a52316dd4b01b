"""Run the commands, and record or compare what they write: `python -m tests.behaviour [--record] [NAME ...]`.

`--record` makes the snapshot anew, `tests/behaviour/snapshot.json`: all is run twice, and what differs between the
two is not compared. Without it, what differs from the snapshot is printed, location by location; `~` where counts and
sums agree to 1e-9 and bytes do not. Names run only these commands and those that they need. Uses as many processes as
there are processors.
"""

import argparse
import concurrent.futures
import contextlib
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from tests.behaviour.commands import COMMANDS, RENAMED_OPTIONS, Command, renamed
from tests.behaviour.contents import Digest, contents, fields

SNAPSHOT = Path(__file__).with_name("snapshot.json")
_ROOT = Path(__file__).parents[2]
_DATA = Path(os.environ.get("SCENELOOM_DATA", Path(__file__).parents[3] / "shared" / "data")).resolve()
_SECONDS = 900.0


def run(command: Command, folder: Path) -> dict[str, Any]:
    """Run one command in a process of its own; its outputs stay in the folder for those that need them.

    Returns:
        exit code, what it printed as JSON, and what it wrote.
    """
    out = folder / command.name
    out.mkdir()
    locations = {name: str(folder / name) for name in command.needs} | {"data": str(_DATA), "out": str(out)}
    printed: dict[str, Digest] = {}
    with contextlib.ExitStack() as stack:
        if "{address}" in command.words:
            locations["address"] = stack.enter_context(_service(folder))
        for number, words in enumerate(command.words.split("&&")):
            done = _call([word.format(**locations) for word in _now(words)], out)
            with contextlib.suppress(json.JSONDecodeError):
                for location, value in fields(json.loads(done.stdout)):
                    printed.setdefault(f"{number or ''}{location}", Digest()).take(value)
            if command.words.startswith("completion"):
                printed["text"] = Digest()
                printed["text"].take(done.stdout)
            if done.returncode:
                break
    lines = done.stderr.decode(errors="replace").strip().splitlines()
    return {
        "code": done.returncode,
        "printed": {location: digest.found() for location, digest in sorted(printed.items())},
        "written": contents(out),
        "ended": lines[-1][-300:] if done.returncode and lines else "",
    }


def _now(words: str) -> list[str]:
    """Split words, with options as they are called now."""
    now = [RENAMED_OPTIONS.get(word, word) for word in shlex.split(words)]
    return [part for word in now for part in word.split()]


def _call(words: list[str], out: Path) -> subprocess.CompletedProcess[bytes]:
    further = [] if words[0] in {"completion", "inputs"} else ["--json"]
    program = ["tests.behaviour.inputs", *words[1:]] if words[0] == "inputs" else ["sceneloom", *words]
    return subprocess.run(
        [sys.executable, "-m", *program, *further],
        capture_output=True,
        cwd=out,
        env=os.environ | {"PYTHONPATH": str(_ROOT)},
        timeout=_SECONDS,
        check=False,
    )


@contextlib.contextmanager
def _service(folder: Path) -> Iterator[str]:
    words = [sys.executable, "-m", "sceneloom", *_now("serve --json")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=folder) as server:
        assert server.stdout is not None
        stated = ""
        for line in server.stdout:
            stated += line.decode()
            if line.rstrip() == b"}" or line.rstrip().endswith(b"}"):
                break
        try:
            yield json.loads(stated)["address"]
        finally:
            server.terminate()


def run_all(names: list[str]) -> dict[str, Any]:
    """Run the named commands, or all, each after those that it needs, as many side by side as there are processors."""
    known = {command.name: command for command in COMMANDS}
    wanted: set[str] = set()
    todo = list(names or known)
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
                problem = future.exception()
                nothing = {"code": -1, "printed": {}, "written": {}, "ended": f"cannot be measured: {problem!r}"}
                found[name] = nothing if problem else future.result()
                ended = found[name]["ended"]
                sys.stderr.write(f"{len(found)}/{len(wanted)} {name}: exit {found[name]['code']} {ended}\n")
    return dict(sorted(found.items()))


def differences(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """Report what of one command differs.

    Returns:
        a line each; those that begin with `~` agree within rounding.
    """
    lines = []
    if before["code"] != after["code"]:
        lines.append(f"exit code {before['code']} -> {after['code']} ({after.get('ended', '')})")
    for part in ("printed", "written"):
        new = after[part]
        old = {key if key in new else renamed(key): value for key, value in before[part].items()}
        lines += [f"{part} {key}: gone" for key in old if key not in new and old[key]]
        lines += [f"{part} {key}: new" for key in new if key not in old]
        for key in sorted(old.keys() & new.keys()):
            if old[key] and new[key] and not _same(old[key], new[key]):
                near = "~ " if _near(old[key], new[key]) else ""
                lines.append(f"{near}{part} {key}: {_short(old[key])} -> {_short(new[key])}")
    return lines


def _same(old: dict[str, Any], new: dict[str, Any]) -> bool:
    if "texts" in old and "texts" in new:
        texts = {renamed(text) for text in old["texts"]}
        return old["n"] == new["n"] and (old["texts"] == new["texts"] or texts == set(new["texts"]))
    return old == new


def _near(old: dict[str, Any], new: dict[str, Any]) -> bool:
    if old["n"] != new["n"] or "sums" not in old or "sums" not in new:
        return False
    return bool(np.allclose(old["sums"], new["sums"], rtol=0.0, atol=1e-9 * (1.0 + abs(old["sums"][1]))))


def _short(value: dict[str, Any]) -> str:
    return f"{value['n']} of {value.get('texts') or value.get('sums') or value.get('sha')}"[:160]


def _lines(found: dict[str, Any]) -> str:
    """Write the snapshot with a line for each location."""
    commands = []
    for name, one in sorted(found.items()):
        parts = [f'"code": {one["code"]}']
        for part in ("printed", "written"):
            rows = [
                f"{json.dumps(key, ensure_ascii=False)}: {_plain(value)}" for key, value in sorted(one[part].items())
            ]
            parts.append(f'"{part}": {{' + "\n" * bool(rows) + ",\n".join(rows) + "}")
        commands.append(f'"{name}": {{' + ", ".join(parts) + "}")
    return "{\n" + ",\n".join(commands) + "\n}\n"


def _plain(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))


def _stable(first: dict[str, Any], second: dict[str, Any]) -> dict[str, Any]:
    """Leave out values that were others at the second run: null says that they are not compared."""
    unstable = {line.removeprefix("~ ").rsplit(": ", 1)[0].split(": ")[0] for line in differences(first, second)}
    for part in ("printed", "written"):
        keys = first[part].keys() | second[part].keys()
        first[part] = {key: None if f"{part} {key}" in unstable else first[part][key] for key in sorted(keys)}
    return first


def main() -> None:
    """Record, or compare and exit with 1 where something differs by more than rounding."""
    parser = argparse.ArgumentParser(prog="python -m tests.behaviour", description=__doc__)
    parser.add_argument("--record", action="store_true", help="make the snapshot anew")
    parser.add_argument("names", nargs="*", help="only these commands")
    options = parser.parse_args()
    begun = time.monotonic()
    found = run_all(options.names)
    if options.record:
        again = run_all(options.names)
        for name, after in again.items():
            sys.stdout.writelines(f"{name}: not compared: {line}\n" for line in differences(found[name], after))
            found[name] = _stable(found[name], after)
        before = json.loads(SNAPSHOT.read_text()) if options.names and SNAPSHOT.exists() else {}
        SNAPSHOT.write_text(_lines(before | found))
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
