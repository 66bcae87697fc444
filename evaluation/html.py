"""The report as one self-contained HTML file, with embedded figures, and one script, for sliders over pictures."""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

import jinja2
from PIL import Image

from evaluation.blocks import Comparison, Link, Picture, Quote, Section, Table

_PHOTOGRAPHIC = 1 << 18  # bytes of a PNG above which a JPEG replaces it
_QUALITY = 90


def data_uri(path: Path) -> str:
    """Return a figure as a data: URI; large ones become JPEG."""
    content, kind = path.read_bytes(), "png"
    if len(content) > _PHOTOGRAPHIC:
        buffer = io.BytesIO()
        with Image.open(path) as image:
            image.convert("RGB").save(buffer, "JPEG", quality=_QUALITY)
        content, kind = buffer.getvalue(), "jpeg"
    return _uri(content, kind)


def _uri(content: bytes, kind: str = "jpeg") -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def to_html(title: str, sections: Sequence[Section]) -> str:
    """Render the whole page."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"data_uri": data_uri, "jpeg": _uri, "url": lambda path: quote(os.fsencode(path))}
    kinds = (Table, Picture, Quote, Link, Comparison)
    environment.tests |= {kind.__name__.lower(): lambda value, kind=kind: isinstance(value, kind) for kind in kinds}
    return environment.get_template("report.html.jinja").render(title=title, sections=sections)
