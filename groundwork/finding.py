"""What is wrong with a scene, a training, a model or an installation, and what to do: the rules, by their subject.

environment          packages, GPU, extensions (imports nothing heavy)
photos, photo_files  what photos show; photos that are there twice, or blurred
shared_pixels        parts of nearly all photos that are the same, such as a caption
cameras, points      where they stand, and what no camera or cloud has
fit                  lenses, units and poses that the tracks of structure from motion contradict
scene                all of these in their order, for doctor.py and before a training
capture              photos and poses of a conversion, and what to photograph again
training, resources  before a training and after it; memory and disk
model, changes       a trained model; what has changed since its training
advice               options that a scene's own data ask for
"""

from enum import IntEnum
from typing import NamedTuple


class Severity(IntEnum):
    """How bad a finding is."""

    FINE = 0  # all is well
    NOTE = 1  # for the user to judge
    PROBLEM = 2
    HOPELESS = 3  # no training can make anything of it


class Finding(NamedTuple):
    """What a rule finds. remedy: what to do about it. options: of train.py, for which it speaks."""

    text: str
    remedy: str = ""
    severity: Severity = Severity.PROBLEM
    options: str = ""

    @property
    def is_problem(self) -> bool:
        """Whether something has to be done."""
        return self.severity >= Severity.PROBLEM

    @property
    def line(self) -> str:
        """As doctor.py prints it."""
        if self.is_problem:
            return f"PROBLEM {self.text}" + (f" -> {self.remedy}" if self.remedy else "")
        return f"{'note' if self.severity else 'ok':8}{self}"

    def __str__(self) -> str:
        remedy = self.remedy or (f"try {self.options}" if self.options else "")
        return f"{self.text}; {remedy}" if remedy else self.text


def fine(text: str) -> Finding:
    return Finding(text, severity=Severity.FINE)


def note(text: str, options: str = "") -> Finding:
    return Finding(text, severity=Severity.NOTE, options=options)


def from_error(error: Exception) -> Finding:
    """That of a UserError, whose sentence has the form: fault; remedy."""
    text, semicolon, remedy = str(error).rpartition("; ")
    return Finding(text, remedy) if semicolon else Finding(remedy, "fix that and check again")
