"""Templates of pages and of programs, filled by Jinja."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import jinja2


def make_templates(*folders: Path, html: bool = True) -> jinja2.Environment:
    """The templates of some folders.

    Args:
        *folders: searched in this order.
        html: whether they are pages, in which all values are escaped; else they are kept to the
            byte.
    """
    import jinja2  # not for `--help`

    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(folders), autoescape=html, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=not html,
    )  # fmt: skip


def data_address(data: bytes, kind: str) -> str:
    """An address that holds a file's bytes, such as of kind "image/png", for a page."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
