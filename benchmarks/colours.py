"""How well a cloud that all images but one have coloured agrees with the one that was left out.

Run with `python -m benchmarks.colours DRIVE... [--simulated 700,701] [--every 1] [--map]`. Each image in turn is left
out. The points of its sweep that it shows get colours from all other images, of other moments and cameras, moving
objects included; PSNR [dB] over these points and red, green and blue, against the left-out image between its pixels.
Rows: mean over the images, with 1.96 standard errors (images of one drive have much in common: the true interval is
wider). The exposures are found without the left-out image; its own is interpolated between its neighbours, or with
`own`, found from its points.

- `ours`: `blend_colours`; `without gains`: the same with the images as they are.
- `time`, `central`, `mean`, `median`: bilinear colour of the image nearest in time, nearest pixel of the most central
  image, plain mean and median of all, with the same gains.
- `hindsight`: of ours, times the three factors that fit best; `best sample`: of each point the colour, of those over
  the beam's footprint, that is nearest to the truth, which no weights exceed except by averaging; `itself`: the
  left-out image over the footprint.

`--map` compares the map of `sceneloom colour --voxel 0.1`, from all sweeps, where moving objects leave copies.
"""

import argparse
import tempfile
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.colouring import ExposureLinks, LidarTrajectory, blend_colours, colour_points
from sceneloom.colouring.algorithms import view_points
from sceneloom.colouring.blending import sample_view
from sceneloom.formats.points.files import read_cloud
from sceneloom.kernels.projection import sample_footprints
from sceneloom.pipeline import ColourSettings, iter_fused
from sceneloom.pipeline.alignment import align
from sceneloom.scene import LazyFrames, LidarFrame
from sceneloom.scene.ego import lidar_position
from sceneloom.scene.scene import scene_period_ns
from sceneloom.simulate import CameraSpec, ExposureSpec, TrafficSpec, camera_mount, simulate_street


def simulated(seed):
    """Two cameras with exposures and vignetting of their own, one of which leaves a shadow; traffic."""
    camera = Camera("pinhole", 960, 600, 560.0, 560.0, 479.5, 299.5)
    exposures = (
        ExposureSpec(drift_period=3.0, steps=((0.35, 1.0),), vignetting=0.3),
        ExposureSpec(drift_period=2.5, vignetting=0.3),
    )
    cameras = [
        CameraSpec(camera, camera_mount(yaw_deg=yaw), supersampling=2, exposure=exposure)
        for yaw, exposure in zip((0.0, 55.0), exposures, strict=True)
    ]
    return simulate_street(seed, frames=8, cameras=cameras, traffic=TrafficSpec()).scene


def between_pixels(view, pixels):
    colors = np.empty((len(pixels), 3), np.float32)
    sample_footprints(pixels, np.ascontiguousarray(view.rgb), 1.0, colors)
    return colors


def psnr(found, truth):
    return 10 * np.log10(255**2 / np.mean((np.asarray(found, np.float64) - truth) ** 2))


class Drive:
    """The sweeps of a drive and its images, and the gains of all of them."""

    def __init__(self, scene):
        self.scene = scene.corrected()
        aligned = align(self.scene)
        reach_ns = scene_period_ns(aligned.scene)
        locations = {
            lidar.id: lidar_position(aligned.scene, lidar, aligned.ego, reach_ns=reach_ns)
            for lidar in aligned.scene.lidars
        }
        self.index = {camera.id: k for k, camera in enumerate(self.scene.cameras)}
        self.sweeps, self.images, self.links = [], {}, ExposureLinks()
        for frame in iter_fused(self.scene):
            if frame.views:
                location = locations[frame.lidar_id]
                measured = LidarFrame(frame.timestamp_ns, frame.points)
                trajectory = None if location is None else LidarTrajectory.of(measured, location)
                points = frame.views[0].points_world
                nodes = [self.node(view) for view in frame.views]
                self.links.add(points, frame.views, [camera for camera, _ in nodes])
                self.images.update(zip(nodes, frame.views, strict=True))
                self.sweeps.append((points, frame.points.timestamps_ns, trajectory, nodes))

    def node(self, view):
        return self.index[view.camera_id], view.timestamp_ns

    def gains(self, without):
        """Factors by image, found without one of them, and its own from its points."""
        kept = replace(self.links, links=[link for link in self.links.links if without not in link.nodes])
        found, own = kept.solve(), self.links.solve()
        factors = {node: np.ones(3) if (gain := found.at(*node)) is None else gain for node in self.images}
        return factors, np.ones(3) if (gain := own.at(*without)) is None else gain


def rows_of(drive, every):
    """Figures of each image that is left out, by row."""
    rows, number = defaultdict(list), 0
    for points, times, trajectory, nodes in drive.sweeps:
        chosen = [node for k, node in enumerate(nodes, number) if k % every == 0]
        number += len(nodes)
        views = {
            node: view_points(
                points, image.camera, image.world_from_camera, image.rgb, camera_id=image.camera_id,
                timestamp_ns=image.timestamp_ns, trajectory=trajectory,
            )
            for node, image in drive.images.items()
            if chosen
        }  # fmt: skip
        for node in chosen:
            for row, figure in left_out(drive, views, node, times):
                rows[row].append(figure)
    return rows


def left_out(drive, views, node, times):
    held, others = views[node], [other for other in views if other != node]
    points, count, shown = held.points_world, len(held.points_world), [views[other] for other in others]
    gains, own = drive.gains(node)
    # each image is a camera of its own, so that it has its own gain
    numbers = range(len(others))
    factors = {k: gains[other] / gains[node] for k, other in enumerate(others)}
    blended = blend_colours(points, shown, numbers, timestamps_ns=times, gains=factors)
    rows = np.flatnonzero(held.visible & (blended.sources.camera_index[held.point_ids] != 255))
    if len(rows) < 100:
        return
    ids, pixels = held.point_ids[rows], np.ascontiguousarray(held.pixels[rows])
    truth = between_pixels(held, pixels)
    ours = blended.colors[ids].astype(np.float64)
    samples = np.full((len(others), 2, count, 3), np.nan, np.float32)
    for k, view in enumerate(shown):
        seen, at = view.point_ids[view.visible], np.ascontiguousarray(view.pixels[view.visible])
        samples[k, 0, seen] = between_pixels(view, at) * factors[k]
        samples[k, 1, seen] = sample_view(view, at) * factors[k]
    plain, footprints = samples[:, 0, ids], samples[:, 1, ids]
    apart = np.abs(np.array([view.timestamp_ns for view in shown], np.float64) - held.timestamp_ns)
    missing = np.isnan(plain[..., 0])
    nearest = np.where(missing, np.inf, apart[:, None]).argmin(axis=0)
    best = np.where(missing, np.inf, np.abs(footprints - truth).sum(axis=2)).argmin(axis=0)
    each = np.arange(len(ids))
    central, cameras = colour_points(count, shown, numbers)
    central = central[ids] * np.array([factors[k] for k in numbers])[cameras[ids]]
    raw = blend_colours(points, shown, numbers, timestamps_ns=times).colors[ids]
    yield "ours", psnr(ours, truth)
    yield "ours, own", psnr(ours * gains[node] / own, truth)
    yield "without gains", psnr(raw, truth)
    yield "time", psnr(plain[nearest, each], truth)
    yield "central", psnr(central, truth)
    yield "mean", psnr(np.nanmean(plain, axis=0), truth)
    yield "median", psnr(np.nanmedian(plain, axis=0), truth)
    yield "hindsight", psnr(ours * ((ours * truth).sum(axis=0) / (ours * ours).sum(axis=0)), truth)
    yield "best sample", psnr(footprints[best, each], truth)
    yield "itself", psnr(sample_view(held, pixels), truth)
    yield "points coloured [%]", 100 * len(rows) / held.visible.sum()


def rows_of_map(drive, every):
    """Figures of maps that were made without each image."""
    rows = defaultdict(list)
    for number, (node, image) in enumerate(drive.images.items()):
        if number % every == 0:
            camera = drive.scene.cameras[node[0]]
            kept = [k for k, time_ns in enumerate(camera.images.timestamps_ns.tolist()) if time_ns != node[1]]
            images = LazyFrames.of([camera.images[k] for k in kept], camera.images.timestamps_ns[kept].tolist())
            sensors = [replace(each, images=images) if each is camera else each for each in drive.scene.sensors]
            with tempfile.TemporaryDirectory() as folder:
                target = Path(folder, "map.ply")
                settings = ColourSettings(voxel=0.1, only_coloured=True)
                sceneloom.colour(replace(drive.scene, sensors=tuple(sensors)), target, settings=settings)
                columns = read_cloud(target).columns
            points, colors = (
                np.stack([columns[name] for name in names], axis=1) for names in ("xyz", ("red", "green", "blue"))
            )
            points = points.astype(np.float64) - align(drive.scene).origin_world
            view = view_points(
                points, image.camera, image.world_from_camera, image.rgb, camera_id="left out", timestamp_ns=node[1]
            )
            at = np.ascontiguousarray(view.pixels[view.visible])
            rows["map, 0.1 m"].append(psnr(colors[view.point_ids[view.visible]], between_pixels(view, at)))
    return rows


def main():
    """Print a table for each drive."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drives", nargs="*", type=Path)
    parser.add_argument("--simulated", default="", help="seeds of simulated streets")
    parser.add_argument("--every", type=int, default=1, help="leave out one image of so many")
    parser.add_argument("--map", action="store_true")
    stated = parser.parse_args()
    scenes = [(path.name, lambda path=path: sceneloom.open(path)) for path in stated.drives]
    seeds = [int(seed) for seed in stated.simulated.split(",") if seed]
    for name, scene in scenes + [(f"street {seed}", lambda seed=seed: simulated(seed)) for seed in seeds]:
        drive = Drive(scene())
        for row, figures in (rows_of_map if stated.map else rows_of)(drive, stated.every).items():
            spread = 1.96 * np.std(figures, ddof=1) / len(figures) ** 0.5 if len(figures) > 1 else np.nan
            print(f"{name:16} {row:20} {np.mean(figures):6.2f} ± {spread:.2f} (n {len(figures)})", flush=True)


if __name__ == "__main__":
    main()
