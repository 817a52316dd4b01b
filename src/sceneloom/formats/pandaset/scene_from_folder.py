"""A drive of PandaSet as a scene."""

from pathlib import Path
from types import MappingProxyType

from sceneloom.formats.ledger import Ledger
from sceneloom.formats.pandaset.cuboids import build_cuboids
from sceneloom.formats.pandaset.semantic import build_labelled_points
from sceneloom.formats.pandaset.sensors import (
    build_cameras,
    build_lidars,
    build_receiver,
    read_sweeps,
    trajectory_of,
)
from sceneloom.formats.pandaset.spec import is_drive
from sceneloom.formats.spec import choose_drive, drives_in
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.scene import Scene

_ANGLES = MappingProxyType({"euler_unit": "degrees", "euler_order": "xyz"})


def open_pandaset(path: Path, *, sequence: str | None = None, lenient: bool = False) -> Scene:
    """Open a drive; images, points and their classes are read when asked for, boxes at once.

    Args:
        path: the folder of a drive (`002`), or one of several.
        sequence: name of the drive, where there are several.
        lenient: leave out files of boxes that are at fault, and count them.

    Raises:
        DataError: a file is missing or wrong.
        OptionError: there is no such drive, or none was chosen of several.
    """
    drive = choose_drive(
        path,
        drives_in(path, is_drive),
        sequence,
        called="drive",
        expected="lidar/00.pkl.gz, lidar/poses.json, camera/",
    )
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        sweeps = read_sweeps(drive)
        trajectory = trajectory_of(sweeps)
        sensors = (*build_lidars(sweeps), *build_cameras(drive, ledger), *build_receiver(drive))
        annotations: tuple[Annotation, ...] = (
            *build_cuboids(drive, sweeps, ledger),
            *build_labelled_points(drive, sweeps),
        )
    return Scene(
        sensors=sensors,
        annotations=annotations,
        trajectories=MappingProxyType({trajectory.name: trajectory}),
        metadata=MappingProxyType({"pandaset": {"sequence": drive.name}, "sceneloom": dict(_ANGLES)}),
        source=str(drive),
        format="pandaset",
        warnings=ledger.warnings,
    )
