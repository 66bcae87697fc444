"""Names in messages, and tables in Markdown."""

from collections.abc import Sequence


def some(names: Sequence[str], most: int = 5) -> str:
    """The first names of a list, and the number of further ones."""
    if not names:
        return "nothing"
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")


def counted(count: int, noun: str) -> str:
    """A number with its noun, in the plural unless the number is 1."""
    return f"{count} {noun}{'s' if count != 1 else ''}"


def as_utf8(text: str) -> str:
    """Make a text printable: bytes of a file's name that are not UTF-8 become numbers, `\\udcff`."""
    return text.encode("utf-8", "backslashreplace").decode()


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]], right: bool = True) -> str:
    """Markdown table of text cells, padded to be readable in a terminal, too.

    right: align all columns but the first to the right, as for numbers.
    """
    lines = [[cell.replace("|", "\\|").replace("\n", " ") for cell in line] for line in (header, *rows)]
    widths = [max(3, *map(len, column)) for column in zip(*lines, strict=True)]
    rule = ["-" * (width - 1) + ":" if right and i else "-" * width for i, width in enumerate(widths)]
    padded = [
        [
            cell.rjust(width) if right and i else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        for line in (lines[0], rule, *lines[1:])
    ]
    return "\n".join("| " + " | ".join(line) + " |" for line in padded)
