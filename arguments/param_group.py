"""Options as records, from which parser, defaults, checks and help are made."""

import argparse
import math
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, ClassVar

from utils.system_utils import UserError

Value = bool | int | float | str


@dataclass(frozen=True)
class Option:
    """One command-line option.

    name, short: long name (also the attribute) and one-letter form; default: its type is the option's type.
    help: effect of the option. origin: source of the default; "ours..." for options that the reference does not have.
    check: returns None for a valid value, else a description of valid values.
    stored: written to `cfg_args`. remembered: written to `model.json`, for render.py.
    loaded: what a command that loads a model takes if the option is not given; empty: what the model was trained with.
    """

    name: str
    default: Value
    help: str
    origin: str = "reference"
    short: str | None = None
    check: Callable[[Any], str | None] | None = None
    stored: bool = False
    remembered: bool = False
    loaded: str = ""

    @property
    def ours(self) -> bool:
        """Whether the reference does not have this option."""
        return self.origin.startswith("ours")

    def add_to(self, group: argparse._ArgumentGroup, sentinel: bool) -> None:
        flags = [f"--{self.name}"] + ([f"-{self.short}"] if self.short else [])
        default = None if sentinel else self.default
        text = f"{self.help} (default: {self._shown_default(sentinel)})".replace("%", "%%")
        if isinstance(self.default, bool):
            kind: dict[str, Any] = {"action": "store_true"}
        else:
            kind = {"type": type(self.default), "metavar": self._metavar()}
        action = group.add_argument(*flags, **kind, default=default, help=text)
        action.ours = self.ours  # type: ignore[attr-defined]  # for OptionParser

    def _shown_default(self, sentinel: bool) -> str:
        """Text about what counts if the option is not given. sentinel: by a command that loads a model."""
        if sentinel and (self.loaded or self.stored or self.remembered):
            return self.loaded or "that of the model"
        shown = "off" if self.default is False else repr(self.default) if self.default == "" else self.default
        return f"{shown}; {self.origin}"

    def _metavar(self) -> str:
        return {int: "N", float: "X", str: "TEXT"}[type(self.default)]

    def verify(self, value: Value) -> None:
        """Raise UserError if the value is not finite or fails the option's check."""
        if isinstance(value, float) and not math.isfinite(value):
            raise UserError(f"--{self.name} must be a finite number, got {value}")
        wanted = self.check(value) if self.check else None
        if wanted:
            raise UserError(f"--{self.name} must be {wanted}, got {value!r}")


class OptionParser(argparse.ArgumentParser):
    """A parser in which options that we added never make an abbreviation of a reference option ambiguous."""

    def _get_option_tuples(self, option_string: str) -> list[Any]:
        matches = super()._get_option_tuples(option_string)
        others = [match for match in matches if not getattr(match[0], "ours", False)]
        return others if len(others) == 1 else matches


class ParamGroup:
    """A group of options: adds them to a parser, and extracts their checked values from the parsed arguments.

    sentinel: make every default None ("not given"), so that get_combined_args can tell what the user typed.
    without: options that this command does not get, because they would have no effect.
    """

    title: ClassVar[str]
    options: ClassVar[tuple[Option, ...]]

    def __init__(self, parser: argparse.ArgumentParser, sentinel: bool = False, without: Collection[str] = ()) -> None:
        group = parser.add_argument_group(self.title)
        for option in self.options:
            if option.name not in without:
                option.add_to(group, sentinel)

    def extract(self, args: argparse.Namespace) -> argparse.Namespace:
        """Return this group's values from `args`; absent or None means the default. UserError for invalid values."""
        values: dict[str, Value] = {}
        for option in self.options:
            value = getattr(args, option.name, None)
            values[option.name] = option.default if value is None else value
            option.verify(values[option.name])
        return argparse.Namespace(**values)


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
    """Make a check for `Option`: value is one of `choices`."""
    return lambda value: None if value in choices else " or ".join(choices)
