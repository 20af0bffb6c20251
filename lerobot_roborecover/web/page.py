"""Files of a page: those of its own package, and the looks that all pages share."""

from __future__ import annotations

from importlib.resources import files
from pathlib import PurePath

from starlette.responses import Response

from lerobot_roborecover.web.guard import Refusal

_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
_SHARED, _BASE = "lerobot_roborecover.web", "base.css"


class PageFiles:
    """What a page consists of; nothing else is served.

    Args:
        package: holds the files in its folder `page`, `index.html` and `style.css` among them.
        scripts: names of the others.
    """

    def __init__(self, package: str, *scripts: str):
        own = dict.fromkeys(("index.html", "style.css", *scripts), package)
        self._owner = {**own, _BASE: _SHARED}

    def response(self, name: str) -> Response:
        """A file; the page itself where the name is empty.

        Raises:
            Refusal: it is none of the page's.
        """
        name = name or "index.html"
        if name not in self._owner:
            raise Refusal(404, "there is no such file")
        data = files(self._owner[name]).joinpath("page", name).read_bytes()
        return Response(data, media_type=_TYPES[PurePath(name).suffix])
