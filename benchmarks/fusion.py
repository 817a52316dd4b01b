"""What fusing a cloud with images costs: projection, windowed visibility, depth image and colours.

Run with `python -m benchmarks.fusion [--points 250000] [--repetitions 15] [--only whole,stages,rig,camera models]
[--before CHECKOUT]`. The cloud is the simulated street of `benchmarks.projection`, nearly all of it in one 1920x1080
image whose camera model has the eight coefficients of the rational Brown-Conrady model.

- whole: one thread beside NumPy and OpenCV, and two threads beside one. With `--before` two processes run the same, one
  of them with another checkout of this library. All take rotates; one thread is counted by processor time, which other
  programs do not stretch. Two are counted by the clock, best of all runs, which needs a machine with two idle
  processors; and by processor time as if each had one: parts run in order, and of those that would run at once the
  longest counts.
- stages: each stage's time, the bytes that it cannot but read or write, and what share that is of the memory's
  bandwidth, as plain copying has it in the same run.
- rig: a cloud all around and six such cameras; frame sets a second by the clock and by processor time, at best.
- camera models: the projection of each model beside that of a pinhole.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import math
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from benchmarks.projection import CAMERA_FROM_BODY, HEIGHT, WIDTH, draw, inside_image
from benchmarks.street import CAMERA_WORLD, LIDAR_WORLD, make_street
from benchmarks.visibility_in_numpy import find_visible_in_numpy
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import intrinsics_vector, projection_kernel
from sceneloom.colouring import LidarTrajectory, ViewRequest, VisibilitySettings, algorithms, fuse_by_projection
from sceneloom.colouring import algorithms as view_module
from sceneloom.colouring import visibility as visibility_module
from sceneloom.geometry.rigid import RigidTransform

COEFFICIENTS = (-0.1, 0.02, 5e-4, -3e-4, 1e-3, 0.05, -0.01, 2e-3)
CAMERA = Camera("brown_conrady", WIDTH, HEIGHT, 1100.0, 1100.0, 959.5, 539.5, COEFFICIENTS)
RUNS_A_ROTATION = 4
CLOUDS = ("street", "shuffled", "anywhere")


def make_cloud(name, count):
    """The street, its points by lines or shuffled; or points anywhere, most of which hide behind others: the worst."""
    random = np.random.default_rng(2)
    if name != "anywhere":
        street = make_street(count)
        return street if name == "street" else random.permutation(street)
    return CAMERA_WORLD + random.uniform((2, -40, -2), (80, 40, 6), (count, 3))


def position_camera(rotation_deg=0.0):
    c, s = math.cos(math.radians(rotation_deg)), math.sin(math.radians(rotation_deg))
    rotated = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return RigidTransform(rotated @ CAMERA_FROM_BODY.T, CAMERA_WORLD)


def request(number=0, rotation_deg=0.0):
    rgb = np.random.default_rng(number).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    return ViewRequest(
        camera_id=f"camera {number}",
        camera_index=number,
        camera=CAMERA,
        timestamp_ns=0,
        world_from_camera=position_camera(rotation_deg),
        rgb=rgb,
    )


class Task:
    """One cloud and one image, fused again and again."""

    def __init__(self, name, count):
        self.points, self.request = make_cloud(name, count), request()
        self.matrix = self.request.world_from_camera.inverse().matrix
        self.trajectory = LidarTrajectory(np.tile(LIDAR_WORLD, (2, 1)), np.zeros(count, np.float32))

    def fuse(self, *, known_trajectory=True, threads=None):
        settings = VisibilitySettings() if threads is None else VisibilitySettings(threads=threads)
        return fuse_by_projection(
            self.points, [self.request], settings, trajectory=self.trajectory if known_trajectory else None
        )

    def numpy(self, project, *, windowed):
        ids, cells, depths = project(self.points, self.matrix)
        settings = VisibilitySettings()
        seen = find_visible_in_numpy(self.points[ids], self.matrix, settings) if windowed else None
        return draw(ids, cells, depths, self.request.rgb, len(self.points), seen)


def in_image(u, v, z):
    ids = inside_image(u, v, z)
    rows, columns = np.floor(v[ids] + 0.5).astype(np.int64), np.floor(u[ids] + 0.5).astype(np.int64)
    return ids, rows * WIDTH + columns, z[ids]


def project_with_numpy(points, matrix):
    """Ids, pixel numbers and depths of the points in the image, as textbooks write it."""
    k1, k2, p1, p2, k3, k4, k5, k6 = COEFFICIENTS
    x, y, z = (points @ matrix[:3, :3].T + matrix[:3, 3]).T
    x, y = x / z, y / z
    s, xy = x * x + y * y, x * y
    radial = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
    u = CAMERA.fx * (x * radial + 2 * p1 * xy + p2 * (s + 2 * x * x)) + CAMERA.cx
    v = CAMERA.fy * (y * radial + p1 * (s + 2 * y * y) + 2 * p2 * xy) + CAMERA.cy
    return in_image(u, v, z)


def project_with_cv2(points, matrix):
    """The same with OpenCV's projection."""
    import cv2

    cv2.setNumThreads(1)
    camera_model = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    rotation = cv2.Rodrigues(matrix[:3, :3])[0]
    u, v = cv2.projectPoints(points, rotation, matrix[:3, 3], camera_model, np.array(COEFFICIENTS))[0][:, 0].T
    return in_image(u, v, points @ matrix[2, :3] + matrix[2, 3])


def spent(run, clock=time.process_time):
    """Milliseconds of one run."""
    start = clock()
    run()
    return 1e3 * (clock() - start)


class Elsewhere:
    """The same tasks in a process that has this or another checkout of the library."""

    def __init__(self, checkout, count):
        here = Path(__file__).resolve().parent.parent
        paths = os.pathsep.join((str(Path(checkout).resolve() / "src"), str(here)))
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.fusion", "--answer", "--points", str(count)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=here,
            env={**os.environ, "PYTHONPATH": paths},
        )

    def spent(self, cloud, *, known_trajectory):
        self._process.stdin.write(f"{cloud} {int(known_trajectory)}\n")
        self._process.stdin.flush()
        return float(self._process.stdout.readline())

    def close(self):
        self._process.stdin.close()
        self._process.wait()


def answer(count):
    """Fuse what each line of the input names and print the milliseconds."""
    tasks = {name: Task(name, count) for name in CLOUDS}
    for line in sys.stdin:
        name, known_trajectory = line.split()
        print(
            spent(lambda task=tasks[name], trajectory=known_trajectory == "1": task.fuse(known_trajectory=trajectory)),
            flush=True,
        )


def spent_by_two(run):
    """Milliseconds of processor time of one run by two threads, if each had a processor of its own."""
    from sceneloom.kernels.thread_pool import ThreadPool

    spared, share = 0.0, ThreadPool.gather

    def one_by_one(_thread_pool, tasks):
        nonlocal spared
        results, times = [], []
        for task in tasks:
            start = time.process_time()
            results.append(task())
            times.append(1e3 * (time.process_time() - start))
        spared += sum(times) - max(times)
        return results

    ThreadPool.gather = one_by_one
    try:
        return spent(run) - spared
    finally:
        ThreadPool.gather = share


def show_before(count, repetitions, checkout):
    """Ours beside another checkout, each in a process of its own."""
    sides = [Elsewhere(location, count) for location in (Path(__file__).parent.parent, checkout)]
    for name in CLOUDS:
        for known_trajectory, words in ((False, "lidar's trajectory unknown"), (True, "lidar's trajectory known")):
            runs = [
                [
                    [side.spent(name, known_trajectory=known_trajectory) for _ in range(RUNS_A_ROTATION)]
                    for side in sides
                ]
                for _ in range(repetitions + 1)
            ]
            rotations = np.median(np.array(runs)[1:, :, 1:], axis=2)  # the first of a rotation meets cold caches
            reported = [
                f"{how} {ours:.1f} ms, before {theirs:.1f} ms, ratio {theirs / ours:.2f}"
                for how, (ours, theirs) in (("least", rotations.min(axis=0)), ("median", np.median(rotations, axis=0)))
            ]
            print(f"{name}, {words}: {'; '.join(reported)} (aim 1.5)")
    for side in sides:
        side.close()


def show_whole(count, repetitions):
    """Ours beside NumPy and OpenCV; two threads beside one."""
    for name in CLOUDS:
        task = Task(name, count)
        runs = {
            "ours": lambda task=task: task.fuse(known_trajectory=False),
            "ours, lidar's trajectory known": task.fuse,
            "windowed in NumPy": lambda task=task: task.numpy(project_with_numpy, windowed=True),
            "z-buffer in NumPy": lambda task=task: task.numpy(project_with_numpy, windowed=False),
            "cv2, z-buffer in NumPy": lambda task=task: task.numpy(project_with_cv2, windowed=False),
        }
        times = defaultdict(list)
        for repetition in range(repetitions + 1):
            for label, run in runs.items():
                times[label].append(spent(run))
            for threads in (1, 2):
                wall = spent(lambda task=task, n=threads: task.fuse(threads=n), time.perf_counter)
                times[f"by the clock, {threads}"].append(wall)
            times["two, each alone"].append(spent_by_two(lambda task=task: task.fuse(threads=2)))
            if repetition == 0:
                times.clear()  # loading and first use
        median = {label: float(np.median(values)) for label, values in times.items()}
        ours = median["ours, lidar's trajectory known"]
        shown = len(task.fuse().views[0].point_ids) / count
        print(f"{name}: {count} points, {100 * shown:.0f} % of them in a {WIDTH}x{HEIGHT} image, one thread")
        for label, value in median.items():
            if not label.startswith(("by the clock", "two")):
                print(f"  {label:26} {value:7.1f} ms, {value / ours:6.2f} times ours with the trajectory known")
        one, two = (min(times[f"by the clock, {threads}"]) for threads in (1, 2))
        two_alone = median["two, each alone"]
        print(f"  two threads by processor time {two_alone:.1f} ms, ratio {ours / two_alone:.2f} (aim 1.7)")
        print(f"  by the clock: one thread {one:.1f} ms, two {two:.1f} ms, ratio {one / two:.2f} (aim 1.7)")


class Stages:
    """Notes how long the stages of a fusion take, by replacing their functions with ones that look at the clock."""

    LOCATIONS = (
        (view_module, "_see", "project"),
        (visibility_module, "look_around", "scan lines"),
        (visibility_module, "mark_unhidden", "hiding"),
        (view_module, "draw_depths", "depth image"),
        (algorithms, "colour_points", "colours"),
        (algorithms, "_view", "a view"),
    )

    def __init__(self):
        self.times = defaultdict(list)
        for module, name, label in self.LOCATIONS:
            setattr(module, name, self._timed(getattr(module, name), label))

    def _timed(self, function, label):
        def timed(*args, **kwargs):
            start = time.thread_time()
            try:
                return function(*args, **kwargs)
            finally:
                self.times[label].append(1e3 * (time.thread_time() - start))

        return timed


def bandwidth():
    """Bytes read and written in a second by copying what no cache holds."""
    source = np.ones(2**24)
    target = np.zeros_like(source)
    return 2 * source.nbytes / min(1e-3 * spent(lambda: np.copyto(target, source)) for _ in range(7))


def show_stages(count, repetitions):
    """Time of each stage, bytes that it must move, share of the bandwidth."""
    task, stages, most = Task("street", count), Stages(), bandwidth()
    for _ in range(repetitions + 1):
        spent(task.fuse)
    view = task.fuse().views[0]
    kept, seen, drawn = len(view.point_ids), int(view.visible.sum()), int((view.depth_image > 0).sum())
    least = {
        "project": 24 * count + 36 * kept,
        "scan lines": 12 * kept,
        "hiding": 12 * kept + kept,
        "depth image": 9 * kept + 8 * drawn,
        "colours": 13 * kept + 7 * seen + 4 * count,
    }
    median = {label: float(np.median(values[1:])) for label, values in stages.times.items()}
    parts = ("project", "scan lines", "hiding", "depth image")
    median["empty image"] = median["a view"] - sum(median[part] for part in parts)
    least["empty image"] = 4 * WIDTH * HEIGHT
    print(f"stages, one thread, trajectory known; copying moves {most / 1e9:.1f} GB/s")
    print("  stage        ms    ns a point  bytes a point  share of the bandwidth")
    for label, size in least.items():
        share = size / (1e-3 * median[label] * most)
        print(
            f"  {label:12} {median[label]:5.2f} {1e6 * median[label] / count:8.2f} {size / count:12.0f} {share:16.2f}"
        )
    whole, size = median["a view"] + median["colours"], sum(least.values())
    share = size / (1e-3 * whole * most)
    print(f"  {'all':12} {whole:5.2f} {1e6 * whole / count:8.2f} {size / count:12.0f} {share:16.2f}")


def show_rig(count, repetitions):
    """Frame sets a second of six cameras around."""
    points = make_street(count, azimuth_deg=180)
    requests = [request(number, 60.0 * number) for number in range(6)]
    trajectory = LidarTrajectory(np.tile(LIDAR_WORLD, (2, 1)), np.zeros(len(points), np.float32))

    def fuse(threads):
        fuse_by_projection(points, requests, VisibilitySettings(threads=threads), trajectory=trajectory)

    def fastest(threads, clock):
        return min(spent(lambda: fuse(threads), clock) for _ in range(repetitions + 1))

    one, two = (fastest(threads, time.perf_counter) for threads in (1, 2))
    worked = fastest(1, time.process_time)
    print(f"six cameras, {len(points)} points around, frame sets a second (aim 10)")
    print(f"  by processor time {worked:6.1f} ms, {1e3 / worked:.1f} on each")
    print(f"  one thread        {one:6.1f} ms, {1e3 / one:.1f}")
    print(f"  two threads       {two:6.1f} ms, {1e3 / two:.1f}, ratio {one / two:.2f}")


def show_camera_models(count, repetitions):
    """Projection into the image by each model, beside the pinhole's."""
    from benchmarks.cameras import CAMERA_MODELS
    from sceneloom.cameras import PointsInImage  # as in `spent_by_two`

    points, matrix = make_street(count), position_camera().inverse().matrix
    room = PointsInImage.room(count)
    times, kept = defaultdict(list), {}
    for _ in range(repetitions + 1):
        for name, camera in CAMERA_MODELS.items():
            kernel, camera_model = projection_kernel(camera.model), intrinsics_vector(camera)
            start = time.process_time()
            kept[name] = kernel(points, matrix, camera_model, WIDTH, HEIGHT, room)
            times[name].append(1e3 * (time.process_time() - start))
    median = {name: float(np.median(values[1:])) for name, values in times.items()}
    print("projection into the image, one thread: ms, beside a pinhole, share in the image")
    for name, value in median.items():
        share = 100 * kept[name] / count
        print(f"  {name:24} {value:5.2f} ms {value / median['pinhole']:6.2f} {share:5.0f} %")


def main():
    """Run what is asked for and print figures and ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=250_000)
    parser.add_argument("--repetitions", type=int, default=15)
    parser.add_argument("--only", default="whole,rig,camera models,stages")
    parser.add_argument("--before", help="another checkout of the library to be measured in rotations")
    parser.add_argument("--answer", action="store_true", help=argparse.SUPPRESS)
    stated = parser.parse_args()
    if stated.before and not Path(stated.before, "src", "sceneloom").is_dir():
        parser.error(f"--before {stated.before}: expected a checkout, with src/sceneloom in it")
    if stated.answer:
        answer(stated.points)
        return
    chosen = stated.only.split(",")
    if "whole" in chosen:
        show_whole(stated.points, stated.repetitions)
    if stated.before:
        show_before(stated.points, stated.repetitions, stated.before)
    for name, show in (("rig", show_rig), ("camera_models", show_camera_models), ("stages", show_stages)):
        if name in chosen:
            show(stated.points, stated.repetitions)


if __name__ == "__main__":
    main()
