"""Figure of retries: success against the steps that attempts take together."""

from __future__ import annotations

import numpy as np

from lerobot_roborecover.analysis.figures import style
from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.retry_tables import retried
from lerobot_roborecover.analysis.stats.resampling import masked_mean
from lerobot_roborecover.analysis.stats.retries import ATTEMPTS, rates_for_steps


def retries(results: Results) -> style.Figure | None:
    """Success with retries against steps; None where every scenario has one trial."""
    every = [one.attempts for one in retried(results) if one.attempts.most > 1][: style.MOST_LINES]
    if not every:
        return None
    most = min(max(one.most for one in every), ATTEMPTS[-1])
    grid = np.linspace(0, most, 20 * most + 1)
    curves = [masked_mean(rates_for_steps(one, grid)) for one in every]

    def draw(width: style.Width) -> style.Plot:
        with style.drawing() as subplots:
            plot, axes = subplots(width.inches, 3.4 + 0.24 * len(every) if width.narrow else 4.2)
            for p, (one, curve) in enumerate(zip(every, curves, strict=True)):
                line = style.line_style(p)
                axes.plot(
                    grid, 100 * curve, lw=2, label=style.short(one.title, width.names), markevery=20, **line
                )
            steps = "steps of all attempts, in horizons of the scenario"
            axes.set(xlim=(0, most), ylim=(0, 100), xlabel=steps, ylabel="recovered, %")
            axes.set_xticks(range(most + 1))
            axes.grid(color=style.LINE, lw=0.6)
            plot.legend(loc="outside lower left" if width.narrow else "outside right upper")
        return plot

    words = "; ".join(
        f"{one.title} {style.number(100 * curve[20])} with one attempt, "
        f"{style.number(100 * curve[20 * one.most if one.most < most else -1])} with {min(one.most, most)}"
        for one, curve in zip(every, curves, strict=True)
    )
    text = f"Recovered scenarios in per cent against the steps of all attempts: {words}."
    return style.Figure("retries", "What a retry is worth", text, *style.both(draw))
