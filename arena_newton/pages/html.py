"""HTML pages made of a template: every text is escaped, and a Content-Security-Policy names all that may be loaded."""

from __future__ import annotations

import base64
import functools
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import jinja2

from arena_newton.files.text import plain

__all__ = ["EMBEDDED", "FILES", "render"]

EMBEDDED = {"img-src": "data:"}
"""Sources of a page with its pictures inside."""
FILES = {"img-src": "'self' file:"}
"""Sources of a page with pictures next to it: opened from a disk it has no origin that 'self' could mean everywhere."""


@functools.cache
def _templates(folder: Path) -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader([folder, Path(__file__).parent]),
        autoescape=True,
        finalize=lambda value: value if hasattr(value, "__html__") else plain(value),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def render(
    template: Path,
    *,
    styles: Sequence[str],
    script: str = "",
    sources: Mapping[str, str] | None = None,
    **content: object,
) -> str:
    """A page as text, the same for the same content byte for byte; it loads its own style and script and nothing else.

    Args:
        template: Shows `content`, and, by the `frame.html` next to this file, `policy`, `style` and `script`, of which
            the last two are not escaped.
        styles: Style sheets next to the template.
        script: The page's script next to the template, if it has one.
        sources: Further directives of the policy, such as `FILES`.
        content: Values by name; the template may use no other name.
    """

    def named(text: str) -> str:
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    style = "".join((template.parent / name).read_text(encoding="utf-8") for name in styles)
    code = (template.parent / script).read_text(encoding="utf-8") if script else ""
    policy = ["default-src 'none'", *map(" ".join, (sources or {}).items()), "base-uri 'none'", "form-action 'none'"]
    policy += [f"style-src {named(style)}", *([f"script-src {named(code)}"] if code else [])]
    page = _templates(template.parent).get_template(template.name)
    return page.render(policy="; ".join(policy), style=style, script=code, **content)
