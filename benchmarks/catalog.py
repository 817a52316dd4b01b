"""How fast a catalogue of 2 million boxes answers, and how long the update of one scene takes.

Run with `python -m benchmarks.catalog [--scenes 200] [--boxes 2000000] [--keep DIR]`. Synthetic drives of 20 s at 10 Hz
with fixes, each with as many objects as it takes; one drive is a scene file, which is written anew and updated. Each
query is reported twice: as one call does it, the catalogue opened before, and asked of a catalogue that is open
    already;
the least of several runs, by the wall and, since DuckDB uses all processors, by the processor; beside it what pyarrow
takes for a part of it, from the same files. Below 200 ms is what a query may take, 1 s what an update may.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import sceneloom
from sceneloom.catalog import Selection, opened, query, update
from sceneloom.catalog.building import PART_ROWS, Entry, Fresh, Parts, scene_name, scene_rows, write_draft
from sceneloom.catalog.database import sql_of
from sceneloom.catalog.storage import MARKER, Layout
from sceneloom.geometry.geodesy import geodetic_from_enu
from sceneloom.scene import AttributePath, CuboidAnnotation, CuboidPath, GnssSensor, OdometrySensor, Poses, Scene

FRAMES = 200
LABELS = ("car", "truck", "bus", "pedestrian.adult", "pedestrian.child", "bicycle", "cone", "sign")
QUERIES: dict[str, str | Selection] = {
    "label, distance, speed": Selection(labels=("pedestrian*",), distance=(0.0, 15.0), speed=(5.0, 20.0)),
    "label, count": Selection(labels=("bus",), count=10),
    "location": Selection(near=(48.15, 11.5, 2000.0)),
    "location, label, time": Selection(near=(48.15, 11.5, 2000.0), labels=("truck",), start=5.0, stop=15.0),
    "attribute of the scene": Selection(labels=("bicycle",), attributes=(("weather", "rain"),)),
    "attribute of the box": Selection(labels=("car",), attributes=(("parked", "true"),), distance=(0.0, 10.0)),
    "SQL: boxes by class": "SELECT label, count(*), min(distance), avg(speed) FROM annotations GROUP BY label",
    "SQL: nearest of each drive": "SELECT scene, min(nearest) FROM tracks GROUP BY scene ORDER BY 2 LIMIT 10",
}


def make_scene(seed: int, objects: int) -> Scene:
    """A drive through one of many locations, objects along its trajectory."""
    rng = np.random.default_rng(seed)
    times = np.arange(FRAMES, dtype=np.int64) * 100_000_000
    t = times / 1e9
    points = np.stack([rng.uniform(0, 25) * t, np.sin(t), 0 * t], axis=-1)
    origin = (48.0 + rng.uniform(0, 0.3), 11.3 + rng.uniform(0, 0.4), 500.0)
    unknown = np.full(FRAMES, np.nan)
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (FRAMES, 1))
    parked = AttributePath("parked", ("true",), static=True)
    boxes = []
    for number in range(objects):
        values = np.empty((FRAMES, 9))
        values[:, :3] = 4.5, 1.9, 1.6
        values[:, 3:6] = rng.uniform(-60, 300), rng.uniform(-30, 30), 0.0
        values[:, 3] += rng.normal(0, 5) * t
        values[:, 6:] = 0.0, 0.0, rng.uniform(-180, 180)
        label = LABELS[int(rng.integers(len(LABELS)))]
        stated = (parked,) if rng.uniform() < 0.2 else ()
        boxes.append(CuboidAnnotation(f"{seed}-{number}", CuboidPath(times, values), label, attributes=stated))
    weather = AttributePath("weather", ("rain" if rng.uniform() < 0.2 else "dry",), static=True)
    gnss = GnssSensor("gnss", times, geodetic_from_enu(points, origin), unknown, unknown)
    ego = OdometrySensor("ego", Poses(times, points, rotations))
    return Scene(sensors=(gnss, ego), annotations=tuple(boxes), attributes=(weather,))


def fill(folder: Path, scenes: int, objects: int) -> None:
    """Put all drives but the one that is a file into a catalogue, unless they are there."""
    if (folder / MARKER).is_file():
        return
    layout = Layout.made(folder, overwrite=False)
    with layout.held():
        parts, waiting, processor = Parts(layout), [], 0.0
        for seed in range(scenes):
            path = f"/drives/{seed}.sfs"
            scene = make_scene(seed, objects)
            start = time.process_time()
            rows = scene_rows(scene, path=path, options={}, fingerprint="made up", size_bytes=None, findings=())
            name, draft = scene_name(path, {}), layout.drafts / str(seed)
            waiting.append(Fresh(name, Entry(path, {}, "made up"), draft, write_draft(name, rows, draft)))
            if sum(fresh.rows for fresh in waiting) >= PART_ROWS or seed == scenes - 1:
                parts.put(waiting)
                waiting.clear()
            processor += time.process_time() - start
    size = sum(file.stat().st_size for file in folder.rglob("*.parquet"))
    print(f"tables made in {processor:.1f} s of processor time, {size / 1e6:.0f} MB")


def filtered(folder: Path, where: Callable[[Any], Any], columns: list[str], group: str | None = None) -> int:
    """What pyarrow does of a query: it reads the boxes that fit, and counts them by groups."""
    import pyarrow.compute as pc
    import pyarrow.dataset as ds

    rows = ds.dataset(folder / "annotations").to_table(columns=columns, filter=where(pc))
    return len(rows if group is None else rows.group_by(columns).aggregate([([], "count_all")]))


PEERS: dict[str, Callable[[Path], int]] = {
    "label, distance, speed": lambda folder: filtered(
        folder,
        lambda pc: (
            pc.match_like(pc.field("label"), "pedestrian%")
            & (pc.field("distance") <= 15.0)
            & (pc.field("ego_speed") >= 5.0)
            & (pc.field("ego_speed") <= 20.0)
        ),
        ["scene", "timestamp_ns", "seconds"],
    ),
    "label, count": lambda folder: filtered(
        folder, lambda pc: pc.field("label") == "bus", ["scene", "timestamp_ns"], "count"
    ),
    "SQL: boxes by class": lambda folder: filtered(folder, lambda _: None, ["label"], "count"),
}
"""What another program does with the same files: less than the query, which makes spans, too, or other figures."""


def least(work: Callable[[], object], runs: int, *, children: bool = False) -> tuple[float, float]:
    """Least time by the wall and by the processor [ms]; that of `children` is that of processes that ended."""

    def processor_seconds() -> float:
        used = resource.getrusage(resource.RUSAGE_CHILDREN if children else resource.RUSAGE_SELF)
        return used.ru_utime + used.ru_stime

    walls, processors = [], []
    for _ in range(runs):
        wall, processor = time.perf_counter(), processor_seconds()
        work()
        walls.append(time.perf_counter() - wall)
        processors.append(processor_seconds() - processor)
    return 1e3 * min(walls), 1e3 * min(processors)


def cell(times: tuple[float, float] | None) -> str:
    """Wall and processor [ms] in a column."""
    return f"{'' if times is None else f'{times[0]:.0f} ms ({times[1]:.0f} cpu)':>20}"


def ask(folder: Path, runs: int) -> None:
    """Ask all queries in all ways."""
    print(f"{'query':28}{'rows':>7}{'one call':>20}{'open already':>20}{'pyarrow, part of it':>20}")
    with opened(folder) as database:
        for name, wanted in QUERIES.items():
            sql, values = (wanted, ()) if isinstance(wanted, str) else sql_of(wanted)
            rows = len(database.query(sql, values).rows)
            once = least(lambda wanted=wanted: query(folder, wanted), runs)
            again = least(lambda sql=sql, values=values: database.query(sql, values), runs)
            peer = least(lambda name=name: PEERS[name](folder), runs) if name in PEERS else None
            print(f"{name:28}{rows:7}{cell(once)}{cell(again)}{cell(peer)}")
    command = [sys.executable, "-m", "sceneloom", "catalog", "query", str(folder)]
    for title, words in (
        ("the command, label and count", [*command, "--label", "bus", "--count", "10"]),
        ("sceneloom --version", [*command[:3], "--version"]),
        ("python -c 'import duckdb'", [sys.executable, "-c", "import duckdb"]),
    ):
        run = partial(subprocess.run, words, check=True, stdout=subprocess.DEVNULL)
        print(f"{title:35}{cell(least(run, runs, children=True))}")


def change(folder: Path, drive: Path, seed: int, objects: int, runs: int) -> None:
    """Write one drive anew and update the catalogue, several times."""
    times = []
    for run in range(runs):
        sceneloom.write(make_scene(seed + run, objects), drive, overwrite=True)
        times.append(least(lambda: update(folder, [drive]), 1))
        assert update(folder, [drive]).unchanged == 1
    print(f"update of one scene of {objects * FRAMES} boxes: {cell(min(times))}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--boxes", type=int, default=2_000_000)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--keep", type=Path)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        location = chosen.keep or Path(temporary)
        location.mkdir(exist_ok=True)
        folder, objects = location / "catalogue", chosen.boxes // chosen.scenes // FRAMES
        fill(folder, chosen.scenes, objects)
        ((count,),) = query(folder, "SELECT count(*) FROM annotations").rows
        files = len([*folder.rglob("*.parquet")])
        print(f"{count} boxes in {chosen.scenes} scenes, {files} files")
        ask(folder, chosen.runs)
        change(folder, location / "drive.sfs", chosen.scenes, objects, chosen.runs)
        nothing = least(lambda: update(folder, [location / "drive.sfs"]), chosen.runs)
        print(f"update where nothing changed: {cell(nothing)}")


if __name__ == "__main__":
    main()
