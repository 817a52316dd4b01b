"""The algorithms of both fusions: by name, built in or brought by other packages; functions; functions of a file."""

import inspect
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from hashlib import sha256
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.errors import OptionError, SceneloomError


class FusionType(IntEnum):
    """What is fused.

    Source: DB34/T 4101-2022, table 2, row 1.
    """

    SENSOR_DATA = 0
    DETECTIONS = 1


ENTRY_POINT_GROUPS: Mapping[FusionType, str] = MappingProxyType(
    {FusionType.SENSOR_DATA: "sceneloom.sensor_data_fusion", FusionType.DETECTIONS: "sceneloom.detection_fusion"}
)
"""Under which group of entry points a package offers an algorithm of each type.

What it names is called as `colouring.algorithms.FusionAlgorithm` or `detections.DetectionAlgorithm`.
"""

BUILT_IN: Mapping[FusionType, Mapping[str, str]] = MappingProxyType(
    {
        FusionType.SENSOR_DATA: {
            "projection": "sceneloom.colouring.algorithms:fuse_by_projection",
            "blending": "sceneloom.colouring.algorithms:fuse_by_blending",
        },
        FusionType.DETECTIONS: {"projection": "sceneloom.detections.projection:fuse_by_projection"},
    }
)
"""Algorithms of our own, by type and name."""

NEEDS: Mapping[str, str] = MappingProxyType(
    {
        "MV3d": "a trained network of Chen et al. 2017 (Multi-View 3D Object Detection), which no package here "
        "provides; a plug-in can, as an entry point of that name"
    }
)
"""Algorithms that are known by name and not built in, and what they need.

Source: DB34/T 4101-2022, table 2, row 7 gives MV3d as its example.
"""


def names(fusion_type: FusionType) -> tuple[str, ...]:
    """All algorithms of a type that are installed, those built in first."""
    brought = sorted(entry.name for entry in _brought(fusion_type))
    return tuple(dict.fromkeys((*BUILT_IN[fusion_type], *brought)))


AlgorithmChoice = str | Callable[..., Any]
"""An algorithm by its name, or a function that is one."""


def chosen_algorithm(fusion_type: FusionType, chosen: AlgorithmChoice) -> AlgorithmChoice:
    """Take what a user chose: "file.py:function" becomes that function, a name stays a name, a function is checked.

    Not for what a client of the service sends: the file is executed.

    Raises:
        OptionError: there is no such file or function, the file cannot be executed, or it takes other arguments.
    """
    if not isinstance(chosen, str):
        return _Checked.of(fusion_type, chosen)
    path, colon, function = chosen.rpartition(":")
    if chosen.endswith(".py") or (path.endswith(".py") and not function):
        raise OptionError(f"algorithm {chosen}: no function is named; expected FILE.py:FUNCTION")
    if not colon or not path.endswith(".py"):
        return chosen
    return _Checked.of(fusion_type, _FileFunction(path, function))


def algorithm(fusion_type: FusionType, name: AlgorithmChoice) -> Any:
    """Give an algorithm by its name; one that is built in is never replaced. A function is taken as it is.

    Raises:
        OptionError: none of that name is installed, or what brings it cannot be loaded.
    """
    if not isinstance(name, str):
        return _Checked.of(fusion_type, name)
    target = BUILT_IN[fusion_type].get(name)
    if target is not None:
        module, attribute = target.split(":")
        return getattr(import_module(module), attribute)
    found = [entry for entry in _brought(fusion_type) if entry.name == name]
    if not found:
        needs = f"; {name} needs {NEEDS[name]}" if name in NEEDS else ""
        raise OptionError(f"fusion_algorithm {name!r}; there are {', '.join(names(fusion_type))}{needs}")
    try:
        return _Checked.of(fusion_type, found[0].load(), name=name)
    except OptionError:
        raise
    except Exception as error:  # whatever a foreign package does while it is imported
        raise OptionError(f"fusion_algorithm {name!r} of {found[0].value} cannot be loaded: {error}") from error


def _brought(fusion_type: FusionType) -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=ENTRY_POINT_GROUPS[fusion_type]))


@dataclass(frozen=True, slots=True)
class _Checked:
    """An algorithm of someone else: what it gives is checked, and what it raises names it."""

    fusion_type: FusionType
    function: Callable[..., Any]
    name: str

    @classmethod
    def of(cls, fusion_type: FusionType, function: Any, *, name: str = "") -> "_Checked":
        if isinstance(function, _Checked):
            return function
        name = name or str(getattr(function, "__name__", function))
        of_points = fusion_type is FusionType.SENSOR_DATA
        arguments = "(points_world, requests, visibility, *, trajectory=None)" if of_points else "(pair)"
        expected = f"expected a function {arguments} -> {'ColouredPoints' if of_points else 'FusedBoxes'}"
        if not callable(function):
            raise OptionError(f"algorithm {name}: a {type(function).__name__}; {expected}")
        inner = function.load() if isinstance(function, _FileFunction) else function
        try:
            signature = inspect.signature(inner)
            if of_points:
                signature.bind(None, None, None, trajectory=None)
            else:
                signature.bind(None)
        except TypeError as error:
            raise OptionError(f"algorithm {name}: {error}; {expected}") from None
        except ValueError:  # compiled functions report no signature
            pass
        return cls(fusion_type, function, name)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        try:
            found = self.function(*arguments, **named)
        except SceneloomError:
            raise
        except Exception as error:  # whatever a foreign function does
            last = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{Path(last.filename).name}, line {last.lineno}"
            raise OptionError(f"algorithm {self.name}: {type(error).__name__}: {error} ({where})") from error
        from sceneloom.arrays import check_array
        from sceneloom.colouring.algorithms import ColouredPoints
        from sceneloom.detections.results import FusedBoxes

        of_points = self.fusion_type is FusionType.SENSOR_DATA
        wanted: Any = ColouredPoints if of_points else FusedBoxes
        if not isinstance(found, wanted):
            expected = f"sceneloom.{'colouring.ColouredPoints' if of_points else 'detections.FusedBoxes'}"
            raise OptionError(f"algorithm {self.name}: it returned a {type(found).__name__}; expected {expected}")
        if of_points:
            points_world, requests = arguments[:2]
            if len(found.views) != len(requests):
                raise OptionError(
                    f"algorithm {self.name}: {len(found.views)} views of {len(requests)} images; expected one of "
                    "each, in the order of the requests"
                )
            count = len(points_world)
            check_array(f"algorithm {self.name}: colors", found.colors, (count, 3), "uint8")
            check_array(f"algorithm {self.name}: camera_index", found.camera_index, (count,), "uint8")
        return found


@dataclass(frozen=True, slots=True)
class _FileFunction:
    """A function of a Python file, that worker processes find by the names of both."""

    path: str
    function: str

    def __str__(self) -> str:
        return f"{self.path}:{self.function}"

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self.load()(*arguments, **named)

    def load(self) -> Any:
        """Give the function; the file is executed once in a process."""
        module = _module_of(Path(self.path))
        found = getattr(module, self.function, None)
        if found is None:
            functions = inspect.getmembers(module, inspect.isfunction)
            known = [name for name, value in functions if value.__module__ == module.__name__]
            has = ", ".join(known) or "none"
            raise OptionError(f"algorithm {self}: no function {self.function!r} in the file; it has {has}")
        if not callable(found):
            raise OptionError(f"algorithm {self}: {self.function} is a {type(found).__name__}; expected a function")
        return found


def _module_of(path: Path) -> Any:
    """Execute a file as a module, with its folder on the path, or give the module that it is already."""
    if not path.is_file():
        raise OptionError(f"algorithm {path}: no such file; expected FILE.py:FUNCTION")
    name = f"sceneloom_algorithm_{sha256(str(path.resolve()).encode()).hexdigest()[:16]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise OptionError(f"algorithm {path}: no Python file")
    module = sys.modules[name] = module_from_spec(spec)
    sys.path.insert(0, str(path.parent))
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # whatever a foreign file does
        del sys.modules[name]
        raise OptionError(f"algorithm {path}: it cannot be loaded: {type(error).__name__}: {error}") from error
    finally:
        sys.path.remove(str(path.parent))
    return module
