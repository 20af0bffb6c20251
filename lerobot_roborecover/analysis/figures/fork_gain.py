"""Plots the gain of an intervention against its step, over all scenarios and by cell."""

from __future__ import annotations

import math

import numpy as np

from lerobot_roborecover.analysis.figures import style
from lerobot_roborecover.analysis.stats.fork_gain import ForkGains

_COLUMNS = 3


def gain_by_step(gains: ForkGains) -> style.Figure:
    """One drawing of all forks with intervals, and one of every cell."""
    parts: list[tuple[str, str | None]] = [("All cells", None), *((cell, cell) for cell in gains.cells)]
    curves = {
        (title, arm): [(step, gains.of(arm, step=step, cell=cell)) for step in gains.steps]
        for title, cell in parts
        for arm in gains.arms
    }

    def draw(width: style.Width) -> style.Plot:
        columns = 1 if width.narrow else min(_COLUMNS, len(parts))
        lines = math.ceil(len(parts) / columns)
        with style.drawing() as subplots:
            plot, grid = subplots(
                width.inches, 0.4 + 2.4 * lines + 0.22 * len(gains.arms), nrows=lines, ncols=columns,
                sharex=True, sharey=True, squeeze=False,
            )  # fmt: skip
            for axes, (title, cell) in zip(grid.flat, parts, strict=False):
                axes.axhline(0, color=style.INK, lw=0.8)
                for a, arm in enumerate(gains.arms):
                    points = [(step, found[4]) for step, found in curves[title, arm] if found[0]]
                    steps = np.array([step for step, _ in points])
                    values = 100 * np.array([[e.value, e.low, e.high] for _, e in points]).reshape(-1, 3)
                    axes.plot(
                        steps, values[:, 0], ls=style.dash(a), color=style.colour(a),
                        marker=style.marker(a), lw=1.6, ms=4,
                        label=style.short(arm, width.names) if cell is None else None,
                    )  # fmt: skip
                    if cell is None:
                        axes.fill_between(
                            steps, values[:, 1], values[:, 2], color=style.colour(a), alpha=0.12, lw=0
                        )
                axes.set_title(style.short(title, width.names))
                axes.grid(color=style.LINE, lw=0.6)
            for axes in list(grid.flat)[len(parts) :]:
                axes.set_visible(False)
            for axes in grid[:, 0]:
                axes.set_ylabel("gain, points")
            for axes in grid[-1]:
                axes.set_xlabel("step of the trial")
            plot.legend(loc="outside lower left")
        return plot

    best = {
        arm: max(
            ((step, found[4].value) for step, found in curves["All cells", arm] if found[0]),
            key=lambda point: point[1],
        )
        for arm in gains.arms
    }
    words = "; ".join(f"{arm} {style.number(100 * v, '+.1f')} at step {s}" for arm, (s, v) in best.items())
    text = f"Recovery gain against the step of the intervention. Largest, all cells together: {words}."
    return style.Figure("fork_gain", "Gain by intervention timing", text, *style.both(draw))
