"""How figures look: colours that colour-blind readers can tell apart, a second cue beside them, two widths.

Every figure is drawn twice, as wide as the page and as narrow as a phone; a drawing shrunk to a phone's width
cannot be read. The SVG files carry a second set of colours for readers whose screen is dark.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from lerobot_roborecover.analysis.figures.glyphs import drawable, families
from lerobot_roborecover.analysis.tables import NOT_DEFINED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as _Plot
    from matplotlib.typing import RcKeyType

type Plot = _Plot
"""A matplotlib figure."""

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#7f5f00")
"""Okabe and Ito's palette, dark ones first."""
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES = ("-", "--", "-.", ":")
INK, SOFT, LINE = "#1a1a1a", "#595959", "#c8c8c8"
MOST_ROWS = 40
"""Policies that a figure with a row each shows, the best first; its table has all."""
MOST_LINES = 16
"""Policies that a figure with a line each shows, the best first: more lines cannot be told apart."""
PAPER = "#ffffff"
"""What hollow marks are filled with: the page."""
PALE = "#e5e5e5"
"""Of bars that stand for nothing gained."""
ON_COLOUR = "#fffffe"
"""Of text on a coloured field, which stays as it is on a dark page."""
ON_LIGHT = "#1b1b1b"
"""The same on a light field."""
HEAT = "cividis"
"""Perceptually even, the same order in grey, and for colour-blind readers."""
_DARK = {
    INK: "#e9ecef",
    SOFT: "#a9b1ba",
    LINE: "#3d444c",
    PAPER: "#14171a",
    PALE: "#333a42",
    "#0072b2": "#4da6e0",
    "#d55e00": "#f0883a",
    "#009e73": "#2dbb91",
    "#cc79a7": "#e29cc4",
    "#e69f00": "#f2b53d",
    "#56b4e9": "#a2d7f7",
    "#000000": "#ffffff",
    "#7f5f00": "#c2a54f",
}
"""A dark page's colour for each of the figures' own."""

_RC: dict[RcKeyType, Any] = {
    "font.family": "sans-serif",
    "font.size": 10.5,
    "text.color": INK,
    "axes.edgecolor": LINE,
    "axes.labelcolor": SOFT,
    "axes.labelsize": 9.5,
    "axes.facecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "xtick.color": SOFT,
    "xtick.labelsize": 9.5,
    "ytick.color": INK,
    "ytick.major.size": 0,
    "figure.dpi": 100,
    "savefig.facecolor": "none",
    "svg.hashsalt": "roborecover",
    "svg.fonttype": "path",
    "legend.frameon": False,
    "legend.fontsize": 9.5,
    "lines.solid_capstyle": "round",
}


@dataclass(frozen=True)
class Width:
    """How wide a figure is drawn, and what follows from it."""

    name: str
    inches: float
    names: int
    """Most characters of a policy's name."""

    @property
    def narrow(self) -> bool:
        """Whether names stand above their rows and not beside them."""
        return self is NARROW


WIDE = Width("wide", 11.4, 34)
"""As wide as the page: 1094 pixels."""
NARROW = Width("narrow", 3.6, 30)
"""As wide as a phone: 346 pixels."""


@dataclass(frozen=True)
class Figure:
    """A figure; `plot` is a matplotlib figure as wide as the page."""

    name: str
    """File name without ending."""
    title: str
    description: str
    """What it shows, in words, for readers who do not see it."""
    plot: Plot
    narrow: Plot | None = None
    """The same for a phone; None where it is narrow enough already."""


def both(draw: Callable[[Width], Plot]) -> tuple[Plot, Plot]:
    """A drawing of either width."""
    return draw(WIDE), draw(NARROW)


@contextmanager
def drawing() -> Generator[Callable[..., tuple[Plot, Any]]]:
    """matplotlib's `subplots` under the report's style, without a display: of width and height in inches and
    its own options, the figure and its axes, one or an array of them."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    def subplots(width: float, height: float, **kwargs: Any) -> tuple[Plot, Any]:
        plot = Canvas(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(plot)
        return plot, plot.subplots(**kwargs)

    with matplotlib.rc_context(_rc()):
        yield subplots


def name_rows(axes: Axes, names: Sequence[str], width: Width) -> None:
    """Names of the rows y = 0, 1, ...: beside them, or above them where the figure is narrow."""
    if not width.narrow:
        axes.set_yticks(range(len(names)), names)
        return
    axes.set_yticks([])
    for y, name in enumerate(names):
        axes.annotate(
            name, (0, y), (0, 9), xycoords=("axes fraction", "data"), textcoords="offset points", fontsize=9.5
        )


def row_height(width: Width, wide: float = 0.36) -> float:
    return 0.52 if width.narrow else wide


def colour(index: int) -> str:
    """Colour of policy `index`."""
    return COLOURS[index % len(COLOURS)]


def marker(index: int) -> str:
    """Marker of policy `index`; shifted against the colours, so that pairs repeat late."""
    return MARKERS[(index + index // len(COLOURS)) % len(MARKERS)]


def dash(index: int) -> str:
    """Line style of policy `index`."""
    return DASHES[(index + index // len(COLOURS)) % len(DASHES)]


def line_style(index: int) -> dict[str, str]:
    """Colour, line style and marker of policy `index`, as matplotlib takes them."""
    return {"color": colour(index), "ls": dash(index), "marker": marker(index)}


def short(name: str, limit: int = 28) -> str:
    """A name that fits a figure; matplotlib must not read its dollars as mathematics."""
    return (name if len(name) <= limit else f"{name[: limit - 1]}…").replace("$", r"\$")


def the_best(text: str, shown: int, of: int) -> str:
    """A figure's description, which says so where not all policies are shown."""
    return text if shown >= of else f"{text} The best {shown} of {of} policies."


def number(value: float, spec: str = ".0f") -> str:
    """A value in words; n/a where it is not defined."""
    return NOT_DEFINED if math.isnan(value) else format(value, spec)


def _rc() -> dict[RcKeyType, Any]:
    return {**_RC, "font.sans-serif": families()}


def _lay_out(plot: Plot) -> None:
    """Makes room for the texts, once: every file of a drawing then has the same places."""
    if (engine := plot.get_layout_engine()) is not None:
        _make_drawable(plot)
        engine.execute(plot)
        plot.set_layout_engine("none")


def _make_drawable(plot: Plot) -> None:
    """Replaces characters that no font has; labels of axes are set again so that they keep the new text."""
    from matplotlib.text import Text

    for axes in plot.axes:
        for axis in (axes.xaxis, axes.yaxis):
            labels = [label.get_text() for label in axis.get_ticklabels()]
            if any(drawable(label) != label for label in labels):
                axis.set_ticks(axis.get_ticklocs(), [drawable(label) for label in labels])
    for text in plot.findobj(Text):
        if isinstance(text, Text) and drawable(text.get_text()) != text.get_text():
            text.set_text(drawable(text.get_text()))


def svg_of(plot: Plot) -> bytes:
    """SVG of a plot, for light and dark pages; the same plot gives the same bytes.

    The file's own colours are the light ones, which every program shows; browsers with a dark screen take
    the rule that replaces them.
    """
    import io

    import matplotlib

    data = io.BytesIO()
    with matplotlib.rc_context(_rc()):
        _lay_out(plot)
        plot.savefig(data, format="svg", metadata={"Date": None, "Creator": None})
    rules = "".join(
        f'[style*="{what}: {light}"],[{what}="{light}"]{{{what}:{dark}!important}}'
        for light, dark in _DARK.items()
        for what in ("fill", "stroke")
    )
    style = f"<style>@media screen and (prefers-color-scheme:dark){{{rules}}}</style>".encode()
    text = data.getvalue()
    end = text.index(b">", text.index(b"<svg")) + 1
    return text[:end] + style + text[end:]


def png_of(plot: Plot) -> bytes:
    """PNG of a plot on white; the same plot gives the same bytes."""
    import io

    import matplotlib

    data = io.BytesIO()
    with matplotlib.rc_context(_rc()):
        _lay_out(plot)
        plot.savefig(data, format="png", dpi=120, facecolor=PAPER, metadata={"Software": None})
    return data.getvalue()


def render(figure: Figure) -> tuple[bytes, bytes]:
    """SVG and PNG of a figure as wide as the page."""
    return svg_of(figure.plot), png_of(figure.plot)
