"""Fixtures that all tests share, and how hard Hypothesis tries."""

import gc
import json
import os
from collections import defaultdict
from collections.abc import Callable, Generator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from tests.peers import python_with

from sceneloom.kernels.cache import PACKAGES, compile_kernels, declared_kernels, lacks_kernels

settings.register_profile("default", max_examples=20, derandomize=True, database=None, deadline=None)
settings.register_profile(
    "deep",
    max_examples=800,
    database=None,
    deadline=None,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
settings.load_profile("default")


def pytest_configure(config: pytest.Config) -> None:
    """Let each worker of a run of all tests compile other kernels.

    All workers collect the same modules in the same order, and where no kernel is kept on disk yet, each of them would
    compile the same one at the same time, for minutes. The largest come first, so that all are done at about the same
    time.
    """
    if not hasattr(config, "workerinput") or config.args_source is not pytest.Config.ArgsSource.TESTPATHS:
        return
    claims = Path(config.option.basetemp).parent / "kernels"
    claims.mkdir(exist_ok=True)
    package = Path(__file__).parents[1] / "src" / "sceneloom"
    sources = [source for name in PACKAGES for source in package.glob(f"{name}/[a-z]*.py")]
    for source in sorted(sources, key=lambda source: source.stat().st_size, reverse=True):
        try:
            (claims / f"{source.parent.name}.{source.stem}").touch(exist_ok=False)
        except FileExistsError:
            continue
        module = f"sceneloom.{source.parent.name}.{source.stem}"
        if lacks_kernels(module):
            import_module(module)
            compile_kernels(declared_kernels(module))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Leave all but some cases of a test marked `few(count)` to the long run, evenly spread over its cases."""
    cases = defaultdict(list)
    for item in items:
        if item.get_closest_marker("few") is not None:
            cases[item.nodeid.partition("[")[0]].append(item)
    for found in cases.values():
        count = found[0].get_closest_marker("few").args[0]
        kept = {k * len(found) // count for k in range(count)}
        for k, item in enumerate(found):
            if k not in kept:
                item.add_marker(pytest.mark.slow)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Keep the garbage collector away from what is collected: it would walk through all tests again and again."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real data; tests that need it are skipped where it is absent."""
    folder = Path(os.environ.get("SCENELOOM_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}: set SCENELOOM_DATA")
    return folder


@pytest.fixture(scope="session")
def scale_python() -> str:
    """A Python interpreter that has Scale's library; tests against it are skipped without one."""
    return python_with("scale-sensor-fusion-io", "SCENELOOM_SCALE_PYTHON")


def _encode_sfs(header: dict[str, Any], *, index_type: type = int, **item_fields: Any) -> bytes:
    """Write a JSON-binary container the slow, obvious trajectory; `item_fields` replace fields of every item."""
    items, blobs = [], bytes(4)

    def location(node: Any, keys: list[Any]) -> Any:
        nonlocal blobs
        if isinstance(node, dict):
            return {key: location(value, [*keys, key]) for key, value in node.items()}
        if isinstance(node, list):
            return [location(value, [*keys, index_type(index)]) for index, value in enumerate(node)]
        if isinstance(node, np.ndarray):
            content = node.tobytes()
            item = {"keys": keys, "length": len(content), "offset": len(blobs)}
            items.append({**item, "dtype": node.dtype.name, "shape": list(node.shape), **item_fields})
            blobs += content + bytes(4 - len(content) % 4)
            return ""
        return node

    text = json.dumps({**location(header, []), "$items": items}).encode()
    return text + b" " * (4 - len(text) % 4) + blobs


def _decode_sfs(content: bytes) -> dict[str, Any]:
    """Read a JSON-binary container the slow, obvious trajectory, checking what every reader relies on."""
    stop = content.index(b"\0")
    header = json.loads(content[:stop].decode("utf-8"))
    assert content[stop : stop + 4] == bytes(4)
    for item in header.pop("$items"):
        start = stop + item["offset"]
        raw = content[start : start + item["length"]]
        assert len(raw) == item["length"]
        assert content[start + item["length"]] == 0
        node = header
        for key in item["keys"][:-1]:
            node = node[key]
        assert node[item["keys"][-1]] == ""
        node[item["keys"][-1]] = np.frombuffer(raw, item["dtype"]).reshape(item["shape"])
    return header


@pytest.fixture(scope="session")
def encode_sfs() -> Callable[..., bytes]:
    """An independent writer of the container of `.sfs` files."""
    return _encode_sfs


@pytest.fixture(scope="session")
def decode_sfs() -> Callable[[bytes], dict[str, Any]]:
    """An independent reader of the container of `.sfs` files."""
    return _decode_sfs


def _assert_same(read, expected):
    """Compare parts of the model field by field, arrays with their dtype."""
    from sceneloom.scene import LazyFrames

    if isinstance(expected, np.ndarray):
        assert read.dtype == expected.dtype
        np.testing.assert_array_equal(read, expected)
    elif isinstance(expected, LazyFrames):
        _assert_same(list(read), list(expected))
    elif hasattr(expected, "__dataclass_fields__"):
        assert type(read) is type(expected)
        for name in expected.__dataclass_fields__:
            _assert_same(getattr(read, name), getattr(expected, name))
    elif isinstance(expected, list | tuple):
        assert len(read) == len(expected)
        for a, b in zip(read, expected, strict=True):
            _assert_same(a, b)
    elif hasattr(expected, "items"):
        assert set(read) == set(expected)
        for name in expected:
            _assert_same(read[name], expected[name])
    else:
        assert (type(read), read) == (type(expected), expected)


@pytest.fixture(scope="session")
def assert_same():
    """Compares parts of the model field by field."""
    return _assert_same
