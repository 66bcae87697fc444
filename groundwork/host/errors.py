"""The error that a user can fix, apart from the code that prints it: everything may import this."""


class UserError(Exception):
    """An error that the user can fix. Its text is one sentence that names the fault and the remedy."""


def first_line(error: BaseException) -> str:
    """The first line of an error's text, at most 200 characters; its type if the text is empty."""
    return next(iter(str(error).splitlines()), "")[:200] or type(error).__name__
