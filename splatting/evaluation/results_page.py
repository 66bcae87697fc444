"""Tables of the page docs/results/training.md, written from report.json.

python -m splatting.evaluation.results_page REPORT.json [REPORT.json ...] [--page docs/results/training.md]

Replaces the text between the page's two marker lines by one table for each report, in the order given.
"""

from __future__ import annotations

import os
import re
from argparse import ArgumentParser
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from splatting.evaluation.document import result_blocks
from splatting.evaluation.machine import one_line
from splatting.evaluation.pages import table_text
from splatting.files.json_files import read_json
from utils.system_utils import UserError, atomic_write, run_cli

BEGIN = "<!-- results: begin (python -m splatting.evaluation.results_page) -->"
END = "<!-- results: end -->"
PAGE = Path("docs/results/training.md")


def results_text(report: Mapping[str, Any]) -> str:
    """The table of a report, the options of its runs, and the machine and commit of its trainings."""
    parts = [block if isinstance(block, str) else table_text(block) for block in result_blocks(report["summary"])]
    options = {run["config"] or "": list(run["added_options"] or ()) for run in report["runs"]}
    if any(options.values()):
        parts.append(_options_text(options))
    if machines := sorted({one_line(run["machine"]) for run in report["runs"] if run["machine"]}):
        parts.append("\n".join(f"Machine: {machine}." for machine in machines))
    return "\n\n".join(parts)


def _options_text(options: Mapping[str, Sequence[str]]) -> str:
    """The options of train.py that all option sets share, then a list of those that each set adds."""
    shared = _shared_words(list(options.values()))
    every = f"Options of every run: `{' '.join(shared)}`." if shared else ""
    if len(options) == 1:
        return every
    added = {name: " ".join(words[len(shared) :]) for name, words in options.items()}
    listed = "\n".join(f"- {name}: `{words}`" if words else f"- {name}: nothing" for name, words in added.items())
    return "\n\n".join(filter(None, [every, "Each option set adds:", listed]))


def _shared_words(sets: Sequence[Sequence[str]]) -> Sequence[str]:
    """The longest common beginning of the sets that cuts no option from its values."""
    shared = os.path.commonprefix(sets)
    while shared and any(len(words) > len(shared) and not _is_option(words[len(shared)]) for words in sets):
        shared = shared[:-1]
    return shared


def _is_option(word: str) -> bool:
    return re.match("--?[a-zA-Z]", word) is not None


def replace_results(page: str, reports: Sequence[Mapping[str, Any]]) -> str:
    """`page` with new text between BEGIN and END.

    UserError unless each marker is there once, in this order.
    """
    if page.count(BEGIN) != 1 or page.count(END) != 1 or page.index(BEGIN) > page.index(END):
        raise UserError(
            f"the page must have one line {BEGIN} and after it one line {END}; put them where the tables go"
        )
    before, rest = page.split(BEGIN)
    after = rest.split(END)[1]
    return "\n\n".join([before + BEGIN, *(results_text(report) for report in reports), END + after])


def _read(path: Path) -> dict[str, Any]:
    try:
        report = read_json(path)
        if not report["summary"] or not report["runs"]:
            raise ValueError("nothing was scored")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is not a scored report ({error}); give the report.json of full_eval.py") from error
    return report


def main() -> None:
    parser = ArgumentParser(
        prog="python -m splatting.evaluation.results_page", description=f"Writes the tables of {PAGE}."
    )
    parser.add_argument("reports", type=Path, nargs="+", metavar="REPORT", help="report.json of full_eval.py")
    parser.add_argument("--page", type=Path, default=PAGE, help=f"file to change (default: {PAGE})")
    args = parser.parse_args()
    reports = [_read(path) for path in args.reports]
    try:
        text = args.page.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot read {args.page} ({error.strerror}); name it with --page") from error
    changed = replace_results(text, reports)
    with atomic_write(args.page) as temporary:
        temporary.write_text(changed, encoding="utf-8")


if __name__ == "__main__":
    run_cli(main)
