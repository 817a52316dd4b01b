"""Data sets in the nuScenes schema, written by hand from the description of the tables."""

import json
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
RADAR_ROW = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z")),
        ("dyn_prop", "i1"),
        ("id", "<i2"),
        *((name, "<f4") for name in ("rcs", "vx", "vy", "vx_comp", "vy_comp")),
        *(
            (name, "i1")
            for name in (
                *("is_quality_valid", "ambig_state", "x_rms", "y_rms"),
                *("invalid_state", "pdh0", "vx_rms", "vy_rms"),
            )
        ),
    ]
)


class Tables:
    """Rows that are gathered and written; nothing checks them."""

    def __init__(self, root: Path, version: str = "v1.0-mini") -> None:
        self.root, self.folder = root, root / version
        self.rows: dict[str, list[dict]] = {
            name: []
            for name in (
                *("scene", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor", "log", "map"),
                *("category", "attribute", "visibility", "instance", "sample_annotation"),
            )
        }

    def add(self, table: str, token: str, **fields) -> str:
        self.rows.setdefault(table, []).append({"token": token, **fields})
        return token

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
    """A rotation as the tables have it."""
    x, y, z, w = rotation.as_quat().tolist()
    return [w, x, y, z]


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


CAMERA_MOUNT = Rotation.from_quat([-0.5, 0.5, -0.5, 0.5])
"""Looks forward: ego from camera."""

K = [[30.0, 0.0, 31.5], [0.0, 30.0, 23.5], [0.0, 0.0, 1.0]]
SENSORS = {
    "LIDAR_TOP": ("lidar", [0.9, 0.1, 1.8], Rotation.from_euler("z", -90, degrees=True), []),
    "RADAR_FRONT": ("radar", [3.4, 0.0, 0.5], Rotation.from_euler("z", 1, degrees=True), []),
    "CAM_FRONT": ("camera", [1.7, 0.0, 1.5], CAMERA_MOUNT, K),
}


def ego_pose(timestamp_us: int) -> tuple[list[float], Rotation]:
    """Where the ego is: it drives a curve."""
    s = (timestamp_us - FIRST_US) / 1e6
    return [400.0 + 8 * s, 1180.0 + s, 0.0], Rotation.from_euler("z", 30 + 5 * s, degrees=True)


def street(root: Path, *, scenes: tuple[str, ...] = ("scene-0001",), samples: int = 3) -> Tables:
    """A data set with a lidar, a radar and a camera: samples every half second, one further frame between two."""
    tables = Tables(root)
    for channel, (modality, translation, rotation, matrix) in SENSORS.items():
        tables.add("sensor", f"s-{channel}", channel=channel, modality=modality)
        tables.add(
            "calibrated_sensor",
            f"c-{channel}",
            sensor_token=f"s-{channel}",
            translation=translation,
            rotation=wxyz(rotation),
            camera_intrinsic=matrix,
        )
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
        tables.add(
            "sample",
            token,
            timestamp=first_us + k * 500_000,
            scene_token=f"t-{name}",
            prev=tokens[k - 1] if k else "",
            next=tokens[k + 1] if k + 1 < samples else "",
        )
    tables.add(
        "scene",
        f"t-{name}",
        name=name,
        description=f"The street of {name}",
        log_token="log-1",
        nbr_samples=samples,
        first_sample_token=tokens[0],
        last_sample_token=tokens[-1],
    )
    for channel, (modality, *_) in SENSORS.items():
        _frames(tables, name, channel, modality, first_us, tokens)
    _car(tables, name, tokens)


def _frames(tables: Tables, name: str, channel: str, modality: str, first_us: int, samples: list[str]) -> None:
    count = 2 * len(samples) - 1
    tokens = [f"{name}-{channel}-{k}" for k in range(count)]
    lag = {"lidar": 0, "radar": -20_003, "camera": 12_341}[modality]
    suffix = {"lidar": ".pcd.bin", "radar": ".pcd", "camera": ".jpg"}[modality]
    for k, token in enumerate(tokens):
        timestamp = first_us + k * 250_000 + lag
        translation, rotation = ego_pose(timestamp)
        tables.add("ego_pose", token, timestamp=timestamp, translation=translation, rotation=wxyz(rotation))
        folder = "samples" if k % 2 == 0 else "sweeps"
        tables.add(
            "sample_data",
            token,
            sample_token=samples[(k + 1) // 2],
            ego_pose_token=token,
            calibrated_sensor_token=f"c-{channel}",
            timestamp=timestamp,
            fileformat={"camera": "jpg"}.get(modality, "pcd"),
            is_key_frame=k % 2 == 0,
            height=48 if modality == "camera" else 0,
            width=64 if modality == "camera" else 0,
            filename=tables.file(f"{folder}/{channel}/{token}{suffix}", content_of(modality, k)),
            prev=tokens[k - 1] if k else "",
            next=tokens[k + 1] if k + 1 < count else "",
        )


def content_of(modality: str, k: int) -> bytes:
    """The file of frame `k` of a sensor."""
    if modality == "lidar":
        return lidar_rows(40 + k, k).tobytes()
    if modality == "radar":
        rows = radar_rows(5 + k, k)
        return RADAR_HEAD.format(fields=" ".join(rows.dtype.names), count=len(rows)).encode() + rows.tobytes() + b"\n"
    from io import BytesIO

    file = BytesIO()
    Image.new("RGB", (64, 48), (40 * k, 100, 200)).save(file, "JPEG")
    return file.getvalue()


CAR_SIZE_WLH = [1.9, 4.6, 1.7]


def car_pose(k: int) -> tuple[list[float], Rotation]:
    """Where the car is at sample `k`: it leans a little, so that the order of its angles shows."""
    return [410.5 + k, 1183.25, 0.9], Rotation.from_euler("ZYX", [100 + 2 * k, 3, -2], degrees=True)


def _car(tables: Tables, name: str, samples: list[str]) -> None:
    tokens = [f"{name}-ann-{k}" for k in range(len(samples))]
    tables.add(
        "instance",
        f"{name}-car",
        category_token="cat-car",
        nbr_annotations=len(tokens),
        first_annotation_token=tokens[0],
        last_annotation_token=tokens[-1],
    )
    for k, token in enumerate(tokens):
        translation, rotation = car_pose(k)
        tables.add(
            "sample_annotation",
            token,
            sample_token=samples[k],
            instance_token=f"{name}-car",
            visibility_token="4" if k else "",
            attribute_tokens=["att-moving"] if k else ["att-parked"],
            translation=translation,
            size=CAR_SIZE_WLH,
            rotation=wxyz(rotation),
            num_lidar_pts=k + 3,
            num_radar_pts=k,
            prev=tokens[k - 1] if k else "",
            next=tokens[k + 1] if k + 1 < len(tokens) else "",
        )


def from_infos(infos: Path, root: Path) -> Tables:
    """The one real key frame as a data set: its file of information (as MMDetection3D writes it) put into tables.

    Poses of the ego at the images follow from `lidar2cam`, which leads over the world.
    """
    reported = json.loads((infos / "infos.json").read_text("utf-8"))
    frame, classes = reported["data_list"][0], reported["metainfo"]["categories"]
    tables = Tables(root)
    timestamp_us = round(frame["timestamp"] * 1e6)
    world_from_ego = np.array(frame["ego2global"])
    ego_from_lidar = np.array(frame["lidar_points"]["lidar2ego"])
    tables.add("log", "log", logfile="n015-2018-07-24-11-22-45+0800")
    tables.add(
        "scene",
        "scene",
        name="scene-0061",
        log_token="log",
        nbr_samples=1,
        first_sample_token=frame["token"],
        last_sample_token=frame["token"],
    )
    tables.add("sample", frame["token"], timestamp=timestamp_us, scene_token="scene", prev="", next="")
    lidar = frame["lidar_points"]["lidar_path"]
    _real_file(tables, infos / lidar, "LIDAR_TOP", "lidar", timestamp_us, world_from_ego, ego_from_lidar, [], frame)
    for channel, image in frame["images"].items():
        ego_from_camera = np.array(image["cam2ego"])
        camera_from_lidar = np.array(image["lidar2cam"])
        world_from_camera = world_from_ego @ ego_from_lidar @ np.linalg.inv(camera_from_lidar)
        pose = world_from_camera @ np.linalg.inv(ego_from_camera)
        timestamp = round(image["timestamp"] * 1e6)
        path = infos / image["img_path"]
        _real_file(tables, path, channel, "camera", timestamp, pose, ego_from_camera, image["cam2img"], frame)
    for name in (*classes, "other"):
        tables.add("category", name, name=name)
    names = {number: name for name, number in classes.items()}
    world_from_lidar = world_from_ego @ ego_from_lidar
    for k, box in enumerate(frame["instances"]):
        x, y, z, length, width, height, yaw = box["bbox_3d"]
        heading = Rotation.from_matrix(world_from_lidar[:3, :3]) * Rotation.from_euler("z", yaw)
        tables.add("instance", f"i{k}", category_token=names.get(box["bbox_label_3d"], "other"), nbr_annotations=1)
        tables.add(
            "sample_annotation",
            f"a{k}",
            sample_token=frame["token"],
            instance_token=f"i{k}",
            translation=(world_from_lidar @ [x, y, z, 1])[:3].tolist(),
            size=[width, length, height],
            rotation=wxyz(heading),
            num_lidar_pts=box["num_lidar_pts"],
            num_radar_pts=box["num_radar_pts"],
        )
    return tables


def _real_file(tables, path, channel, modality, timestamp_us, world_from_ego, ego_from_sensor, matrix, frame) -> None:
    tables.add("sensor", f"s-{channel}", channel=channel, modality=modality)
    tables.add(
        "calibrated_sensor",
        f"c-{channel}",
        sensor_token=f"s-{channel}",
        translation=ego_from_sensor[:3, 3].tolist(),
        rotation=wxyz(Rotation.from_matrix(ego_from_sensor[:3, :3])),
        camera_intrinsic=matrix,
    )
    tables.add(
        "ego_pose",
        f"p-{channel}",
        timestamp=timestamp_us,
        translation=world_from_ego[:3, 3].tolist(),
        rotation=wxyz(Rotation.from_matrix(world_from_ego[:3, :3])),
    )
    target = tables.root / "samples" / channel / path.name
    target.parent.mkdir(parents=True, exist_ok=True)
    target.symlink_to(path)
    size = (1600, 900) if modality == "camera" else (0, 0)
    tables.add(
        "sample_data",
        f"d-{channel}",
        sample_token=frame["token"],
        ego_pose_token=f"p-{channel}",
        calibrated_sensor_token=f"c-{channel}",
        timestamp=timestamp_us,
        fileformat="jpg" if modality == "camera" else "pcd",
        is_key_frame=True,
        width=size[0],
        height=size[1],
        filename=f"samples/{channel}/{path.name}",
        prev="",
        next="",
    )
