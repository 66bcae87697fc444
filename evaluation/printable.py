"""Text for programs that take only letters: names of files may have bytes that are none."""


def printable(text: str) -> str:
    """Return the text with the bytes of a file name that are not UTF-8 written as numbers, `\\udcff`."""
    return text.encode("utf-8", "backslashreplace").decode()
