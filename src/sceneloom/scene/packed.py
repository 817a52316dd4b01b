"""Fields that are taken out of packed records when the first of them is asked for."""

from typing import TYPE_CHECKING, Any, Protocol, Self


class Packed(Protocol):
    """Records that hold what the fields of an object state."""

    def __len__(self) -> int:
        """Count the records."""
        ...

    def unpacked(self) -> Any:
        """Give an object of the same class that has all its fields."""
        ...


class UnpackedWhenAsked:
    """The base of a frozen dataclass whose objects may be made of packed records.

    All fields are filled at once, when the first is asked for, and the records let go. Nobody can report such an object
    from another one, but by the time that the first use takes.
    """

    # of a base class, since a dataclass with slots has none beside its fields
    __slots__ = ("_packed",)

    @classmethod
    def of_packed(cls, packed: Packed) -> Self:
        """Make an object whose fields are still packed."""
        made = object.__new__(cls)
        object.__setattr__(made, "_packed", packed)
        return made

    def packed_count(self) -> int | None:
        """Count the records of an object whose fields nobody has asked for yet; None for any other."""
        packed: Packed | None = getattr(self, "_packed", None)
        return None if packed is None else len(packed)

    def packed_records(self) -> Packed | None:
        """Give the records of an object whose fields nobody has asked for yet, to copy them; None for any other."""
        packed: Packed | None = getattr(self, "_packed", None)
        return packed

    # type checkers would take any name for a field
    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Fill the fields; Python asks here only for what is not there."""
            if name not in type(self).__dataclass_fields__:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            packed = self._packed
            if packed is not None:
                made = packed.unpacked()
                for field in type(self).__dataclass_fields__:
                    object.__setattr__(self, field, getattr(made, field))
                # last: two threads may both fill the fields, but none may find them empty
                object.__setattr__(self, "_packed", None)
            return object.__getattribute__(self, name)
