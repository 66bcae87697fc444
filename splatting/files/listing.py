"""Lists of names in messages."""

from collections.abc import Sequence


def some(names: Sequence[str], most: int = 5) -> str:
    """The first names of a list, and the number of further ones."""
    if not names:
        return "nothing"
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
