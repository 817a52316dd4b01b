"""How fast a catalogue of 2 million boxes answers, and how long the update of one scene takes.

Run with `python -m benchmarks.catalog [--scenes 200] [--boxes 2000000] [--keep DIR]`. Made-up drives of 20 s at 10 Hz
with fixes, each with as many objects as it takes; one drive is a scene file, which is written anew and updated. Each
query is told twice: as one call does it, the catalogue opened before, and asked of a catalogue that is open already;
the least of several runs, by the wall and, since DuckDB uses all processors, by the processor. Below 200 ms is what a
query may take, 1 s what an update may.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import sceneloom
from sceneloom.catalog import Selection, opened, query, sql_of, update
from sceneloom.catalog.layout import Layout, scene_name
from sceneloom.catalog.rows import scene_rows
from sceneloom.geometry.geodesy import geodetic_from_enu
from sceneloom.scene import (
    AttributePath,
    CuboidAnnotation,
    CuboidPath,
    GnssSensor,
    OdometrySensor,
    PosePath,
    Scene,
)

FRAMES = 200
LABELS = ("car", "truck", "bus", "pedestrian.adult", "pedestrian.child", "bicycle", "cone", "sign")
QUERIES: dict[str, str | Selection] = {
    "label, distance, speed": Selection(labels=("pedestrian*",), distance=(0.0, 15.0), speed=(5.0, 20.0)),
    "label, count": Selection(labels=("bus",), count=10),
    "place": Selection(near=(48.15, 11.5, 2000.0)),
    "place, label, time": Selection(near=(48.15, 11.5, 2000.0), labels=("truck",), start=5.0, stop=15.0),
    "attribute of the scene": Selection(labels=("bicycle",), attributes=(("weather", "rain"),)),
    "attribute of the box": Selection(
        labels=("car",), attributes=(("parked", "true"),), distance=(0.0, 10.0)
    ),
    "SQL: boxes by class": "SELECT label, count(*), min(distance), avg(speed) FROM annotations GROUP BY label",
    "SQL: nearest of each drive": "SELECT scene, min(nearest) FROM tracks GROUP BY scene ORDER BY 2 LIMIT 10",
}


def make_scene(seed: int, objects: int) -> Scene:
    """A drive through one of many places, objects along its way."""
    rng = np.random.default_rng(seed)
    times = np.arange(FRAMES, dtype=np.int64) * 100_000_000
    t = times / 1e9
    points = np.stack([rng.uniform(0, 25) * t, np.sin(t), 0 * t], axis=-1)
    origin = (48.0 + rng.uniform(0, 0.3), 11.3 + rng.uniform(0, 0.4), 500.0)
    unknown = np.full(FRAMES, np.nan)
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (FRAMES, 1))
    parked = AttributePath("parked", ("true",), static=True)
    boxes = []
    for number in range(objects):
        values = np.empty((FRAMES, 9))
        values[:, :3] = 4.5, 1.9, 1.6
        values[:, 3:6] = rng.uniform(-60, 300), rng.uniform(-30, 30), 0.0
        values[:, 3] += rng.normal(0, 5) * t
        values[:, 6:] = 0.0, 0.0, rng.uniform(-180, 180)
        label = LABELS[int(rng.integers(len(LABELS)))]
        said = (parked,) if rng.uniform() < 0.2 else ()
        boxes.append(CuboidAnnotation(f"{seed}-{number}", CuboidPath(times, values), label, attributes=said))
    weather = AttributePath("weather", ("rain" if rng.uniform() < 0.2 else "dry",), static=True)
    gnss = GnssSensor("gnss", times, geodetic_from_enu(points, origin), unknown, unknown)
    ego = OdometrySensor("ego", PosePath(times, points, turns))
    return Scene(sensors=(gnss, ego), annotations=tuple(boxes), attributes=(weather,))


def fill(folder: Path, scenes: int, objects: int) -> None:
    """Put all drives but the one that is a file into a catalogue, unless they are there."""
    layout = Layout.made(folder, overwrite=True)
    if len(layout.scenes()) >= scenes:
        return
    start = time.perf_counter()
    for seed in range(scenes):
        path = f"/drives/{seed}.sfs"
        rows = scene_rows(
            make_scene(seed, objects),
            path=path,
            options={},
            fingerprint="made up",
            size_bytes=None,
            findings=(),
        )
        layout.write(scene_name(path, {}), rows)
    seconds = time.perf_counter() - start
    size = sum(file.stat().st_size for file in folder.rglob("*.parquet"))
    print(f"made in {seconds:.1f} s, {size / 1e6:.0f} MB")


def least(work: Callable[[], object], runs: int) -> tuple[float, float]:
    """Least time by the wall and by the processor [ms]."""
    walls, processors = [], []
    for _ in range(runs):
        wall, processor = time.perf_counter(), time.process_time()
        work()
        walls.append(time.perf_counter() - wall)
        processors.append(time.process_time() - processor)
    return 1e3 * min(walls), 1e3 * min(processors)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--boxes", type=int, default=2_000_000)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--keep", type=Path)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        place = chosen.keep or Path(temporary)
        place.mkdir(exist_ok=True)
        folder, objects = place / "catalogue", chosen.boxes // chosen.scenes // FRAMES
        fill(folder, chosen.scenes, objects)
        ((count,),) = query(folder, "SELECT count(*) FROM annotations").rows
        print(
            f"{count} boxes in {chosen.scenes} scenes\n{'query':28}{'rows':>7}{'one call':>22}{'open already':>22}"
        )
        with opened(folder) as database:
            for name, wanted in QUERIES.items():
                sql, values = (wanted, ()) if isinstance(wanted, str) else sql_of(wanted)
                rows = len(database.query(sql, values).rows)
                once = least(lambda wanted=wanted: query(folder, wanted), chosen.runs)
                again = least(lambda sql=sql, values=values: database.query(sql, values), chosen.runs)
                cells = "".join(f"{f'{wall:.0f} ms ({cpu:.0f} cpu)':>22}" for wall, cpu in (once, again))
                print(f"{name:28}{rows:7}{cells}")
        drive = place / "drive.sfs"
        walls = []
        for run in range(chosen.runs):
            sceneloom.write(make_scene(chosen.scenes + run, objects), drive, overwrite=True)
            start = time.perf_counter()
            report = update(folder, [drive])
            walls.append(time.perf_counter() - start)
            assert len(report.added) + len(report.changed) == 1
        print(f"update of one scene of {objects * FRAMES} boxes: {1e3 * min(walls):.0f} ms")


if __name__ == "__main__":
    main()
