"""README's table of results, from report.json.

python -m evaluation.readme_table REPORT.json [REPORT.json ...] [--readme README.md]

Replaces what stands between the two marker lines of the README by a table for each report, in their order.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from evaluation.document import results_table
from evaluation.machine import one_line
from utils.files.json_files import read_json
from utils.files.markdown_table import markdown_table
from utils.system_utils import UserError, atomic_write, run_cli

BEGIN = "<!-- results: begin (python -m evaluation.readme_table) -->"
END = "<!-- results: end -->"


def results_text(report: Mapping[str, Any]) -> str:
    """The table of a report, the options of its option sets, and where it was trained."""
    table = results_table(report["summary"])
    lines = [markdown_table(table.header, table.rows)]
    options = {run["config"] or "options": " ".join(run["added_options"] or ()) for run in report["runs"]}
    if any(options.values()):
        lines.append(
            "; ".join(f"{name}: `{words}`" if words else f"{name}: defaults" for name, words in options.items())
        )
    if machines := sorted({one_line(run["machine"]) for run in report["runs"] if run["machine"]}):
        lines.append("; ".join(machines))
    return "\n\n".join(lines)


def replace_results(readme: str, reports: Sequence[Mapping[str, Any]]) -> str:
    """`readme` with new text between BEGIN and END. UserError where they are not there once each, in this order."""
    if readme.count(BEGIN) != 1 or readme.count(END) != 1 or readme.index(BEGIN) > readme.index(END):
        raise UserError(
            f"the README must have one line {BEGIN} and after it one line {END}; put them where the table goes"
        )
    before, rest = readme.split(BEGIN)
    after = rest.split(END)[1]
    return "\n\n".join([before + BEGIN, *(results_text(report) for report in reports), END + after])


def _read(path: Path) -> dict[str, Any]:
    try:
        report = read_json(path)
        if not report["summary"] or not report["runs"]:
            raise ValueError("nothing was scored")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is no report with results ({error}); give the report.json of full_eval.py") from error
    return report


def main() -> None:
    parser = ArgumentParser(prog="python -m evaluation.readme_table", description="README's table of results.")
    parser.add_argument("reports", type=Path, nargs="+", metavar="REPORT", help="report.json of full_eval.py")
    parser.add_argument("--readme", type=Path, default=Path("README.md"), help="file to change (README.md)")
    args = parser.parse_args()
    reports = [_read(path) for path in args.reports]
    try:
        text = args.readme.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot read {args.readme} ({error.strerror}); name it with --readme") from error
    changed = replace_results(text, reports)
    with atomic_write(args.readme) as temporary:
        temporary.write_text(changed, encoding="utf-8")


if __name__ == "__main__":
    run_cli(main)
