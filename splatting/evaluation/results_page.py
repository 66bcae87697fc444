"""Tables of the page docs/results/training.md, written from report.json.

python -m splatting.evaluation.results_page REPORT.json [REPORT.json ...] [--page docs/results/training.md]

Replaces the text between the page's two marker lines by one table for each report, in the order given.
"""

from __future__ import annotations

import os
from argparse import ArgumentParser
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from splatting.evaluation.comparison import with_values
from splatting.evaluation.report import markdown
from splatting.evaluation.tables import result_tables
from splatting.files.json_files import read_json
from splatting.host.machine import one_line
from utils.system_utils import UserError, atomic_write, run_cli

BEGIN = "<!-- results: begin (python -m splatting.evaluation.results_page) -->"
END = "<!-- results: end -->"
PAGE = Path("docs/results/training.md")


def results_text(report: Mapping[str, Any]) -> str:
    """The table of a report, the options of its runs, and the machine and commit of its trainings."""
    parts = [text for table in result_tables(report["summary"]) for text in (table.title, str(markdown(table))) if text]
    options = {run["config"] or "": list(run["added_options"] or ()) for run in report["runs"]}
    if any(options.values()):
        parts += _options_text(options)
    if machines := sorted({one_line(run["machine"]) for run in report["runs"] if run["machine"]}):
        parts.append("\n".join(f"Machine: {machine}." for machine in machines))
    return "\n\n".join(parts)


def _options_text(options: Mapping[str, Sequence[str]]) -> list[str]:
    """The options of train.py that all option sets begin with, then a list of those that each set adds."""
    # An option and its values are one part: a common beginning must not cut them.
    sets = {name: with_values(words) for name, words in options.items()}
    shared = os.path.commonprefix(list(sets.values()))
    added = {name: " ".join(parts[len(shared) :]) for name, parts in sets.items()}
    text = [f"Options of every run: `{' '.join(shared)}`."] if any(shared) else []
    if len(options) > 1:
        listed = [f"- {name}: `{words}`" if words else f"- {name}: nothing" for name, words in added.items()]
        text += ["Each option set adds:", "\n".join(listed)]
    return text


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
