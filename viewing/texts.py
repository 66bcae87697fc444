"""Texts of the page."""


def as_utf8(text: str) -> str:
    """A text that can be sent: names of files that are not UTF-8 have surrogates, which appear as numbers."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
