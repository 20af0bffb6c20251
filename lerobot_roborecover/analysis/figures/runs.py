"""The figure of methods with several runs."""

from __future__ import annotations

import math

import numpy as np

from lerobot_roborecover.analysis.figures import style
from lerobot_roborecover.analysis.results import Results


def runs_figure(results: Results) -> style.Figure:
    """Every run's rate as a dot, the mean of the method with its interval for other runs."""
    found = results.method_rates
    order = sorted(
        range(len(found)), key=lambda p: found[p].other_runs.value if len(found[p].each) > 1 else -1
    )
    level = f"{100 * results.draws.level:g} % interval"

    def draw(width: style.Width) -> style.Plot:
        with style.drawing() as subplots:
            plot, axes = subplots(width.inches, 0.9 + style.row_height(width, 0.46) * len(order))
            for y, p in enumerate(order):
                m, shade = found[p], style.colour(p)
                values = [100 * e.value for e in m.each]
                mean = float(np.mean(values))
                if not math.isnan(m.other_runs.low):
                    axes.plot([100 * m.other_runs.low, 100 * m.other_runs.high], [y, y], color=shade, lw=3)
                axes.plot([mean, mean], [y - 0.18, y + 0.18], color=shade, lw=2.5)
                axes.plot(values, [y - 0.26] * len(values), "o", color=shade, mfc=style.PAPER, ms=6)
            style.name_rows(axes, [style.short(found[p].method, width.names) for p in order], width)
            axes.set(xlim=(-1, 101), ylim=(-0.6, len(order) - 0.15))
            texts = f"RSR, %, with {level} for other runs", "dots: runs"
            axes.set_xlabel(("\n" if width.narrow else "; ").join(texts))
            axes.grid(axis="x", color=style.LINE, lw=0.6)
            axes.set_axisbelow(True)
            axes.spines["left"].set_visible(False)
        return plot

    words = "; ".join(
        f"{found[p].method}: {', '.join(f'{100 * e.value:.1f}' for e in found[p].each)}"
        for p in reversed(order)
    )
    return style.Figure(
        "runs", "Runs of each method", f"RSR of every run in per cent. {words}.", *style.both(draw)
    )
