"""The configuration data of DB34/T 4101-2022: predefined and added properties, their types, and what they mean."""

from sceneloom.fusion.properties.predefined import PREDEFINED, PredefinedProperty
from sceneloom.fusion.properties.store import Property, PropertyStore, Snapshot

__all__ = [
    "PREDEFINED",
    "PredefinedProperty",
    "Property",
    "PropertyStore",
    "Snapshot",
]
