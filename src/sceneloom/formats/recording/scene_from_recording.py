"""A recording's folder as a scene."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.default_poses import default_poses
from sceneloom.formats.identity import FileIdentity
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.calibration import CALIBRATION_FILE, Calibration, read_calibration
from sceneloom.formats.recording.camera_building import CameraSources, build_cameras
from sceneloom.formats.recording.camera_shifts import CAMERA_SHIFTS, applied_shifts
from sceneloom.formats.recording.further_contents import RecordingContents, further_contents
from sceneloom.formats.recording.image_files import ALIGNMENTS, OpenImages
from sceneloom.formats.recording.lidar_building import build_lidars
from sceneloom.formats.recording.lines import read_lines
from sceneloom.formats.recording.number_sensors import build_number_sensors
from sceneloom.formats.recording.spec import DATA_FILE
from sceneloom.formats.recording.trajectories import build_trajectories
from sceneloom.formats.recording.zipped import is_zip, unpack
from sceneloom.scene.scene import Scene

ALTITUDES = ("wgs84", "msl")


def _nothing() -> None:
    pass


@dataclass(frozen=True, slots=True)
class RecordingLocation:
    """A recording's folder.

    Attributes:
        folder: where its files are.
        source: what messages call it.
        data_path: its lines.
        alone: whether these are a log by itself, as programs put out, and what lies beside it is somebody else's.
        remove: takes away what was made for it.
    """

    folder: Path
    source: str
    data_path: Path
    alone: bool = False
    remove: Callable[[], None] = _nothing


@dataclass(frozen=True, slots=True, eq=False)
class Closing:
    """Closes what a scene holds open, then takes away what was made for it."""

    images: OpenImages
    remove: Callable[[], None]

    def __call__(self) -> None:
        """Close everything."""
        self.images.close()
        self.remove()


def find_location(path: Path) -> RecordingLocation:
    """Find the folder of a recording that is named by its folder, its log or a zip archive of it.

    Raises:
        DataError: the archive is damaged, or holds something else or too much.
    """
    if path.is_dir():
        return RecordingLocation(path, str(path), path / DATA_FILE)
    if is_zip(path):
        unpacked = unpack(path, DATA_FILE)
        return RecordingLocation(
            unpacked.folder, str(path), unpacked.folder / DATA_FILE, remove=unpacked.remove
        )
    if path.name == DATA_FILE:
        return RecordingLocation(path.parent, str(path.parent), path)
    if path.is_file():
        return RecordingLocation(path.parent, str(path), path, alone=True)
    return RecordingLocation(path, str(path), path / DATA_FILE)


def open_recording(
    path: Path,
    *,
    lenient: bool = False,
    altitude: str = "wgs84",
    camera_shift: str = "ignore",
    image_index: str = "auto",
) -> Scene:
    """Open a recording; images and points are read when asked for.

    Args:
        path: the folder, the `data.jsonl` in it, a zip archive, which is unpacked until the scene is closed, or any
            other file of such lines, as methods put out; what lies beside that counts only if it has images or lidar.
        lenient: leave out and count what is wrong instead of raising.
        altitude: what the altitudes of `gps` lines are above: "wgs84", the ellipsoid, or "msl", mean sea level.
        camera_shift: what becomes of `imuToCameraShiftSeconds` of the calibration: "ignore"; "apply" adds it to the
            times of the camera's images, which are then on the IMU's clock; "subtract" takes it off them.
        image_index: which image of a video a `frames` line means: "number": `number` is its index; "first": `number`
            less the first one; "line": each line the next image; "auto": "first" where there are as many images as
            the numbers span, "line" where as many as lines, else that is open: an error.

    Raises:
        DataError: files are missing or wrong.
        CalibrationError: a camera model or a mounting is unusable.
        OptionError: a value is unknown.
    """
    check_values(altitude, camera_shift, image_index)
    ledger = Ledger(lenient=lenient)
    return read_recording(
        find_location(path), altitude, ledger, camera_shift=camera_shift, image_index=image_index
    )[0]


def check_values(altitude: str, camera_shift: str, image_index: str = "auto") -> None:
    """Refuse reading options that have no such value.

    Raises:
        OptionError: there is none.
    """
    for name, value, known in (
        ("altitude", altitude, ALTITUDES),
        ("camera_shift", camera_shift, tuple(CAMERA_SHIFTS)),
        ("image_index", image_index, tuple(ALIGNMENTS)),
    ):
        if value not in known:
            raise OptionError(f"{name} {value!r}; expected one of: {', '.join(known)}")


def read_recording(
    location: RecordingLocation,
    altitude: str,
    ledger: Ledger,
    *,
    camera_shift: str = "ignore",
    image_index: str = "auto",
) -> tuple[Scene, RecordingContents]:
    """Read a recording with a ledger that decides what becomes of its faults; as `open_recording` else.

    Raises:
        DataError: it has a fault that the ledger does not take, or cannot be read.
    """
    try:
        with ledger.telling():
            return _read(location, altitude, camera_shift, image_index, ledger)
    except OSError as error:
        location.remove()
        raise DataError(location.source, "", f"cannot be read: {error}") from error
    except BaseException:
        location.remove()
        raise


def _read(
    location: RecordingLocation, altitude: str, camera_shift: str, image_index: str, ledger: Ledger
) -> tuple[Scene, RecordingContents]:
    folder, data_path = location.folder, location.data_path
    if not folder.is_dir():
        raise DataError(folder, "", "no such folder; expected a recording's folder")
    if not data_path.is_file():
        raise DataError(folder, "", f"holds no {DATA_FILE}; expected a recording's folder")
    data_file = FileIdentity.of(data_path)
    columns = read_lines(data_path, ledger)
    alone = location.alone and not (columns.frames.cameras or columns.lidars)
    calibration = Calibration(folder / CALIBRATION_FILE)
    if not alone:
        calibration = read_calibration(folder, ledger, data_path=data_path, other_lines=columns.other_lines)
    trajectories = build_trajectories(columns.poses, data_path, ledger)
    ego_path = default_poses(trajectories, str(data_path), ledger)
    opened = OpenImages()
    with ExitStack() as stack:
        stack.callback(opened.close)
        sources = CameraSources(
            folder,
            data_path,
            data_file,
            calibration,
            columns.frames,
            ego_path,
            ledger,
            opened,
            camera_shift,
            image_index,
        )
        lidars = build_lidars(folder, data_path, columns.lidars, calibration, ego_path, ledger)
        cameras = [] if alone else build_cameras(sources)
        ego_sensors = build_number_sensors(columns, calibration)
        contents = RecordingContents(folder, columns, calibration, trajectories, data_path.name, alone)
        metadata = {
            "altitude": altitude,
            **applied_shifts(calibration, camera_shift),
            **further_contents(contents, ledger, alone=alone),
        }
        scene = Scene(
            sensors=(*lidars, *cameras, *ego_sensors),
            trajectories=MappingProxyType(
                {trajectory.name: trajectory for trajectory in trajectories.values()}
            ),
            metadata=MappingProxyType({"recording": metadata}),
            source=location.source,
            format="recording",
            warnings=ledger.warnings,
            on_close=Closing(opened, location.remove),
        )
        stack.pop_all()
        return scene, contents
