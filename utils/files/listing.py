"""Lists of names in messages."""

from collections.abc import Sequence


def some(names: Sequence[str], most: int = 5) -> str:
    """The first names of a list, and how many more there are."""
    if not names:
        return "nothing"
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
