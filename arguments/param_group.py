"""Groups of options, and the parser that takes them."""

import argparse
import difflib
import os
import re
from collections.abc import Collection
from typing import Any, ClassVar, NoReturn

from arguments.option import Option

_FOLDERS = {"-s": "scene", "-m": "model", "--scenes": "scene"}
_OF_WINDOWS = re.compile(r"([A-Za-z]):([\\/]\S.*|[\w.-]+)")  # a shell may have taken backslashes away
_TRUTHS = ("true", "false", "yes", "no", "on", "off", "1", "0")
_NUMBERS = {int: "a whole number in digits alone", float: "a number without a unit"}


class OptionParser(argparse.ArgumentParser):
    """A parser in which options that we added never make an abbreviation of a reference option ambiguous.

    An error is one line, without the usage of all options, and names the option that a mistyped one may stand for.
    lists_all: the option that lists all options.
    """

    lists_all = "-h"

    def parse_args(self, *words: Any, **more: Any) -> argparse.Namespace:
        args, unknown = self.parse_known_args(*words, **more)
        if unknown:
            self.error(self._describe_unknown(unknown))
        return args

    def _describe_unknown(self, words: list[str]) -> str:
        """Return the message for words of the command line that belong to no option, with a likely correction."""
        word = next((word for word in words if word.startswith("-")), words[0])
        if not word.startswith("-"):
            ways = [f"a {kind} by {flag}" for flag, kind in _FOLDERS.items() if flag in self._option_string_actions]
            named = f"name {' or '.join(ways)}, and " if ways else ""
            flags = "; a flag such as --eval takes no value" if word.lower() in _TRUTHS else ""
            return f"{word} belongs to no option; {named}quote names with spaces{flags}"
        name = word.partition("=")[0]
        near = difflib.get_close_matches(name, self._option_string_actions, 1)
        near = near or [flag for flag in _FOLDERS if name == flag[1:3] and flag in self._option_string_actions]
        near = near or [flag for flag in self._option_string_actions if len(name) == 2 and flag.startswith(f"-{name}")]
        return f"there is no option {word}" + (f"; did you mean {near[0]}?" if near else "")

    def _get_value(self, action: argparse.Action, text: str) -> Any:
        """Convert the text of an option, as argparse does, with messages that name the expected kind of value."""
        path = None if os.name == "nt" or os.path.exists(text) else _OF_WINDOWS.fullmatch(text)
        if path and (path[2][0] in "\\/" or action.dest in ("source_path", "model_path")):
            below = path[2].replace("\\", "/").lstrip("/") if path[2][0] in "\\/" else "..."
            mounted = f"/mnt/{path[1].lower()}/{below}"
            raise argparse.ArgumentError(action, f"{text} is a path of Windows; under WSL, type {mounted}")
        try:
            value = super()._get_value(action, text)
        except argparse.ArgumentError as error:
            if action.type not in _NUMBERS:
                raise
            about = re.split(r"; |\. | ?\(", action.help or "")[0]
            said = f"takes {_NUMBERS[action.type]}" + (f" ({about})" if about else "")
            raise argparse.ArgumentError(action, f"{said}, got {text!r}") from error
        if value == 0 and getattr(action, "above_zero", False):
            raise argparse.ArgumentError(action, "must be above 0; leave it out for its default")
        return value

    def error(self, message: str) -> NoReturn:
        message = re.sub("ignored explicit argument (.*)", r"takes no value, got \1; give it alone", message)
        self.exit(2, f"error: {message} ({self.prog} {self.lists_all} lists all options)\n")

    def _get_option_tuples(self, option_string: str) -> list[Any]:
        matches = super()._get_option_tuples(option_string)
        others = [match for match in matches if not getattr(match[0], "ours", False)]
        return others if len(others) == 1 else matches


class GroupParams(argparse.Namespace):
    """Values of a group's options, as `ParamGroup.extract` returns them."""


class ParamGroup:
    """A group of options: adds them to a parser, and extracts their values from the parsed arguments.

    Its attributes are its options, and their values the defaults. A subclass sets them, then calls this constructor:
    `self.steps = 7` adds `--steps`, `self._folder = ""` adds `--folder` and `-f`, and a bool adds a flag.
    fill_none: make every default None ("not given"), so that get_combined_args can tell what the user typed.
    without: options that this command does not get, because they would have no effect.
    """

    def __init__(
        self, parser: argparse.ArgumentParser, name: str, fill_none: bool = False, without: Collection[str] = ()
    ) -> None:
        """Add the options of this group to a parser, under the title `name`.

        fill_none: missing options get None instead of their defaults. without: names of options to leave out.
        """
        group = parser.add_argument_group(name)
        for option in self._options():
            if option.name not in without:
                option.add_to(group, fill_none)

    def _options(self) -> list[Option]:
        return [_make_option(name, value) for name, value in vars(self).items()]

    def extract(self, args: argparse.Namespace) -> GroupParams:
        """Return this group's values from `args`; absent or None means the default."""
        values = GroupParams()
        for option in self._options():
            value = getattr(args, option.name, None)
            setattr(values, option.name, option.default if value is None else value)
        return values


def _make_option(name: str, value: Any) -> Option:
    plain = name.removeprefix("_")
    return Option(plain, value, "", short=plain[0] if name.startswith("_") else None)


class OptionTable(ParamGroup):
    """A group whose options are records, with help and checks; its attributes hold the defaults.

    An attribute that other code sets to another value, or without the underscore of a short form, is an option without
    help and checks. Constructors call `_add_table`, so that `super()` of a table is ParamGroup, as in the reference.
    """

    title: ClassVar[str]
    options: ClassVar[tuple[Option, ...]]

    def _add_table(self, parser: argparse.ArgumentParser, sentinel: bool, without: Collection[str]) -> None:
        """Make the table's options attributes, and add them and the attributes that a subclass has set to the parser.

        One named like an option that we added replaces it.
        """
        taken = {name.removeprefix("_") for name in vars(self)}
        for option in self.options:
            if not (option.ours and option.name in taken):
                setattr(self, option.attribute, option.default)
        ParamGroup.__init__(self, parser, self.title, sentinel, without)

    def _options(self) -> list[Option]:
        """List the options of this group; one whose attribute has another value than the table's has no help and
        checks."""
        table = {option.attribute: option for option in self.options}
        options = []
        for name, value in vars(self).items():
            known = table.get(name)
            same = known and type(value) is type(known.default) and value == known.default
            options.append(known if same else _make_option(name, value))
        return options

    def extract(self, args: argparse.Namespace) -> GroupParams:
        """Return this group's values from `args`, defaults for missing ones. UserError for invalid values."""
        values = super().extract(args)
        for option in self._options():
            if option in self.options:
                option.verify(getattr(values, option.name))
        return values
