"""Feed a training loop with shuffled, synchronised samples from worker processes, as PyTorch's DataLoader does.

A sample is a sweep with its images, camera models and poses. With PyTorch, the pool here would be
`DataLoader(dataset, batch_size=4, shuffle=True, num_workers=2, collate_fn=…)`. The model learns how far away a pixel
of the road is from its row alone, and so how high above the road the camera is.

    python examples/04_train_from_samples.py [FOLDER]
"""

import sys
from multiprocessing import get_context
from pathlib import Path

import numpy as np

import sceneloom
from sceneloom.cameras.projection import project

worker = {}


def training_item(sample):
    """What the model sees of a sample: an image, and the points of the road in it."""
    points = sample.sweep.points.positions
    road = sample.poses.world_from_points.apply(points)[:, 2] < 0.1
    points_camera = sample.camera_from_points["camera0"].apply(points[road])
    pixels, visible = project(sample.cameras["camera0"], points_camera)
    return sample.images["camera0"].rgb, pixels[visible, 1], points_camera[visible, 2]


def start(dataset):
    """Give a worker the dataset: once, and not with every batch."""
    worker["dataset"] = dataset


def batch(numbers):
    """Make one batch in a worker: images are stacked; points, of which there may be many or few, are chained."""
    images, rows, depths = zip(*(worker["dataset"][number] for number in numbers), strict=True)
    return np.stack(images), np.concatenate(rows), np.concatenate(depths)


def main(folder: Path) -> None:
    """Write a drive, and learn from it."""
    folder.mkdir(parents=True, exist_ok=True)
    sceneloom.write(sceneloom.simulate_street(seed=4, frames=12).scene, folder / "drive.sfs", overwrite=True)
    with sceneloom.open(folder / "drive.sfs") as scene:
        dataset, camera_model = scene.samples().map(training_item), scene.cameras[0].camera
        shuffled = np.random.default_rng(0).permutation(len(dataset)).reshape(-1, 4).tolist()
        with get_context("spawn").Pool(2, start, [dataset]) as pool:
            for rgb, rows, depths in pool.imap(batch, shuffled):
                slope, _ = np.polyfit(rows, 1 / depths, 1)
                height = 1 / slope / camera_model.fy
                print(f"{rgb.shape}, {len(rows)} points: the camera is {height:.2f} m above the road")
            print(f"it was mounted {scene.cameras[0].mount.translation[2]} m above the road")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "samples"))
