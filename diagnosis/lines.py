"""One line of a diagnosis."""

from typing import NamedTuple


class Line(NamedTuple):
    """What was looked at; with a remedy it is a finding, else all is well, or, as a note, for the user to judge."""

    text: str
    remedy: str = ""
    note: bool = False

    @property
    def finding(self) -> bool:
        return bool(self.remedy)

    def __str__(self) -> str:
        if self.finding:
            return f"PROBLEM {self.text} -> {self.remedy}"
        return f"{'note' if self.note else 'ok':8}{self.text}"


def from_error(error: Exception) -> Line:
    """A UserError's sentence: what is wrong; what to do."""
    text, semicolon, remedy = str(error).rpartition("; ")
    return Line(text, remedy) if semicolon else Line(remedy, "mend that and look again")
