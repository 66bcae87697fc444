"""Facts that have to be the same on all ranks."""

from collections.abc import Mapping, Sequence

from splatting.files.listing import some
from splatting.host.errors import UserError

_SHORT = 60  # letters of a value that a message shows


def refuse_differences(facts: Sequence[Mapping[str, str]], remedy: str, shown: bool = True) -> None:
    """UserError that names the facts by which ranks differ from rank 0, and these ranks.

    facts: by rank, the values by name. shown: with the values of one of these ranks.
    """
    first = facts[0]
    for rank, others in enumerate(facts):
        names = [name for name in {**first, **others} if first.get(name) != others.get(name)]
        if names:
            raise UserError(
                f"rank {rank} differs from rank 0 in {some(_described(names, first, others, shown))}; {remedy}"
            )


def _described(names: Sequence[str], first: Mapping[str, str], other: Mapping[str, str], shown: bool) -> list[str]:
    if not shown:
        return list(names)
    return [f"{name} ({_short(other.get(name))}, not {_short(first.get(name))})" for name in names]


def _short(value: str | None) -> str:
    return "nothing" if value is None else value if len(value) <= _SHORT else value[:_SHORT] + "..."
