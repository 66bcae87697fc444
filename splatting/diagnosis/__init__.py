"""Checks of doctor.py: the environment, a dataset, a trained model. Each returns lines and changes nothing."""

from typing import NamedTuple


class Line(NamedTuple):
    """Result of one check: a finding if it has a remedy, a note for the user to judge, else a pass."""

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
    """Line of a UserError, whose sentence has the form: fault; remedy."""
    text, semicolon, remedy = str(error).rpartition("; ")
    return Line(text, remedy) if semicolon else Line(remedy, "fix that and check again")
