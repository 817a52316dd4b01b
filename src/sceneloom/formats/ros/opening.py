"""The files of a bag: a `.bag` of ROS 1, a folder of ROS 2 with its `metadata.yaml`, or a file of such a folder."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.errors import DataError, MissingExtraError, how_to_install
from sceneloom.formats.files import read_bytes
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.ros.bags import Bag
from sceneloom.formats.ros.mcap_bag import McapBag
from sceneloom.formats.ros.ros1_bag import Ros1Bag
from sceneloom.formats.ros.sniffing import METADATA, ROOT_KEY
from sceneloom.formats.ros.sqlite_bag import SqliteBag
from sceneloom.formats.ros.unpacked import UnpackedBag
from sceneloom.scene.notices import NoticeKind

STORAGES: Mapping[str, Callable[[Path, Ledger], Bag]] = MappingProxyType(
    {".bag": Ros1Bag, ".db3": SqliteBag, ".mcap": McapBag}
)

_TOO_DEEP = re.compile(r"(?:[\[{]\s*|- ){65}")
"""Collections in one another without anything between them; rosbag2 writes six, thousands take the parser seconds."""


def open_bags(path: Path, ledger: Ledger) -> list[Bag]:
    """Open all files of a bag.

    Raises:
        DataError: a file is missing, damaged, or packed as a whole.
    """
    told = _metadata(path, ledger) if path.is_dir() else {}
    files = _files(path, told, ledger) if path.is_dir() else [path]
    packed = str(told.get("compression_mode") or "").lower() == "message"
    bags: list[Bag] = []
    try:
        for file in files:
            bag = _open(file, ledger)
            bags.append(UnpackedBag(bag, str(told.get("compression_format") or "")) if packed else bag)
    except BaseException:
        for bag in bags:
            bag.close()
        raise
    return bags


def _open(file: Path, ledger: Ledger) -> Bag:
    if file.suffix.lower() == ".zstd":
        problem = f"is packed as a whole; unpack it first: zstd -d {file.name}, and reindex the bag"
        raise DataError(file, "", problem)
    storage = STORAGES.get(file.suffix.lower())
    if storage is None:
        raise DataError(file, "", f"suffix {file.suffix!r}; expected one of {', '.join(STORAGES)}")
    return storage(file, ledger)


def _metadata(folder: Path, ledger: Ledger) -> Mapping[str, Any]:
    """What `metadata.yaml` says; nothing, with a notice, where it is missing."""
    path = folder / METADATA
    if not path.is_file():
        message = f"{METADATA} is missing; all files of messages were read (`ros2 bag reindex` makes it anew)"
        ledger.note(NoticeKind.ASSUMED, "metadata-missing", str(folder), message)
        return {}
    try:
        from ruamel.yaml import YAML
        from ruamel.yaml.error import YAMLError
    except ImportError as missing:
        raise MissingExtraError(f"{missing}; install the extra: {how_to_install('ros')}") from missing
    try:
        text = read_bytes(path).decode()
        if _TOO_DEEP.search(text):
            raise ValueError("nested deeper than 64 levels")  # noqa: TRY301 - one place for all that can be wrong
        root = YAML(typ="safe").load(text)[ROOT_KEY]
        if not isinstance(root, dict):
            raise TypeError(f"{ROOT_KEY} is no mapping")  # noqa: TRY301 - one place for all that can be wrong
    except (YAMLError, OSError, ValueError, RecursionError, KeyError, TypeError) as error:
        ledger.fault("metadata-at-fault", DataError(path, "", f"cannot be read: {error}"))
        return {}
    return root


def _files(folder: Path, told: Mapping[str, Any], ledger: Ledger) -> list[Path]:
    named = told.get("relative_file_paths")
    if not named:
        found = sorted(file for file in folder.iterdir() if file.suffix.lower() in {".db3", ".mcap"})
        if not found:
            raise DataError(folder, "", "no .db3 or .mcap file; expected the messages of a bag")
        return found
    files = []
    for name in map(str, named):
        # old bags say the path from where they were recorded
        file = next((place for place in (folder / name, folder / Path(name).name) if place.is_file()), None)
        if file is None or not file.resolve().is_relative_to(folder.resolve()):
            error = DataError(
                folder / METADATA, "relative_file_paths", f"{name!r}; expected a file of the folder"
            )
            ledger.fault("bag-file-missing", error)
        else:
            files.append(file)
    return files
