"""Captures of networks with the packets of lidars: how they are recognised, and their options. Only read."""

from dataclasses import dataclass
from pathlib import Path

from sceneloom.formats.base.spec import FormatSpec, as_flag, first_bytes, option
from sceneloom.formats.packets.captures import MAGICS


@dataclass(frozen=True, slots=True)
class CaptureReading:
    """How a capture is to be read."""

    lenient: bool = option(default=False, help="Leave out lidars whose metadata or angles are missing or wrong.")
    metadata: str | None = option(
        default=None,
        help="Metadata of Ouster sensors (JSON), several with commas; by default the .json files beside the capture.",
    )
    angles: str | None = option(
        default=None,
        help="Angle or calibration file of the lidar (Hesai .csv or .dat, RoboSense .csv, Velodyne .yaml), or "
        "HOST=FILE for each, with commas; by default a file of the capture's name.",
    )
    model: str | None = option(
        default=None, help="Model, where packets do not tell it: vlp-16, hdl-64e-s2, pandar40p, helios-16p, …"
    )

    def __post_init__(self) -> None:
        object.__setattr__(self, "lenient", as_flag("lenient", self.lenient))


_LIVOX = b"livox_tech\0\0\0\0\0\0"  # how `.lvx` and `.lvx2` files begin


def _is_capture(path: Path) -> bool:
    return first_bytes(path, 4) in MAGICS


def _near_miss(path: Path) -> str | None:
    if path.suffix.lower() not in (".pcap", ".pcapng") or not path.is_file() or _is_capture(path):
        return None
    return "it is called like a capture, but does not begin as one does (unpack .gz first)"


FORMAT = FormatSpec(
    name="pcap",
    title="a capture of lidar packets",
    looks_like="a .pcap or .pcapng file of Ouster, Velodyne, Hesai, RoboSense or Livox lidars (built to the "
    "description: QT64, AT128, OT128, Pandar64, XT16, XT32, HDL-32E, "
    "HDL-64E, VLP-32C, VLS-128, Bpearl, RS-16, RS-32, Livox)",
    suffixes=(".pcap",),
    sniff=_is_capture,
    near_miss=_near_miss,
    reader="sceneloom.formats.packets.reader:open_capture",
    read_options=CaptureReading,
    instead="captures are only read; write a scene file (drive.sfs) or clouds (`--to pcd`) instead",
)


def _is_livox(path: Path) -> bool:
    return first_bytes(path, len(_LIVOX)) == _LIVOX


LVX = FormatSpec(
    name="lvx",
    title="a file of Livox lidars",
    looks_like="a .lvx (1.1) or .lvx2 file of Livox lidars (built to the description)",
    suffixes=(".lvx", ".lvx2"),
    sniff=_is_livox,
    reader="sceneloom.formats.packets.livox:open_lvx",
    read_options=("lenient",),
    instead="files of Livox lidars are only read; write a scene file (drive.sfs) or clouds (`--to pcd`) instead",
)
