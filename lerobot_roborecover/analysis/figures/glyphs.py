"""Texts of figures that every font here can draw: matplotlib would show a box for each other character.

An installed font for Chinese, Japanese and Korean is used where there is one. A character that no font has
stands by its number in Unicode, such as [U+6D4B U+8BD5]; tables and pages beside the figure have the name.
"""

from __future__ import annotations

import logging
import re
from functools import cache

_FALLBACKS = (
    "Noto Sans CJK SC", "Noto Sans CJK JP", "Noto Sans CJK TC", "Noto Sans CJK KR", "Noto Sans SC",
    "Noto Sans JP", "Noto Sans KR", "Source Han Sans SC", "Source Han Sans", "WenQuanYi Zen Hei",
    "WenQuanYi Micro Hei", "Droid Sans Fallback", "IPAexGothic", "IPAGothic", "TakaoGothic", "NanumGothic",
    "Baekmuk Gulim", "PingFang SC", "PingFang HK", "Hiragino Sans", "Hiragino Sans GB",
    "Apple SD Gothic Neo", "Microsoft YaHei", "SimHei", "Yu Gothic", "MS Gothic", "Malgun Gothic",
    "Arial Unicode MS",
)  # fmt: skip
_SHOWN = 4
"""Most characters of a run that are given by number."""


@cache
def families() -> list[str]:
    """Returns the fonts of figures, in the order in which they are asked for a character."""
    from matplotlib import font_manager

    installed = set(font_manager.get_font_names())
    return ["DejaVu Sans", *(name for name in _FALLBACKS if name in installed)]


@cache
def _drawn() -> frozenset[int]:
    from matplotlib import font_manager

    found: set[int] = set()
    for name in families():
        path = font_manager.findfont(name)
        try:
            found.update(font_manager.get_font(path).get_charmap())
        except (OSError, RuntimeError) as err:  # a damaged font file
            logging.getLogger(__name__).warning("the font %s cannot be read: %s", path, err)
    return frozenset(found)


def drawable(text: str) -> str:
    """Returns a text whose characters the fonts have, the others by their numbers."""
    if text.isascii():
        return text
    missing = {c for c in text if not c.isspace() and ord(c) not in _drawn()}
    if not missing:
        return text
    return re.sub(f"[{re.escape(''.join(sorted(missing)))}]+", lambda run: _numbers(run[0]), text)


def _numbers(run: str) -> str:
    listed = " ".join(f"U+{ord(c):04X}" for c in run[:_SHOWN])
    return f"[{listed} and {len(run) - _SHOWN} more]" if len(run) > _SHOWN else f"[{listed}]"
