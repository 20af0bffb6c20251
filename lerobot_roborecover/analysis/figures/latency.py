"""The figure of RSR against latency."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lerobot_roborecover.analysis.figures import style
from lerobot_roborecover.analysis.latency import LatencyRate
from lerobot_roborecover.analysis.stats.intervals import LEVEL


def latency_figure(rates: Sequence[LatencyRate], level: float = LEVEL) -> style.Figure:
    """RSR against the latency charged; frozen clocks stand at 0, measured ones are in the table alone."""
    curves: dict[tuple[str, str], list[LatencyRate]] = {}
    for rate in rates:
        if rate.during_inference and not np.isnan(rate.latency_s):
            curves.setdefault((rate.policy, rate.during_inference), []).append(rate)
    for (policy, _), points in curves.items():
        if all(p.latency_s for p in points):
            points[:0] = [r for r in rates if r.policy == policy and not r.during_inference]

    def draw(width: style.Width) -> style.Plot:
        with style.drawing() as subplots:
            plot, axes = subplots(width.inches, 3.4 + 0.24 * len(curves) if width.narrow else 4.2)
            for k, ((policy, during_inference), points) in enumerate(curves.items()):
                x = 1e3 * np.array([p.latency_s for p in points])
                y = 100 * np.array([[p.rate.value, p.rate.low, p.rate.high] for p in points])
                name = f"{style.short(policy, width.names)}, {during_inference}"
                line = style.line_style(k)
                axes.plot(x, y[:, 0], lw=2, label=name, **line)
                axes.fill_between(x, y[:, 1], y[:, 2], color=style.colour(k), alpha=0.12, lw=0)
            axes.set(
                ylim=(0, 100),
                xlabel="latency of an inference, ms",
                ylabel=f"RSR, %, {100 * level:g} % interval",
            )
            axes.set_xlim(left=0)
            axes.grid(color=style.LINE, lw=0.6)
            plot.legend(loc="outside lower left" if width.narrow else "outside right upper")
        return plot

    words = "; ".join(
        f"{policy} ({during_inference}) "
        + ", ".join(f"{100 * p.rate.value:.1f} at {1e3 * p.latency_s:g} ms" for p in points)
        for (policy, during_inference), points in curves.items()
    )
    return style.Figure("latency", "RSR against latency", f"RSR in per cent: {words}.", *style.both(draw))
