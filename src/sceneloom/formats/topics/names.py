"""Names of sensors from those of topics, and topics that belong together."""

from collections import Counter
from collections.abc import Iterable, Sequence
from urllib.parse import quote, unquote

TAILS = frozenset(
    {
        "points", "points_raw", "point_cloud", "pointcloud", "pointcloud2", "cloud", "points2", "image", "image_raw",
        "image_rect", "image_color", "image_rect_color", "image_mono", "image_rect_raw", "raw", "compressed",
        "compressed_image", "compressed_video", "video", "data", "data_raw", "fix", "imu", "h264", "navsatfix",
        "location", "odometry", "pose", "mag", "temperature", "compressedDepth",
    }
)  # fmt: skip
"""Last parts of topics that state what messages are, and not of which sensor."""

CAMERA_MODEL_TAILS = frozenset({"camera_info", "calibration", "camera_calibration", "info", "intrinsics"})


_SAYING = (
    TAILS
    | CAMERA_MODEL_TAILS
    | {"annotations", "detections", "detections_2d", "boxes", "bounding_boxes", "objects"}
)


def parts_of(topic: str) -> list[str]:
    """The parts of a topic's name."""
    return [part for part in topic.split("/") if part]


def base_of(topic: str) -> str:
    """A topic's name without slash at the beginning and what messages are at the end; never empty."""
    parts = parts_of(topic)
    while len(parts) > 1 and parts[-1] in TAILS:
        parts.pop()
    return "/".join(parts) or topic or "topic"


def sensor_names(topics: Sequence[str]) -> list[str]:
    """Name the sensors of topics: short where that is unique, else the whole topic, with a number if need be."""
    bases = [base_of(topic) for topic in topics]
    counts, taken = Counter(bases), Counter[str]()
    names = []
    for topic, base in zip(topics, bases, strict=True):
        name = base if counts[base] == 1 else "/".join(parts_of(topic)) or base
        taken[name] += 1
        names.append(name if taken[name] == 1 else f"{name}~{taken[name]}")
    return names


def nearness(topic: str, other: str) -> int:
    """How many parts two topics share from the beginning."""
    count = 0
    for a, b in zip(parts_of(topic), parts_of(other), strict=False):
        if a != b:
            break
        count += 1
    return count


def nearest(topic: str, others: Iterable[str]) -> str | None:
    """The topic that belongs to the same sensor as another one: /front/camera_info to /front/image_raw.

    Without the last parts, which state what messages are, one of the two names has to begin with the other.
    """
    base = _bare(topic)
    found = []
    for other in others:
        bare = _bare(other)
        shared = nearness("/".join(base), "/".join(bare))
        if shared >= max(1, min(len(base), len(bare))):
            found.append((shared, -len(bare), other))
    return max(found)[2] if found else None


def _bare(topic: str) -> list[str]:
    parts = parts_of(topic)
    while len(parts) > 1 and parts[-1] in _SAYING:
        parts.pop()
    return parts


def topic_part(identifier: str | int) -> str:
    """An id as one part of a topic's name; `id_of_part` is its inverse for texts."""
    return quote(str(identifier), safe="") or "%"


def id_of_part(part: str) -> str:
    """The id of `topic_part`."""
    return "" if part == "%" else unquote(part)


def ros_part(identifier: str | int) -> str:
    """An id as one part of a ROS topic's name, of letters, digits and underscores; several ids may become one."""
    part = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in str(identifier)) or "_"
    return f"_{part}" if part[0].isdigit() else part


def unique_parts(parts: Iterable[str]) -> list[str]:
    """The same parts, numbered where one is there twice."""
    taken: Counter[str] = Counter()
    found = []
    for part in parts:
        taken[part] += 1
        found.append(part if taken[part] == 1 else f"{part}_{taken[part]}")
    return found
