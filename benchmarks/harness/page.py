"""Tables between two marks of a page of docs/results, replaced by the benchmark that measures them."""

from pathlib import Path

from utils.system_utils import UserError, atomic_write

BEGIN, END = "<!-- begin {} -->", "<!-- end {} -->"


def check_marks(page: Path, name: str) -> None:
    """Raise UserError, before hours of measuring, if a page has no place for the tables of this name."""
    if BEGIN.format(name) not in page.read_text(encoding="utf-8"):
        raise UserError(f"{page} needs a line {BEGIN.format(name)} where the tables go; it has none")


def write_tables(page: Path, name: str, lines: list[str]) -> None:
    """Put `lines` between the marks of this name."""
    text = replace_tables(page.read_text(encoding="utf-8"), name, lines)
    with atomic_write(page) as temporary:
        temporary.write_text(text, encoding="utf-8")


def replace_tables(page: str, name: str, lines: list[str]) -> str:
    """Return the text of a page with `lines` between the marks of this name."""
    begin, end = BEGIN.format(name), END.format(name)
    before, _, rest = page.partition(begin)
    return "\n".join([before + begin, *lines, end]) + rest.partition(end)[2]
