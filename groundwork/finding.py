"""Findings: faults of a scene, training, model or installation, with remedies. Rules by module:

environment          packages, GPU, extensions (imports nothing heavy)
photos, photo_files  content of photos; duplicates and blur
shared_pixels        parts of nearly all photos that are the same, such as a caption
cameras, points      positions, and impossible values of cameras and clouds
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
    """The severity of a finding."""

    FINE = 0  # all is well
    NOTE = 1  # for the user to judge
    PROBLEM = 2
    HOPELESS = 3  # no training can make anything of it


class Finding(NamedTuple):
    """The result of a rule. remedy: how to end the fault. options: options of train.py that the finding suggests."""

    text: str
    remedy: str = ""
    severity: Severity = Severity.PROBLEM
    options: str = ""

    @property
    def is_problem(self) -> bool:
        """True if something has to be done."""
        return self.severity >= Severity.PROBLEM

    @property
    def line(self) -> str:
        """The line that doctor.py prints."""
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
    """Make a finding of a UserError, whose sentence has the form: fault; remedy."""
    text, semicolon, remedy = str(error).rpartition("; ")
    return Finding(text, remedy) if semicolon else Finding(remedy, "fix that and check again")
