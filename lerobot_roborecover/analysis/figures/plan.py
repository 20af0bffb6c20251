"""The figure of a plan: the least difference that a set separates, by its scenarios."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lerobot_roborecover.analysis.figures import style
from lerobot_roborecover.analysis.stats.power import PowerAssumptions, detectable


def detectable_figure(
    guess: PowerAssumptions,
    trials: Sequence[int],
    wanted: float,
    level: float,
    family: int,
    *,
    at: int | None = None,
    differences: Sequence[float] = (),
) -> style.Figure:
    """The least difference against the number of scenarios, a line for each number of trials.

    Args:
        guess: of the policies.
        trials: of a scenario.
        wanted: power.
        level: confidence level.
        family: pairs that p is adjusted for.
        at: scenarios of the set at hand.
        differences: that are planned for.
    """
    counts = np.unique(np.geomspace(10, 1000, 60).round().astype(int))
    lines = {k: [100 * detectable(guess, int(n), k, wanted, level, family) for n in counts] for k in trials}

    def draw(width: style.Width) -> style.Plot:
        with style.drawing() as subplots:
            plot, axes = subplots(width.inches, 4.2 if not width.narrow else 3.6)
            for i, (k, values) in enumerate(lines.items()):
                label = f"{k} trial" + "s" * (k > 1)
                axes.plot(
                    counts,
                    values,
                    style.DASHES[i % len(style.DASHES)],
                    color=style.colour(i),
                    lw=2,
                    label=label,
                )
            for d in differences:
                axes.axhline(100 * d, color=style.LINE, lw=1)
            if at is not None:
                axes.axvline(at, color=style.SOFT, lw=1)
                axes.annotate(f"{at}", (at, 1), (3, -10), xycoords=("data", "axes fraction"),
                              textcoords="offset points", color=style.SOFT, fontsize=9)  # fmt: skip
            axes.set_xscale("log")
            ticks = [10, 20, 50, 100, 200, 500, 1000]
            axes.set_xticks(ticks, [str(t) for t in ticks])
            axes.minorticks_off()
            axes.set(xlim=(10, 1000), ylim=(0, None), xlabel="scenarios")
            axes.set_ylabel(f"least difference, points, at {100 * wanted:g} % power")
            axes.legend(title="per scenario")
            axes.grid(color=style.LINE, lw=0.4)
            axes.set_axisbelow(True)
        return plot

    shown = {k: dict(zip(counts.tolist(), values, strict=True)) for k, values in lines.items()}
    words = "; ".join(
        f"{k} trials a scenario: "
        + ", ".join(f"{n} scenarios {v:.0f}" for n, v in list(of.items())[::15] if not math.isnan(v))
        for k, of in shown.items()
    )
    return style.Figure(
        "plan", "Least difference that a set separates", f"In points. {words}.", *style.both(draw)
    )
