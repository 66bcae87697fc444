"""The parser of train.py: `-h` shows the options that most people need, and `--help-all` all of them, by topic."""

import argparse
from typing import Any

from arguments.option import MOST_NEEDED, NUMBERS, TOPICS
from arguments.param_group import OptionParser


class _HelpAll(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        parser.shows_all = True  # type: ignore[attr-defined]
        parser.print_help()
        parser.exit()


class TopicParser(OptionParser):
    """A parser whose help has the topics of options (arguments/option.py) as groups."""

    lists_all = "--help-all"
    shows_all = False

    def __init__(self, **more: Any) -> None:
        """Make the parser with its options of help, which are among those MOST_NEEDED."""
        super().__init__(**more)
        nowhere = {"dest": argparse.SUPPRESS, "default": argparse.SUPPRESS}
        action = self.add_argument(
            self.lists_all, action=_HelpAll, nargs=0, **nowhere, help="show all options and exit"
        )
        action.ours = True  # type: ignore[attr-defined]  # so that --he is still --help
        for action in self._actions:
            action.topic = MOST_NEEDED  # type: ignore[attr-defined]

    def by_topic(self) -> dict[str, list[argparse.Action]]:
        """All options by their topic."""
        found: dict[str, list[argparse.Action]] = {topic: [] for topic in TOPICS}
        for action in self._actions:
            found[getattr(action, "topic", NUMBERS)].append(action)
        return found

    def format_help(self) -> str:
        """Return the help text by topics: all options, or those most needed and the names of the other topics."""
        formatter = self._get_formatter()
        formatter.add_usage(self.usage, self._actions, self._mutually_exclusive_groups)
        formatter.add_text(self.description)
        groups = self.by_topic()
        for topic in TOPICS if self.shows_all else (MOST_NEEDED,):
            formatter.start_section(topic)
            formatter.add_arguments(groups[topic])
            formatter.end_section()
        if not self.shows_all:
            formatter.start_section(f"more options, listed by {self.lists_all}")
            others = [(topic, about) for topic, about in TOPICS.items() if topic != MOST_NEEDED]
            formatter.add_arguments([argparse.Action([], topic, help=about) for topic, about in others])
            formatter.end_section()
        formatter.add_text(self.epilog)
        return formatter.format_help()
