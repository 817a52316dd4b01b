"""What bags of ROS offer to the table of formats."""

from pathlib import Path
from typing import Any

from sceneloom.errors import check_option_names
from sceneloom.formats.loss import LossReport
from sceneloom.formats.ros.holdings import HOLDS
from sceneloom.formats.ros.sniffing import is_ros1, is_ros2
from sceneloom.scene.scene import Scene

_READING_OPTIONS = ("lenient", "assume_model", "stamps", "ego", "world", "distro")


class _BagFormat:
    """What bags of both kinds share."""

    name: str
    holds = HOLDS

    def open(self, path: Path, **options: Any) -> Scene:
        """Open a bag; `open_bag` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            MissingExtraError: the extra `ros` is not installed.
            DataError: the bag is at fault.
        """
        check_option_names("opening a bag", options, _READING_OPTIONS)
        from sceneloom.formats.ros.scene_from_bag import open_bag

        return open_bag(path, form=self.name, **options)


class Ros1Format(_BagFormat):
    """Bags of ROS 1."""

    name = "ros1"
    suffixes: tuple[str, ...] = (".bag",)
    looks_like = "a bag of ROS 1 (.bag)"

    def recognises(self, path: Path) -> bool:
        """Say whether the path is a bag of ROS 1."""
        return is_ros1(path)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a scene; `write_ros1` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            MissingExtraError: the extra `ros` is not installed.
            OutputError: the bag exists, or cannot be written.
        """
        check_option_names("writing a bag", options, ("pictures", "distro"))
        from sceneloom.formats.ros.scene_to_bag import write_ros1

        return write_ros1(scene, path, overwrite=overwrite, **options)


class Ros2Format(_BagFormat):
    """Bags of ROS 2: folders with a `metadata.yaml`, or their files."""

    name = "ros2"
    suffixes: tuple[str, ...] = (".ros2",)
    looks_like = "a bag of ROS 2 (a folder with metadata.yaml and .db3 or .mcap files; written as NAME.ros2)"

    def recognises(self, path: Path) -> bool:
        """Say whether the path is a bag of ROS 2, or a file of one."""
        return is_ros2(path)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a scene; `write_ros2` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            MissingExtraError: the extra `ros` is not installed.
            OutputError: the bag exists, or cannot be written.
        """
        check_option_names("writing a bag", options, ("pictures", "storage", "distro"))
        from sceneloom.formats.ros.scene_to_bag import write_ros2

        return write_ros2(scene, path, overwrite=overwrite, **options)


ROS1, ROS2 = Ros1Format(), Ros2Format()
