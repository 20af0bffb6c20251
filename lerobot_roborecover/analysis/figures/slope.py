"""Slope graph: every policy's success from initial states, and from recovery points."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lerobot_roborecover.analysis.figures import style
from lerobot_roborecover.analysis.policy_tables import initial_estimates
from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.stats.intervals import Estimate

MOST_POLICIES = 12
"""Policies that the graph shows, the best at recovery first: more lines cannot be distinguished."""
_INCHES = 7.2
"""Width for a page: it stands beside videos."""
_GAP = 0.09
"""From a mark to its label, where the two axes are 1 apart."""
_TICKS = (0, 25, 50, 75, 100)
"""Per cent."""
_APART = 5.2
"""Per cent between two labels, so that they do not overlap."""


def slope(results: Results) -> style.Figure | None:
    """Initial against recovery success, with intervals; None where no ranked policy has both."""
    chosen = results.compared.policies
    rsr, initial = dict(zip(chosen, results.ranked_rates, strict=True)), initial_estimates(results)
    every = [chosen[p] for p in results.best_first if not math.isnan(initial[chosen[p]].value)]
    if not every:
        return None
    shown = every[:MOST_POLICIES]
    return slope_of(
        [results.recovery.arms[p] for p in shown], [initial[p] for p in shown], [rsr[p] for p in shown],
        of=len(every), styles=shown,
    )  # fmt: skip


def slope_of(
    names: Sequence[str],
    initial: Sequence[Estimate],
    rsr: Sequence[Estimate],
    of: int,
    styles: Sequence[int] | None = None,
) -> style.Figure:
    """Returns the graph of these policies.

    Args:
        names: of at most `MOST_POLICIES`, the best at recovery first.
        initial: success of each from initial states.
        rsr: the same from recovery points.
        of: policies that there are.
        styles: index of each one's colour and marker; by default its place.
    """
    ends = [initial, rsr]
    looks = styles or range(len(names))

    def draw(width: style.Width) -> style.Plot:
        with style.drawing() as subplots:
            plot, axes = subplots(width.inches if width.narrow else _INCHES, 4.2)
            for p, name, before, after in zip(looks, names, *ends, strict=True):
                values = [100 * before.value, 100 * after.value]
                axes.plot(
                    [0, 1], values, style.marker(p), ls="-", color=style.colour(p), lw=2.4, ms=8.5, label=name
                )
                for x, estimate in ((0, before), (1, after)):
                    if not math.isnan(estimate.low):
                        bounds = [100 * estimate.low, 100 * estimate.high]
                        axes.plot([x, x], bounds, color=style.colour(p), lw=1.4, alpha=0.55)
            limit, size, gap = (14, 8.5, "\n") if width.narrow else (22, 9.5, " ")
            places = [_spread_out([100 * e.value for e in end]) for end in ends]
            for k, (p, name) in enumerate(zip(looks, names, strict=True)):
                values = [100 * end[k].value for end in ends]
                texts = f"{_short(name, limit)}  {values[0]:.1f}", f"{values[1]:.1f}  {_short(name, limit)}"
                for x, side in ((0, -1), (1, 1)):
                    at = x + side * _GAP
                    # From the mark to its label, which may stand higher or lower.
                    axes.plot([x, at], [values[x], places[x][k]], color=style.colour(p), lw=0.8, alpha=0.7)
                    where = {"ha": "right" if side < 0 else "left", "va": "center", "fontsize": size}
                    axes.text(at + side * 0.015, places[x][k], texts[x], **where)
            every_place = np.concatenate(places)
            axes.set(
                xlim=(-0.85, 1.85) if width.narrow else (-0.9, 1.9),
                ylim=(min(0, every_place.min() - 3), max(100, every_place.max() + 3)), xticks=[0, 1],
                xticklabels=[
                    f"initial{gap}states, %", f"recovery{gap}points, %"
                ],
            )  # fmt: skip
            axes.set_yticks([])
            for x in (0, 1):
                axes.plot([x, x], [0, 100], color=style.LINE, lw=1, zorder=0)
                axes.plot([x] * len(_TICKS), _TICKS, "_", color=style.LINE, ms=7, zorder=0)
            for tick in _TICKS:
                axes.text(0.04, tick, f"{tick}", color=style.SOFT, fontsize=7, va="center", zorder=0)
            axes.spines[:].set_visible(False)
            axes.tick_params(length=0, labelcolor=style.SOFT)
        return plot

    return style.Figure(
        "slope", "From initial states to recovery points", _words(names, ends, of), *style.both(draw)
    )


def _short(name: str, limit: int) -> str:
    """A name that fits: its beginning and its end, since names of one series differ at their ends."""
    return style.short(name if len(name) <= limit else f"{name[: limit - 9]}…{name[-8:]}", limit)


def _words(names: Sequence[str], ends: Sequence[Sequence[Estimate]], count: int) -> str:
    pairs = "; ".join(
        f"{name} {100 * before.value:.1f} and {100 * after.value:.1f}"
        for name, before, after in zip(names, *ends, strict=True)
    )
    text = (
        f"Success in per cent from initial states and from recovery points, best at recovery first: {pairs}."
    )
    return style.the_best(text, len(names), count)


def _spread_out(values: Sequence[float]) -> np.ndarray:
    """Places for labels: the values themselves, moved apart where they would overlap, in their order."""
    order = np.argsort(values, kind="stable")
    places = np.array(values, float)[order]
    groups = [[k] for k in range(len(places))]
    centres = list(places)
    k = 0
    while k + 1 < len(groups):  # neighbours that overlap become one block around their mean
        if centres[k + 1] - centres[k] < _APART * (len(groups[k]) + len(groups[k + 1])) / 2 - 1e-9:
            groups[k] += groups.pop(k + 1)
            centres.pop(k + 1)
            centres[k] = float(places[groups[k]].mean())
            k = max(k - 1, 0)
        else:
            k += 1
    found = np.empty(len(places))
    for members, centre in zip(groups, centres, strict=True):
        for m, index in enumerate(members):
            found[order[index]] = centre + _APART * (m - (len(members) - 1) / 2)
    return found
