"""Renders a page as one HTML document with inline style and script.

The Content-Security-Policy of the document forbids requests to other hosts.
"""

from __future__ import annotations

import base64
import hashlib
import json
from dataclasses import asdict
from functools import cache
from importlib import resources

import jinja2

from pathreplay.report.pages.page import Page


@cache
def _file(name: str) -> str:
    return resources.files("pathreplay.report.pages").joinpath(name).read_text(encoding="utf-8")


@cache
def template(name: str) -> jinja2.Template:
    """Load a template of this package. Inserted texts are escaped."""
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_file),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)


def document(page: Page, live: bool = False) -> bytes:
    """Render the page as HTML in UTF-8.

    A ``live`` page, which `watch` serves, polls for updates and has a button to stop the run. A saved page contains its
    content security policy. For a live page, the server sends the policy in a header.
    """
    html = template("page.html.j2").render(
        page=page, live=live, policy="" if live else policy("data:"), data=_data(page, live),
        style=_file("page.css"), script=_file("page.js"),
    )  # fmt: skip
    return html.encode("utf-8", "replace")


def policy(pictures: str, connect: str = "'none'") -> str:
    """Return a Content-Security-Policy that allows only this package's style and script, and the given sources.

    Args:
        pictures: allowed sources of images.
        connect: allowed targets of requests by the script.
    """
    rules = {
        "default-src": "'none'",
        "script-src": _hash("page.js"),
        "style-src": _hash("page.css"),
        "img-src": pictures,
        "connect-src": connect,
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())


def _hash(name: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(_file(name).encode()).digest()).decode()}'"


def _data(page: Page, live: bool) -> str:
    """Return the data for the script as JSON that cannot close the enclosing HTML element."""
    data = {
        "live": live,
        "exposure": page.exposure,
        "left": page.left,
        "right": page.right,
        "views": [
            {"name": v.name, "stored": v.stored, "own": v.own, "film": [asdict(s) for s in v.film]} for v in page.views
        ],
        "plots": [asdict(plot) for plot in page.plots],
        "parameters": [
            {"film": [asdict(s) for s in p.film], "mesh": None if p.mesh is None else asdict(p.mesh)}
            for p in page.parameters
        ],
    }
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
