"""What the kinds of clouds offer to the table of formats."""

from pathlib import Path
from typing import Any

from sceneloom.errors import check_option_names
from sceneloom.formats.clouds.folder import holds_kind, near_miss
from sceneloom.formats.clouds.holdings import holds_of
from sceneloom.formats.clouds.kinds import KINDS
from sceneloom.formats.clouds.opening import CloudReading, open_clouds
from sceneloom.formats.loss import LossReport
from sceneloom.formats.option_values import as_positive
from sceneloom.scene.scene import Scene


class CloudFormat:
    """Files of points of one kind, a frame each."""

    along_trajectory = True

    def __init__(self, name: str) -> None:
        """Take the kind of that name."""
        self._kind = KINDS[name]
        self.name = name
        self.suffixes: tuple[str, ...] = self._kind.endings[:1]
        self.looks_like = f"{self._kind.told}: one, or a folder of them"
        self.holds = holds_of(name)

    def recognises(self, path: Path) -> bool:
        """Say whether a path is such a file, or a folder of such files and nothing else."""
        return holds_kind(path, self._kind)

    def near_miss(self, path: Path) -> str | None:
        """Say what keeps a path that has such files from being of this format."""
        return near_miss(path, self._kind)

    def open(self, path: Path, **options: Any) -> Scene:
        """Open a file or a folder; the options are those of `CloudReading`.

        Raises:
            UnknownOptionError: an option is unknown.
            DataError: files are missing or wrong.
        """
        given = {name: value for name, value in options.items() if value is not None}
        check_option_names("opening clouds", given, tuple(CloudReading.__dataclass_fields__))
        if "rate_hz" in given:
            given["rate_hz"] = as_positive("rate_hz", given["rate_hz"])
        return open_clouds(path, self._kind, CloudReading(**given))

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write the lidar frames of a scene; the options are those of `CloudSaving`.

        Raises:
            UnknownOptionError: an option is unknown.
            OptionError: a path that is a file is given for several frames.
            OutputError: the output exists, or cannot be written.
        """
        from sceneloom.formats.clouds.saving import CloudSaving, write_clouds

        given = {name: value for name, value in options.items() if value is not None}
        of_pcd = {"encoding"} if self.name != "pcd" else set()
        known = tuple(name for name in CloudSaving.__dataclass_fields__ if name not in of_pcd)
        check_option_names(f"writing {self.name}", given, known)
        return write_clouds(scene, Path(path), self._kind, CloudSaving(**given), overwrite=overwrite)


PCD, PLY, LAS, LAZ, KITTI_BIN, NUSCENES_BIN, NPZ = map(CloudFormat, KINDS)
