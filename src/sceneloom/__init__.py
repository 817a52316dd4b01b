"""Weave every sensor of a drive into one scene.

```python
import sceneloom

with sceneloom.open("drive/") as scene:
    report = sceneloom.fuse(scene, "drive.sfs")
```

The readers, the fusion and the simulator are imported when they are first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sceneloom.errors import SceneloomError
from sceneloom.formats.table import open_scene as open
from sceneloom.formats.table import write_scene as write
from sceneloom.scene import PosePath, Scene
from sceneloom.version import __version__

if TYPE_CHECKING:
    from sceneloom.formats.sfs import SceneWriter
    from sceneloom.pipeline import convert, fuse, iter_fused
    from sceneloom.simulate import simulate_street

__all__ = [
    "PosePath",
    "Scene",
    "SceneWriter",
    "SceneloomError",
    "__version__",
    "convert",
    "fuse",
    "iter_fused",
    "open",
    "simulate_street",
    "write",
]

_ON_FIRST_USE = {
    "SceneWriter": "sceneloom.formats.sfs",
    "convert": "sceneloom.pipeline",
    "fuse": "sceneloom.pipeline",
    "iter_fused": "sceneloom.pipeline",
    "simulate_street": "sceneloom.simulate",
}


def __getattr__(name: str) -> Any:
    if name not in _ON_FIRST_USE:
        raise AttributeError(f"module 'sceneloom' has no attribute {name!r}")
    return getattr(import_module(_ON_FIRST_USE[name]), name)


def __dir__() -> list[str]:
    return __all__
