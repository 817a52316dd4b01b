"""Saved views as Rerun's own reader gives them."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from tests.properties.injected import injected_scene

pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install 'sceneloom[view]'")

from sceneloom.view import ViewReport, ViewSettings, save_view


@dataclass(frozen=True)
class Row:
    """What one entity was given at one time."""

    time_ns: int | None
    frame: int | None
    values: dict[str, Any]

    def array(self, name):
        """A component as an array."""
        return np.array(self.values[name])


@dataclass(frozen=True)
class Saved:
    """A saved view.

    Attributes:
        report: what was reported it.
        rows: of each entity, in the order of time; what holds always first.
        timelines: all that there are.
        layout: components of the layout with their values.
    """

    report: ViewReport
    rows: dict[str, list[Row]] = field(default_factory=dict)
    timelines: set[str] = field(default_factory=set)
    layout: list[tuple[str, Any]] = field(default_factory=list)

    def timed(self, path, component):
        """The rows of an entity that have a component and a time."""
        return [row for row in self.rows[path] if row.time_ns is not None and component in row.values]

    def arrays(self, path, component):
        """A component of an entity at all its times, as arrays."""
        return [row.array(component) for row in self.timed(path, component)]

    def lasting(self, path, component):
        """A component that holds at all times."""
        return next(row.values[component] for row in self.rows[path] if row.time_ns is None and component in row.values)


def read_saved(path, report):
    """Read a file through Rerun's reader."""
    from rerun.chunk import RrdReader

    reader, saved = RrdReader(path), Saved(report)
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        saved.timelines.update(chunk.timeline_names)
        columns = {name: batch.column(name) for name in batch.schema.names if not name.startswith("rerun.")}
        time = columns.pop("time", None)
        frame = columns.pop("frame", None)
        for k in range(batch.num_rows):
            found = ((name, column[k].as_py()) for name, column in columns.items() if column[k].is_valid)
            values = {name: value for name, value in found if value is not None}
            known = time is not None and time[k].is_valid
            times = (int(time[k].value), int(frame[k].as_py())) if known else (None, None)
            saved.rows.setdefault(str(chunk.entity_path), []).append(Row(*times, values))
    for rows in saved.rows.values():
        rows.sort(key=lambda row: (row.time_ns is not None, row.time_ns or 0))
    for entry in reader.blueprints():
        for chunk in reader.stream(store=entry):
            batch = chunk.to_record_batch()
            saved.layout.extend(
                (name, batch.column(name)[k].as_py())
                for name in batch.schema.names
                if ":" in name
                for k in range(batch.num_rows)
            )
    return saved


Save = Callable[..., Saved]


@pytest.fixture
def save(tmp_path):
    """Save scenes, and read what was saved."""

    def run(*sources, **settings):
        target = tmp_path / "drive.rrd"
        wanted = ViewSettings(**{"findings": False, **settings})
        return read_saved(target, save_view(sources, target, settings=wanted, overwrite=True))

    return run


@pytest.fixture(scope="session")
def injected():
    """A drive with every sensor and every type of annotation."""
    return injected_scene(odd=False)


@pytest.fixture(scope="session")
def injected_saved(injected, tmp_path_factory):
    """That drive as a saved view."""
    target = tmp_path_factory.mktemp("views") / "injected.rrd"
    return read_saved(target, save_view([replace(injected, corrections="ignore")], target))
