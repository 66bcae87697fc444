"""What other parts and commands ask of schedules by the clock, or of another length."""

import argparse


def for_few_iterations(count: int) -> str:
    """Options by which so many iterations go through the whole schedule."""
    return f"--schedule {count} in place of --iterations {count}"


def continues(opt: argparse.Namespace) -> bool | None:
    """Whether the same options train a finished training further, None: --iterations says so."""
    return bool(opt.time_budget) if opt.time_budget or opt.schedule else None
