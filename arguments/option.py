"""An option of the command line as a record, from which parser, defaults, checks and help are made."""

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from utils.system_utils import UserError

Value = bool | int | float | str
CFG_ARGS = "cfg_args"  # the file of options in a model folder of the reference
MOST_NEEDED, NUMBERS = "most needed", "the method's numbers"
# Groups of options in train.py's help and on the site, in their order.
TOPICS = {
    MOST_NEEDED: "options that most trainings need",
    "data": "photos, start points, masks, depth maps, background",
    "quality and speed": "schedules, SH degree, aliasing, sky",
    "photos that vary": "different exposure or white balance, passers-by",
    "cameras": "lenses, panoramas, wrong poses",
    "output": "when to score and save, and what is saved",
    "viewers": "addresses of the web page and the remote viewer",
    "memory": "where photos and Gaussians are kept",
    NUMBERS: "learning rates, loss weights, densification",
    "debugging": "checks and slower paths",
}


@dataclass(frozen=True)
class Option:
    """One command-line option.

    name: long name, which is also the attribute.
    default: default value, whose type is the option's type.
    help: effect, may be empty.
    origin: source of the default; "ours..." for options that the reference does not have.
    short: one-letter form.
    check: function that returns None for a valid value, else a description of valid values.
    stored: file of the model folder that keeps the value; empty: none.
    compared: true if a resumed run warns of a value that is not the stored one.
    after: option of the same group that this one follows; empty: the place of its part.
    seen: true if renders of a model differ with the value, unless their names say so.
    loaded: value for a command that loads a model, if the option is not given; empty: the stored value.
    called: default where a program calls `train.training`, if that is another one.
    topic: group of the option in train.py's help, one of TOPICS.
    unset: default that the help shows, if not the value.
    above_zero: true if a typed 0, which would count as not given, is refused.
    """

    name: str
    default: Value
    help: str
    origin: str = "reference"
    short: str | None = None
    check: Callable[[Any], str | None] | None = None
    stored: str = ""
    compared: bool = True
    loaded: str = ""
    called: Value | None = None
    seen: bool = True
    after: str = ""
    topic: str = NUMBERS
    unset: str = ""
    above_zero: bool = False

    @property
    def ours(self) -> bool:
        """True if the reference does not have this option."""
        return self.origin.startswith("ours")

    @property
    def attribute(self) -> str:
        """Name of the group's attribute that holds the default: with a leading underscore if there is a short form."""
        return f"_{self.name}" if self.short else self.name

    def add_to(self, group: argparse._ActionsContainer, sentinel: bool) -> None:
        """Add this option to a group of an argument parser.

        sentinel: the parser's default is None, so that a missing option can be told from one given its default.
        """
        flags = [f"--{self.name}"] + ([f"-{self.short}"] if self.short else [])
        default = None if sentinel else self.default
        text = f"{self.help} (default: {self._tell_default(sentinel)})" if self.help else f"default: {self._format()}"
        if isinstance(self.default, bool):
            kind: dict[str, Any] = {"action": "store_true"}
        else:
            kind = {"type": type(self.default), "metavar": self._metavar()}
        action = group.add_argument(*flags, **kind, default=default, help=text.replace("%", "%%"))
        for name in ("ours", "topic", "above_zero"):  # for the parsers of arguments/
            setattr(action, name, getattr(self, name))

    def _format(self) -> str:
        return "off" if self.default is False else "none" if self.default == "" else str(self.default)

    def _tell_default(self, sentinel: bool) -> str:
        """Return a text about the value that counts if the option is not given.

        sentinel: true for a command that loads a model.
        """
        if sentinel and (self.loaded or self.stored):
            return self.loaded or "that of the model"
        return self.unset or f"{self._format()}; {self.origin}"

    def _metavar(self) -> str | None:
        if choices := getattr(self.check, "choices", ()):
            return f"{{{','.join(choices)}}}"
        return {int: "N", float: "X", str: "TEXT"}.get(type(self.default))

    def verify(self, value: Value) -> None:
        """Raise UserError if the value is not finite, no boolean for a flag, or fails the option's check."""
        if isinstance(self.default, bool) and value not in (False, True):
            raise UserError(f"--{self.name} must be True or False, got {value!r}")
        if isinstance(value, float) and not math.isfinite(value):
            raise UserError(f"--{self.name} must be a finite number, got {value}")
        valid = self.check(value) if self.check else None
        if valid:
            raise UserError(f"--{self.name} must be {valid}, got {value!r}")


def in_places(options: Sequence[Option]) -> tuple[Option, ...]:
    """Return the options in order: each one that names another in `after` comes behind it."""
    places = {option.name: (index, 0) for index, option in enumerate(options)}
    return tuple(sorted(options, key=lambda one: (*places[one.after][:1], 1) if one.after else places[one.name]))


def at_least(low: float) -> Callable[[float], str | None]:
    """Make a check for `Option`: value >= low."""
    return lambda value: None if value >= low else f"at least {low}"


def above(low: float) -> Callable[[float], str | None]:
    """Make a check for `Option`: value > low."""
    return lambda value: None if value > low else f"greater than {low}"


def within(low: float, high: float) -> Callable[[float], str | None]:
    """Make a check for `Option`: low <= value <= high."""
    return lambda value: None if low <= value <= high else f"between {low} and {high}"


def one_of(*choices: str) -> Callable[[str], str | None]:
    """Make a check for `Option`: value is one of `choices`, which its help shows."""

    def check(value: str) -> str | None:
        return None if value in choices else " or ".join(choices)

    check.choices = choices
    return check
