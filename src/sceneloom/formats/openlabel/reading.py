"""An OpenLABEL file as a scene."""

from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.formats.ledger import Ledger
from sceneloom.formats.openlabel.collection import Element, gather
from sceneloom.formats.openlabel.document import Part, read_document
from sceneloom.formats.openlabel.frame_times import frame_times
from sceneloom.formats.openlabel.ours import Ours
from sceneloom.formats.openlabel.read_objects import Reader, links
from sceneloom.formats.openlabel.read_streams import ego_path, read_streams
from sceneloom.formats.openlabel.systems import read_systems
from sceneloom.formats.openlabel.words import OURS, SCHEMA_VERSION
from sceneloom.formats.option_values import as_positive
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier
from sceneloom.scene.warnings import WarningKind

KEPT = ("metadata", "ontologies", "resources", "tags")
"""Members of the root that are kept as they are."""


def read_openlabel(path: Path, *, lenient: bool = False, rate_hz: float | str | None = None) -> Scene:
    """Read a file.

    Args:
        path: of the file.
        lenient: leave out what is wrong, and count it.
        rate_hz: frames per second of a file whose frames have no times.

    Raises:
        DataError: the file is wrong.
        OptionError: the rate is no number above 0.
    """
    rate = None if rate_hz is None else as_positive("rate_hz", rate_hz)
    document, ledger = read_document(path), Ledger(lenient=lenient)
    with ledger.telling():
        return _scene(document, ledger, rate)


def _scene(document: Part, ledger: Ledger, rate_hz: float | None) -> Scene:
    _check_version(document, ledger)
    times = frame_times(document, ledger, rate_hz)
    systems = read_systems(document, times, ledger)
    sensors = read_streams(document, systems, ledger)
    names = [name for name, _ in document.each("streams")]
    elements, ours = gather(document, times), Ours.of(document)
    reader = Reader(times, systems, dict(zip(names, sensors, strict=True)), ours, ledger)
    annotations = list(reader.annotations(elements))
    annotations += links(document, _ids(elements, annotations, ours), ours, ledger)
    trajectory = ego_path(systems)
    trajectories = {}
    if trajectory is not None:
        name, path = trajectory
        stated = None if ours.part is None else ours.part.members().get("trajectory")
        name = stated if isinstance(stated, str) else name
        trajectories[name] = Trajectory(name, path.timestamps_ns, path.positions, path.quaternions_xyzw)
    return Scene(
        sensors,
        annotations=tuple(annotations),
        trajectories=MappingProxyType(trajectories),
        metadata=MappingProxyType(_metadata(document)),
        source=str(document.file),
        format="openlabel",
        warnings=ledger.warnings,
    )


def _check_version(document: Part, ledger: Ledger) -> None:
    metadata = document.get("metadata")
    version = None if metadata is None else metadata.get("schema_version")
    if version is None or version.value != SCHEMA_VERSION:
        reported = (
            f"version {None if version is None else version.value!r} of the schema; read as {SCHEMA_VERSION}"
        )
        ledger.note(WarningKind.ASSUMED, "schema-version", f"{document.file}: openlabel.metadata", reported)


def _ids(
    elements: list[Element], annotations: list[Annotation], ours: Ours
) -> dict[tuple[str, str], Identifier]:
    """Ids of annotations by what relations call them."""
    found: dict[tuple[str, str], Identifier] = {}
    known = {annotation.id for annotation in annotations}
    for element in elements:
        fields: Any = {} if ours.part is None else ours.part.members().get(element.kind, {})
        stated = fields.get(element.uid, {}) if isinstance(fields, dict) else {}
        own = stated.get("id", element.id) if isinstance(stated, dict) else element.id
        if isinstance(own, str | int) and own in known:
            found[element.kind, element.uid] = own
    return found


def _metadata(document: Part) -> dict[str, Any]:
    """The members that the model has no field for, and how the angles of boxes are meant."""
    kept = {name: value for name in KEPT if (value := document.members().get(name))}
    if isinstance(kept.get("metadata"), dict):
        own = {
            name: value for name, value in kept["metadata"].items() if name not in {OURS, "schema_version"}
        }
        kept.pop("metadata")
        kept.update({"metadata": own} if own else {})
    angles = CuboidAngles()
    metadata: dict[str, Any] = {OURS: {"euler_unit": str(angles.unit), "euler_order": angles.order}}
    ours = Ours.of(document).part
    further = None if ours is None else ours.members().get("metadata")
    if isinstance(further, dict):
        metadata = {**further, OURS: {**further.get(OURS, {}), **metadata[OURS]}}
    return {**metadata, **({"openlabel": kept} if kept else {})}
