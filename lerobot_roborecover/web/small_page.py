"""What a browser shows where there is no page: a few words instead of a JSON object.

Requests of scripts and of the pages themselves are answered in JSON as before.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Mapping
from typing import Any

_STYLE = (
    "body{margin:12vh auto;max-width:38rem;padding:0 1.2rem;background:#0d1117;color:#f4f7fa;"
    "font:18px/1.5 system-ui,'Segoe UI',Roboto,'DejaVu Sans',sans-serif}"
    "h1{font-size:1.3rem}p{color:#b6c2cf}code{color:#f4f7fa;overflow-wrap:anywhere}"
)
_HASH = base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode()
POLICY = (
    f"default-src 'none'; img-src data:; style-src 'sha256-{_HASH}'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
"""Content-Security-Policy of a small page."""
_TITLES = {
    403: "This address needs its token",
    404: "There is no page at this address",
    421: "This is another address than the server's",
}
_ADVICE = (
    "Each person has an address of their own, with a token. The command that serves the page has printed it "
    "in its terminal; copy it whole. It looks like <code>http://127.0.0.1:8731/NAME/?token=…</code> and "
    "stays valid when the same command is started again."
)


def wants_page(scope: Mapping[str, Any]) -> bool:
    """Whether a request comes from a browser's address bar."""
    if scope["type"] != "http" or scope["method"] not in ("GET", "HEAD"):
        return False
    accepted = b",".join(v for k, v in scope["headers"] if k == b"accept")
    return b"text/html" in accepted


def small_page(status: int, body: bytes) -> bytes:
    """A page for an answer that is none.

    Args:
        status: of the answer.
        body: of the answer; where it is a JSON object with `error`, that is shown.
    """
    try:
        said = str(json.loads(body)["error"])
    except (ValueError, KeyError, TypeError, RecursionError):
        said = ""
    title = _TITLES.get(status, "This cannot be shown")
    told = re.sub(r"`([^`]*)`", r"<code>\1</code>", html.escape(said[:1].upper() + said[1:]))
    told = f"<p>{told}.</p>" if said else ""
    advice = f"<p>{_ADVICE}</p>" if status in _TITLES else ""
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>RoboRecover: {title}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">'
        f"<style>{_STYLE}</style></head><body><h1>{title}</h1>{told}{advice}</body></html>"
    ).encode()
