"""The writer that train.py gives to code of the reference, and what a report writes by one."""

from typing import Any

from splatting.parts.tensorboard.event_writer import EventWriter
from splatting.parts.tensorboard.events import Events

report_to = Events


def summary_writer(folder: str) -> Any | None:
    """A SummaryWriter of torch; None without TensorBoard."""
    try:
        return EventWriter(folder)
    except ImportError:
        return None  # doctor.py says so
