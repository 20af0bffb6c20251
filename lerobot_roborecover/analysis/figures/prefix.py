"""Figure of recovery against the length of the prefix."""

from __future__ import annotations

import math

from lerobot_roborecover.analysis.figures import style
from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.stats.prefix import prefix_groups


def prefix_figure(results: Results) -> style.Figure | None:
    """RSR by groups of prefix length, with intervals; None where the lengths make no groups."""
    groups = prefix_groups(results.recovery, results.draws)
    if not groups:
        return None
    names = results.recovery.arms[: style.MOST_LINES]
    apart = (groups[-1].median_steps - groups[0].median_steps) / 60 / max(1, len(names) - 1)

    def draw(width: style.Width) -> style.Plot:
        with style.drawing() as subplots:
            plot, axes = subplots(width.inches, 3.2 + 0.24 * len(names) if width.narrow else 4.2)
            for p, name in enumerate(names):
                shift = apart * (p - (len(names) - 1) / 2)  # so that intervals stand beside each other
                places = [group.median_steps + shift for group in groups]
                rates = [group.estimates[p] for group in groups]
                for x, rate in zip(places, rates, strict=True):
                    if not math.isnan(rate.low):
                        ends = [100 * rate.low, 100 * rate.high]
                        axes.plot([x, x], ends, color=style.colour(p), lw=1.4, alpha=0.6)
                look = {**style.line_style(p), "ms": 7, "label": style.short(name, width.names)}
                axes.plot(places, [100 * r.value for r in rates], lw=1.8, **look)
            axes.set(
                ylim=(0, 100), ylabel="RSR, %", xlabel="length of the prefix, steps (median of each group)"
            )
            axes.grid(axis="y", color=style.LINE, lw=0.6)
            plot.legend(loc="outside lower left" if width.narrow else "outside right upper")
        return plot

    words = "; ".join(
        f"{group.label} steps: "
        + ", ".join(
            f"{name} {style.number(100 * e.value)}" for name, e in zip(names, group.estimates, strict=False)
        )
        for group in groups
    )
    text = style.the_best(
        f"RSR in per cent by length of the prefix. {words}.", len(names), len(results.recovery.arms)
    )
    return style.Figure("prefix", "Recovery by length of the prefix", text, *style.both(draw))
