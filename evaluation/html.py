"""The report as one self-contained HTML file, with embedded figures and without scripts."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from pathlib import Path

import jinja2
from PIL import Image

from evaluation.document import Picture, Quote, Section, Table

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
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def to_html(title: str, sections: Sequence[Section]) -> str:
    """Render the whole page."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["data_uri"] = data_uri
    environment.tests |= {
        kind.__name__.lower(): lambda value, kind=kind: isinstance(value, kind) for kind in (Table, Picture, Quote)
    }
    return environment.get_template("report.html.jinja").render(title=title, sections=sections)
