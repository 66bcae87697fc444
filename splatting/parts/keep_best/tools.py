"""What reports say of a model that was chosen by validation views, and when to choose one."""

from collections.abc import Mapping, Sequence
from typing import Any


def remarks(lines: Sequence[str]) -> list[str]:
    """Lines of a training that belong beside its scores."""
    return [line for line in lines if line.startswith("--keep_best")]


def against_overfitting(record: Mapping[str, Any]) -> str | None:
    """The option that saves the best model; None if it was given. record: the last of train_log.json."""
    return None if "kept_iteration" in record else "--keep_best"
