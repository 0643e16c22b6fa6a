"""Copies of plain frozen dataclasses, which the mission makes dozens of in every cycle."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # so that the fields and their types are checked
    from dataclasses import replace as replace  # noqa: PLC0414 - handed on
else:

    def replace(value: Any, /, **changes: Any) -> Any:
        """`dataclasses.replace` in a tenth of its time: one dictionary is copied instead of every field set anew.

        For classes without slots, without `__post_init__` and without cached properties, which would be copied along.

        Raises:
            TypeError: there is no such field.
        """
        table = value.__dict__ | changes
        if len(table) != len(value.__dict__):
            raise TypeError(f"{type(value).__name__} has no {', '.join(changes.keys() - value.__dict__.keys())}")
        other = object.__new__(type(value))
        object.__setattr__(other, "__dict__", table)
        return other


def of(cls: type, table: dict[str, Any]) -> Any:
    """A value of such a class from all its fields; `table` becomes the value's own."""
    value: Any = object.__new__(cls)
    object.__setattr__(value, "__dict__", table)
    return value
