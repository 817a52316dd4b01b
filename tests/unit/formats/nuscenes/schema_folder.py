"""Data sets in the nuScenes schema, written by hand from the description of the tables."""

import json
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

FIRST_US = 1_532_402_927_647_951
"""The time of a key frame of nuScenes: it has all digits, down to the microsecond."""

RADAR_HEAD = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS {fields}
SIZE 4 4 4 1 2 4 4 4 4 4 1 1 1 1 1 1 1 1
TYPE F F F I I F F F F F I I I I I I I I
COUNT 1 1 1 1 1 1 1 1 1 1 1 1 1 1 1 1 1 1
WIDTH {count}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {count}
DATA binary
"""
RADAR_FIELDS = {
    "x y z": "<f4",
    "dyn_prop": "i1",
    "id": "<i2",
    "rcs vx vy vx_comp vy_comp": "<f4",
    "is_quality_valid ambig_state x_rms y_rms invalid_state pdh0 vx_rms vy_rms": "i1",
}
RADAR_ROW = np.dtype([(name, kind) for names, kind in RADAR_FIELDS.items() for name in names.split()])
TABLES = "scene sample sample_data ego_pose calibrated_sensor sensor log map category attribute visibility instance"
CAMERA_MOUNT = Rotation.from_quat([-0.5, 0.5, -0.5, 0.5])
"""Looks forward: ego from camera."""
K = [[30.0, 0.0, 31.5], [0.0, 30.0, 23.5], [0.0, 0.0, 1.0]]
SENSORS = {
    "LIDAR_TOP": ("lidar", [0.9, 0.1, 1.8], Rotation.from_euler("z", -90, degrees=True), []),
    "RADAR_FRONT": ("radar", [3.4, 0.0, 0.5], Rotation.from_euler("z", 1, degrees=True), []),
    "CAM_FRONT": ("camera", [1.7, 0.0, 1.5], CAMERA_MOUNT, K),
}
CAR_SIZE_WLH = [1.9, 4.6, 1.7]


class Tables:
    """Rows that are gathered and written; nothing checks them."""

    def __init__(self, root: Path) -> None:
        self.root, self.folder = root, root / "v1.0-mini"
        self.rows: dict[str, list[dict]] = {name: [] for name in [*TABLES.split(), "sample_annotation"]}

    def add(self, table: str, token: str, **fields) -> str:
        self.rows.setdefault(table, []).append({"token": token, **fields})
        return token

    def add_pose(self, token: str, timestamp_us: int, translation: list[float], rotation: Rotation) -> str:
        return self.add("ego_pose", token, timestamp=timestamp_us, translation=translation, rotation=wxyz(rotation))

    def add_sensor(self, channel, modality, translation, rotation, matrix) -> None:
        self.add("sensor", f"s-{channel}", channel=channel, modality=modality)
        location = {"translation": translation, "rotation": wxyz(rotation), "camera_intrinsic": matrix}
        self.add("calibrated_sensor", f"c-{channel}", sensor_token=f"s-{channel}", **location)

    def add_data(self, token, channel, modality, timestamp_us, filename, *, size=(0, 0), key=True, **fields) -> None:
        """Add the row of a file; `fields` are its sample, its pose and the links."""
        form, (width, height) = ("jpg", size) if modality == "camera" else ("pcd", (0, 0))
        fields |= {"calibrated_sensor_token": f"c-{channel}", "timestamp": timestamp_us, "fileformat": form}
        fields |= {"is_key_frame": key, "width": width, "height": height, "filename": filename}
        self.add("sample_data", token, **fields)

    def add_box(self, token, translation, size_wlh, rotation, points, **fields) -> None:
        """Add a box in the world with its numbers of points of lidars and radars."""
        fields |= {"translation": translation, "size": size_wlh, "rotation": wxyz(rotation)}
        self.add("sample_annotation", token, num_lidar_pts=points[0], num_radar_pts=points[1], **fields)

    def row(self, table: str, token: str) -> dict:
        return next(row for row in self.rows[table] if row["token"] == token)

    def write(self) -> Path:
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, rows in self.rows.items():
            (self.folder / f"{name}.json").write_text(json.dumps(rows, indent=0), "utf-8")
        return self.root

    def file(self, name: str, content: bytes) -> str:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        return name


def wxyz(rotation: Rotation) -> list[float]:
    return np.roll(rotation.as_quat(), 1).tolist()


def links(tokens: list[str], k: int) -> dict[str, str]:
    return {"prev": tokens[k - 1] if k else "", "next": tokens[k + 1] if k + 1 < len(tokens) else ""}


def lidar_rows(count: int, seed: int = 1) -> np.ndarray:
    """(count, 5) float32: x, y, z, intensity, ring."""
    rng = np.random.default_rng(seed)
    rows = rng.uniform(-20, 20, (count, 5)).astype(np.float32)
    rows[:, 3], rows[:, 4] = rng.integers(0, 256, count), rng.integers(0, 32, count)
    return rows


def radar_rows(count: int, seed: int = 2) -> np.ndarray:
    """(count,) structured."""
    rng = np.random.default_rng(seed)
    rows = np.zeros(count, RADAR_ROW)
    for name in ("x", "y", "rcs", "vx", "vy", "vx_comp", "vy_comp"):
        rows[name] = rng.uniform(-10, 10, count)
    rows["id"], rows["ambig_state"], rows["is_quality_valid"] = np.arange(count), 3, 1
    return rows


def content_of(modality: str, k: int) -> bytes:
    if modality == "lidar":
        return lidar_rows(40 + k, k).tobytes()
    if modality == "radar":
        rows = radar_rows(5 + k, k)
        return RADAR_HEAD.format(fields=" ".join(rows.dtype.names), count=len(rows)).encode() + rows.tobytes() + b"\n"
    file = BytesIO()
    Image.new("RGB", (64, 48), (40 * k, 100, 200)).save(file, "JPEG")
    return file.getvalue()


def ego_pose(timestamp_us: int) -> tuple[list[float], Rotation]:
    """Where the ego is: it drives a curve."""
    s = (timestamp_us - FIRST_US) / 1e6
    return [400.0 + 8 * s, 1180.0 + s, 0.0], Rotation.from_euler("z", 30 + 5 * s, degrees=True)


def car_pose(k: int) -> tuple[list[float], Rotation]:
    """Where the car is at sample `k`: it leans a little, so that the order of its angles shows."""
    return [410.5 + k, 1183.25, 0.9], Rotation.from_euler("ZYX", [100 + 2 * k, 3, -2], degrees=True)


def street(root: Path, *, scenes: tuple[str, ...] = ("scene-0001",), samples: int = 3) -> Tables:
    """A data set with a lidar, a radar and a camera: samples every half second, one further frame between two."""
    tables = Tables(root)
    for channel, sensor in SENSORS.items():
        tables.add_sensor(channel, *sensor)
    tables.add("log", "log-1", logfile="n015", vehicle="n015", date_captured="2018-07-24", location="here")
    tables.add("category", "cat-car", name="vehicle.car", description="a car", index=17)
    tables.add("category", "cat-noise", name="noise", description="noise", index=0)
    tables.add("attribute", "att-moving", name="vehicle.moving", description="moves")
    tables.add("attribute", "att-parked", name="vehicle.parked", description="stands")
    tables.add("visibility", "4", level="v80-100", description="nearly all")
    for number, name in enumerate(scenes):
        _scene(tables, name, FIRST_US + number * 60_000_000, samples)
    return tables


def _scene(tables: Tables, name: str, first_us: int, samples: int) -> None:
    tokens = [f"{name}-sample-{k}" for k in range(samples)]
    for k, token in enumerate(tokens):
        timestamp = first_us + k * 500_000
        tables.add("sample", token, timestamp=timestamp, scene_token=f"t-{name}", **links(tokens, k))
    ends = {"first_sample_token": tokens[0], "last_sample_token": tokens[-1]}
    fields = {"name": name, "description": f"The street of {name}", "log_token": "log-1", "nbr_samples": samples}
    tables.add("scene", f"t-{name}", **fields, **ends)
    for channel, (modality, *_) in SENSORS.items():
        _frames(tables, name, channel, modality, first_us, tokens)
    boxes = [f"{name}-ann-{k}" for k in range(samples)]
    ends = {"first_annotation_token": boxes[0], "last_annotation_token": boxes[-1]}
    tables.add("instance", f"{name}-car", category_token="cat-car", nbr_annotations=samples, **ends)
    for k, token in enumerate(boxes):
        translation, rotation = car_pose(k)
        fields = {"sample_token": tokens[k], "instance_token": f"{name}-car", "visibility_token": "4" if k else ""}
        fields |= {"attribute_tokens": ["att-moving"] if k else ["att-parked"], **links(boxes, k)}
        tables.add_box(token, translation, CAR_SIZE_WLH, rotation, (k + 3, k), **fields)


def _frames(tables: Tables, name: str, channel: str, modality: str, first_us: int, samples: list[str]) -> None:
    tokens = [f"{name}-{channel}-{k}" for k in range(2 * len(samples) - 1)]
    lag, suffix = {"lidar": (0, ".pcd.bin"), "radar": (-20_003, ".pcd"), "camera": (12_341, ".jpg")}[modality]
    for k, token in enumerate(tokens):
        timestamp, folder = first_us + k * 250_000 + lag, "samples" if k % 2 == 0 else "sweeps"
        tables.add_pose(token, timestamp, *ego_pose(timestamp))
        filename = tables.file(f"{folder}/{channel}/{token}{suffix}", content_of(modality, k))
        fields = {"sample_token": samples[(k + 1) // 2], "ego_pose_token": token, **links(tokens, k)}
        tables.add_data(token, channel, modality, timestamp, filename, size=(64, 48), key=k % 2 == 0, **fields)


def with_classes(tables: Tables, frames: dict[int, slice]) -> Tables:
    """Give sweeps of the street classes of points: cars in these rows, noise else."""
    for k, rows in frames.items():
        token, labels = f"scene-0001-LIDAR_TOP-{k}", np.zeros(40 + k, np.uint8)
        labels[rows] = 17
        name = tables.file(f"lidarseg/v1.0-mini/{token}_lidarseg.bin", labels.tobytes())
        tables.add("lidarseg", token, sample_data_token=token, filename=name)
    return tables


def from_infos(infos: Path, root: Path) -> Tables:
    """The one real key frame as a data set: its file of information (as MMDetection3D writes it) put into tables.

    Poses of the ego at the images follow from `lidar2cam`, which leads over the world.
    """
    reported = json.loads((infos / "infos.json").read_text("utf-8"))
    frame, classes = reported["data_list"][0], reported["metainfo"]["categories"]
    tables, token = Tables(root), frame["token"]

    def add_file(name, channel, modality, seconds, world_from_ego, ego_from_sensor, matrix):
        path, timestamp = infos / name, round(seconds * 1e6)
        location = ego_from_sensor[:3, 3].tolist(), Rotation.from_matrix(ego_from_sensor[:3, :3])
        tables.add_sensor(channel, modality, *location, matrix)
        rotation = Rotation.from_matrix(world_from_ego[:3, :3])
        tables.add_pose(f"p-{channel}", timestamp, world_from_ego[:3, 3].tolist(), rotation)
        target = tables.root / "samples" / channel / path.name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(path)
        fields = {"sample_token": token, "ego_pose_token": f"p-{channel}", **links(["only"], 0)}
        filename = f"samples/{channel}/{path.name}"
        tables.add_data(f"d-{channel}", channel, modality, timestamp, filename, size=(1600, 900), **fields)

    world_from_ego, ego_from_lidar = np.array(frame["ego2global"]), np.array(frame["lidar_points"]["lidar2ego"])
    world_from_lidar = world_from_ego @ ego_from_lidar
    tables.add("log", "log", logfile="n015-2018-07-24-11-22-45+0800")
    ends = {"first_sample_token": token, "last_sample_token": token}
    tables.add("scene", "scene", name="scene-0061", log_token="log", nbr_samples=1, **ends)
    timestamp_us = round(frame["timestamp"] * 1e6)
    tables.add("sample", token, timestamp=timestamp_us, scene_token="scene", **links(["only"], 0))
    lidar = frame["lidar_points"]["lidar_path"]
    add_file(lidar, "LIDAR_TOP", "lidar", frame["timestamp"], world_from_ego, ego_from_lidar, [])
    for channel, image in frame["images"].items():
        ego_from_camera = np.array(image["cam2ego"])
        pose = world_from_lidar @ np.linalg.inv(np.array(image["lidar2cam"])) @ np.linalg.inv(ego_from_camera)
        matrix = image["cam2img"]
        add_file(image["img_path"], channel, "camera", image["timestamp"], pose, ego_from_camera, matrix)
    for name in (*classes, "other"):
        tables.add("category", name, name=name)
    names = {number: name for name, number in classes.items()}
    for k, box in enumerate(frame["instances"]):
        x, y, z, length, width, height, yaw = box["bbox_3d"]
        heading = Rotation.from_matrix(world_from_lidar[:3, :3]) * Rotation.from_euler("z", yaw)
        tables.add("instance", f"i{k}", category_token=names.get(box["bbox_label_3d"], "other"), nbr_annotations=1)
        center, points = (world_from_lidar @ [x, y, z, 1])[:3].tolist(), (box["num_lidar_pts"], box["num_radar_pts"])
        fields = {"sample_token": token, "instance_token": f"i{k}"}
        tables.add_box(f"a{k}", center, [width, length, height], heading, points, **fields)
    return tables
