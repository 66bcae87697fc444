"""Callbacks of controls that must not run two at a time."""

from collections.abc import Callable
from typing import Any


def in_turn(call: Callable[[Any], object]) -> Callable[[Any], Any]:
    """A coroutine for a call, because viser runs those one after the other, and plain functions in many threads."""

    async def called(event: Any) -> None:
        call(event)

    return called
