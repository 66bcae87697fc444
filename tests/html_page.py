"""An exported page, read by Python's own parser."""

import base64
import gzip
from html.parser import HTMLParser
from pathlib import Path


class Page(HTMLParser):
    """Elements of a page: their attributes, and the text of those with an id and of title and style."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.texts: dict[str, str] = {}
        self.comments = ""
        self._open = ""
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self._open = dict(attrs).get("id", tag)

    def handle_endtag(self, tag):
        self._open = ""

    def handle_comment(self, data):
        self.comments += data

    def handle_data(self, data):
        self.texts[self._open] = self.texts.get(self._open, "") + data

    def unpacked(self, name: str) -> bytes:
        return gzip.decompress(base64.b64decode(self.texts[name]))
