"""A manifest to begin with: the commented template, or one that says already what is found in a folder."""

from pathlib import Path

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.output import replacing
from sceneloom.formats.rig.survey import FoundSensor, FoundTrajectory, Times, survey

TEMPLATE = """\
# rig.toml describes a folder of clouds and images, so that sceneloom opens it as one drive:
#     sceneloom info FOLDER
#     sceneloom fuse FOLDER -o drive.sfs
# Lengths are metres, times seconds unless a unit is named, `nan` is what has to be filled in. Sensors that you do not
# have are taken out. Everything that can stand here: docs/formats/rig.md.

name = "my drive"
ego = "base"                       # the frame that moves through the world: x forward, y left, z up
# root = "../raw"                  # where the files are, if not beside this file

[[sensors]]
id = "lidar_top"
type = "lidar"
files = "lidar_top/*.pcd"          # .pcd .ply .bin .npz .npy
times = { pattern = "{ns}" }       # the name is the time: 1532402927647951000.pcd; also {us} {ms} {s} {s}_{ns}
timestamp = "start"                    # of the sweep; or "middle", "end" together with sweep_s
# sweep_s = 0.1
# intensity_max = 255              # the brightness that becomes 255
# point_times = { field = "t", unit = "nanoseconds", relative_to = "timestamp" }
# fields = ["x", "y", "z", "intensity", "ring:uint16"]   # of .bin files; float32 where no type is named

# p_base = R · p_lidar_top + translation: `translation` is where the lidar is, seen from base.
[sensors.extrinsic]
to = "base"
translation = [nan, nan, nan]
quaternion_xyzw = [nan, nan, nan, nan]   # or quaternion_wxyz, rotation_matrix, euler_deg with euler_order, or matrix

[[sensors]]
id = "cam_front"
type = "camera"
files = "cam_front/*.jpg"          # .jpg .png; or video = "front.mp4"
times = { pattern = "{ns}" }
# times = { csv = "cam_front.csv", column = "timestamp", unit = "nanoseconds", file_column = "file" }
# times = { lines = "cam_front/timestamps.txt" }
# times = { rate_hz = 10, start_s = 0.0 }
axes = "optical"                   # of frame cam_front: x right, y down, z forward; "flu": x forward, y left, z up

[sensors.camera_model]
model = "brown_conrady"            # pinhole, brown_conrady (OpenCV's), fisheye (OpenCV's)
fx = nan
fy = nan
cx = nan
cy = nan
coefficients = [nan, nan, nan, nan, nan]   # k1 k2 p1 p2 k3; [] where the images are rectified
# width = 1920                     # where the numbers hold for another image size
# height = 1080

[sensors.extrinsic]
to = "lidar_top"                   # any frame that is known
matrix = [
    [nan, nan, nan, nan],
    [nan, nan, nan, nan],
    [nan, nan, nan, nan],
    [0.0, 0.0, 0.0, 1.0],
]

# [[trajectories]]
# file = "poses.txt"
# form = "tum"                     # lines of: time x y z qx qy qz qw; or "kitti", "csv"
# frame = "base"                   # the frame whose trajectory it is
"""


def template_text(*, folder: Path | None = None, root: str | None = None) -> str:
    """Give a manifest to fill in.

    Args:
        folder: look into it and state what is there; None: the general template.
        root: how the manifest names the folder, None where it stands in it.

    Raises:
        DataError: the folder does not exist or holds nothing that a rig is made of, or a file in it cannot be read.
    """
    if folder is None:
        return TEMPLATE
    if not folder.is_dir():
        problem = "is a file" if folder.exists() else "no such folder"
        raise DataError(folder, "", f"{problem}; expected a folder with clouds, images or videos")
    found = survey(folder)
    if not found.sensors:
        raise DataError(
            folder, "", "no clouds, images or videos in it; expected pcd ply bin npz, png jpg, mp4 …"
        )
    lidars = [sensor.id for sensor in found.sensors if sensor.type == "lidar"]
    ego = lidars[0] if lidars else "base"
    head = [
        "# Written by a look into the folder: check every line. `nan` is what has to be filled in; lengths are metres.",
        "# Everything that can stand here: docs/formats/rig.md.",
        "",
        f"ego = {quoted(ego)}   # the frame that moves through the world: x forward, y left, z up",
        *([f"root = {quoted(root)}"] if root else []),
    ]
    parts = ["\n".join(head), *(_sensor(sensor, ego) for sensor in found.sensors)]
    parts += [_trajectory(trajectory, ego) for trajectory in found.trajectories]
    return "\n\n".join(parts) + "\n"


def write_template(path: Path, *, folder: Path | None = None, overwrite: bool = False) -> None:
    """Write a manifest to fill in.

    Args:
        path: the file to write, usually `rig.toml`.
        folder: look into it and state what is there; None: the general template.
        overwrite: replace a file that is there.

    Raises:
        OptionError: the path is no `.toml`.
        OutputError: the file exists, or cannot be written.
        DataError: the folder holds nothing that a rig is made of, or a file in it cannot be read.
    """
    if path.suffix.lower() != ".toml":
        raise OptionError(
            f"{path}: there are templates of rig.toml only; expected a name that ends with .toml"
        )
    text = template_text(folder=folder, root=None if folder is None else _root(path, folder))
    with replacing(path, overwrite=overwrite) as draft:
        # names may be no Unicode, TOML always is
        draft.write_bytes(text.encode("utf-8", "replace"))


def _root(path: Path, folder: Path) -> str | None:
    """How a manifest names the folder of its files: from beside it, if it is near; None where it stands in it."""
    here, there = path.resolve().parent, folder.resolve()
    if here == there:
        return None
    if there.is_relative_to(here):
        return there.relative_to(here).as_posix()
    return (
        f"../{there.relative_to(here.parent).as_posix()}" if there.is_relative_to(here.parent) else str(there)
    )


def quoted(text: str) -> str:
    """Write a text as TOML does."""
    if "'" in text or any(map(_is_control, text)):
        escaped = text.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(f"\\u{ord(sign):04x}" if _is_control(sign) else sign for sign in escaped) + '"'
    return f'"{text}"' if '"' not in text and "\\" not in text else f"'{text}'"


def _is_control(sign: str) -> bool:
    """Whether TOML has no field for a character, be it in a comment."""
    return ord(sign) < 32 or ord(sign) == 127


def _comment(text: str) -> str:
    return "".join("?" if _is_control(sign) else sign for sign in text)


def _table(values: Times) -> str:
    written = {name: quoted(v) if isinstance(v, str) else str(v).lower() for name, v in values.items()}
    return "{ " + ", ".join(f"{name} = {value}" for name, value in written.items()) + " }"


def _sensor(sensor: FoundSensor, ego: str) -> str:
    lines = ["[[sensors]]", f"id = {quoted(sensor.id)}", f"type = {quoted(sensor.type)}"]
    lines += [f"{name} = {quoted(value)}" for name, value in sensor.files.items()]
    # columns may be called anything in a damaged file
    lines[-1] += f"   # {_comment(sensor.about)}"
    if sensor.times:
        lines.append(f"times = {_table(sensor.times)}")
    lines += list(sensor.further)
    if sensor.size is not None:
        lines += [
            'axes = "optical"   # of its frame: x right, y down, z forward; "flu": x forward, y left, z up'
        ]
        camera_model = "fx = nan, fy = nan, cx = nan, cy = nan, coefficients = []"
        lines.append(
            f"camera_model = {{ {camera_model}, width = {sensor.size[0]}, height = {sensor.size[1]} }}"
        )
    if sensor.id != ego and sensor.type != "gnss":
        location = "translation = [nan, nan, nan], quaternion_xyzw = [nan, nan, nan, nan]"
        lines.append(f"extrinsic = {{ to = {quoted(ego)}, {location} }}")
    return "\n".join(lines)


def _trajectory(trajectory: FoundTrajectory, ego: str) -> str:
    lines = [
        "[[trajectories]]",
        f"name = {quoted(trajectory.name)}",
        f"file = {quoted(trajectory.file)}",
        f"form = {quoted(trajectory.form)}",
        *([f"times = {quoted(trajectory.times)}"] if trajectory.times else []),
        f"frame = {quoted(ego)}   # the frame whose trajectory it is",
    ]
    return "\n".join(lines)
