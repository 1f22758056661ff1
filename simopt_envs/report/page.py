"""One self-contained HTML page, made of sections: each a template with what it shows."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

_MEDIA = {".png": "image/png", ".gif": "image/gif", ".svg": "image/svg+xml", ".mp4": "video/mp4"}


@dataclass(frozen=True)
class Section:
    """A part of a page.

    Attributes:
        title: its heading; empty for none.
        template: file in the folder ``templates``.
        content: what the template shows, by name.
    """

    title: str
    template: str
    content: Mapping[str, Any] = field(default_factory=dict)


def write_page(path: str | Path, title: str, subtitle: str, sections: Sequence[Section]) -> Path:
    """Write sections as one HTML file without external resources."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("simopt_envs.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    bodies = [
        (section.title, Markup(environment.get_template(section.template).render(**section.content)))
        for section in sections
    ]
    html = environment.get_template("page.html").render(title=title, subtitle=subtitle, sections=bodies)
    Path(path).write_text(html, encoding="utf-8")
    return Path(path)


def data_uri(content: bytes, suffix: str) -> str:
    """An image or film, of the kind that its file's suffix says, as a URI that carries it."""
    return f"data:{_MEDIA[suffix]};base64,{base64.b64encode(content).decode()}"
