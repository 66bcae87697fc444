"""A remedy where a training is too short for the windows of its schedule."""


def for_few_iterations(count: int) -> str:
    """Options by which so many iterations go through the whole schedule."""
    return f"--schedule {count} in place of --iterations {count}"
