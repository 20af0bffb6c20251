"""Figures of trials: time to recover, oracle, interventions with their cost, outcomes."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from lerobot_roborecover.analysis.figures import style
from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.robot_tables import of_robots, outcome_words
from lerobot_roborecover.analysis.stats.crossfit import Oracle, oracle
from lerobot_roborecover.analysis.stats.timing import budget_estimates
from lerobot_roborecover.scenario import Outcome

_FILLS = {
    Outcome.SUCCESS: ("#0072b2", ""),
    Outcome.HORIZON: (style.PALE, ""),
    Outcome.STATE_MISMATCH: (style.PAPER, "///"),
    Outcome.SOLVED_BY_PREFIX: (style.PAPER, "..."),
    Outcome.SIM_ERROR: (style.PAPER, "xxx"),
    Outcome.POLICY_ERROR: (style.PAPER, "+++"),
    Outcome.TIMEOUT: (style.PAPER, "---"),
}
"""Fill and hatch by outcome; invalid ones are white with a hatch each."""


def time_to_recover(results: Results) -> style.Figure:
    """RSR against the step budget, with intervals."""
    panel = results.recovery
    grid = np.linspace(0, 1, 41)
    curves = budget_estimates(panel, grid, results.draws)
    order = sorted(range(len(curves)), key=lambda p: -np.nan_to_num(curves[p][-1].value))[: style.MOST_LINES]

    def draw(width: style.Width) -> style.Plot:
        with style.drawing() as subplots:
            plot, axes = subplots(width.inches, 3.4 + 0.24 * len(order) if width.narrow else 4.2)
            for p in order:
                values = 100 * np.array([[e.value, e.low, e.high] for e in curves[p]])
                line = {**style.line_style(p), "markevery": 8}
                name = style.short(panel.arms[p], width.names)
                axes.plot(100 * grid, values[:, 0], lw=2, label=name, **line)
                if len(curves) <= 8 and np.isfinite(values).all():
                    axes.fill_between(
                        100 * grid, values[:, 1], values[:, 2], color=style.colour(p), alpha=0.12, lw=0
                    )
            share = "step budget, % of each scenario's horizon"
            axes.set(xlim=(0, 100), ylim=(0, 100), xlabel=share, ylabel="RSR, %")
            axes.grid(color=style.LINE, lw=0.6)
            plot.legend(loc="outside lower left" if width.narrow else "outside right upper")
        return plot

    half = "; ".join(
        f"{panel.arms[p]} {100 * curves[p][20].value:.0f} of {100 * curves[p][40].value:.0f}"
        for p in range(len(curves))
        if p in order
    )
    text = f"RSR against step budget. At half the horizon, of the final rate in per cent: {half}."
    text = style.the_best(text, len(order), len(curves))
    return style.Figure("time_to_recover", "Time to recover", text, *style.both(draw))


def oracle_bars(results: Results) -> style.Figure:
    """Every ranked policy, and above them the best of each scenario, cross-fitted and in hindsight."""
    panel, rates = results.ranked, results.ranked_rates
    found = oracle(panel, results.ranked_draws)
    bars = [
        (panel.arms[p], rates[p], style.colour(results.compared.policies[p]))
        for p in reversed(results.best_first[: style.MOST_ROWS])
    ]
    if not math.isnan(found.rate.value):
        bars.append(("best of each scenario, cross-fitted", found.rate, style.PAPER))
    bars.append(("best of each, in hindsight", found.hindsight, style.PAPER))

    def draw(width: style.Width) -> style.Plot:
        with style.drawing() as subplots:
            plot, axes = subplots(width.inches, 0.7 + style.row_height(width, 0.38) * len(bars))
            thick, shift = (0.36, -0.12) if width.narrow else (0.6, 0.0)
            for y, (_, estimate, fill) in enumerate(bars):
                hindsight = fill == style.PAPER
                axes.barh(
                    y + shift, 100 * estimate.value, thick, color=fill, ec=style.INK if hindsight else fill,
                    hatch="//" if hindsight else "",
                )  # fmt: skip
                if not math.isnan(estimate.low):
                    axes.plot(
                        [100 * estimate.low, 100 * estimate.high], [y + shift] * 2, color=style.INK, lw=1.5
                    )
                axes.text(101, y + shift, f"{100 * estimate.value:.1f}", va="center", ha="left", fontsize=9)
            style.name_rows(axes, [style.short(name, width.names + 6) for name, _, _ in bars], width)
            axes.set(xlim=(0, 100), ylim=(-0.5, len(bars) - 0.2), xlabel="RSR, %")
            axes.grid(axis="x", color=style.LINE, lw=0.6)
            axes.set_axisbelow(True)
            axes.spines["left"].set_visible(False)
        return plot

    text = (
        f"The best policy of each scenario reaches {100 * found.hindsight.value:.1f} % in hindsight, chosen "
        f"and scored on the same trials, against {100 * found.best_rate.value:.1f} % for the best of all, "
        f"{found.best_policy}; {_cross_fitted(found)}chance alone would make the difference "
        f"{100 * found.floor.value:.1f} points. No policy solved {len(found.no_success)} of "
        f"{found.scenarios} scenarios."
    )
    return style.Figure("oracle", "What any of the policies could recover", text, *style.both(draw))


def _cross_fitted(found: Oracle) -> str:
    if math.isnan(found.rate.value):
        return ""
    return f"chosen on half of the trials and scored on the other, {100 * found.rate.value:.1f} %; "


def interventions(results: Results) -> style.Figure:
    """Gain against cost in steps, one point an intervention, harm written beside it."""

    def draw(width: style.Width) -> style.Plot:
        with style.drawing() as subplots:
            lines = len(results.costs) * (2 if width.narrow else 1)
            plot, axes = subplots(width.inches, 3.0 + 0.22 * lines)
            axes.axhline(0, color=style.SOFT, lw=1)
            axes.axvline(0, color=style.SOFT, lw=1)
            for k, cost in enumerate(results.costs):
                x, y = cost.extra_steps, cost.gain
                if not math.isnan(y.low):
                    axes.plot([x.value, x.value], [100 * y.low, 100 * y.high], color=style.colour(k), lw=1.5)
                    axes.plot([x.low, x.high], [100 * y.value, 100 * y.value], color=style.colour(k), lw=1.5)
                between = "\n" if width.narrow else ": "
                counts = f"rescues {cost.rescued}, harms {cost.harmed} of {cost.matched} trials"
                label = f"{style.short(cost.arm, 40)}{between}{counts}"
                axes.plot(
                    x.value, 100 * y.value, style.marker(k), color=style.colour(k), ms=9, ls="", label=label
                )
            gain = "gain in RSR, points" if width.narrow else "gain over direct control, points"
            axes.set(xlabel="extra environment steps per trial", ylabel=gain)
            axes.grid(color=style.LINE, lw=0.6)
            plot.legend(loc="outside lower left")
        return plot

    text = "; ".join(
        f"{c.arm} over {c.baseline}: {style.number(100 * c.gain.value, '+.1f')} points for "
        f"{style.number(c.extra_steps.value, '+.0f')} steps a trial"
        for c in results.costs
    )
    return style.Figure("interventions", "What interventions gain and cost", f"{text}.", *style.both(draw))


def mosaic(results: Results) -> style.Figure:
    """Outcomes of all trials; a row's height is its share of the trials, invalid ones are hatched."""
    from matplotlib.patches import Patch

    arms = results.arms[: 2 * style.MOST_ROWS]  # of both starts
    kinds = [kind for kind in Outcome if any(r.outcome == kind for a in arms for r in a.rows)]
    robots = of_robots(results)
    counts = [Counter(row.outcome for row in arm.rows) for arm in arms]
    share = np.array([len(arm.rows) for arm in arms], float)
    share = np.maximum(share / share.max(), 0.25)

    def draw(width: style.Width) -> style.Plot:
        with style.drawing() as subplots:
            columns = 2 if width.narrow else 4
            extra = 0.9 + 0.22 * math.ceil(len(kinds) / columns)
            plot, axes = subplots(width.inches, extra + style.row_height(width, 0.38) * len(arms))
            thick, shift = (0.42, 0.16) if width.narrow else (0.84, 0.0)
            for y, (arm, count) in enumerate(zip(arms, counts, strict=True)):
                left = 0.0
                for kind in kinds:
                    size = 100 * count[kind.value] / len(arm.rows)
                    fill, hatch = _FILLS[kind]
                    axes.barh(
                        y + shift,
                        size,
                        thick * share[y],
                        left,
                        color=fill,
                        ec=style.SOFT,
                        lw=0.6,
                        hatch=hatch,
                    )
                    if size > (12 if width.narrow else 5):
                        axes.text(
                            left + size / 2, y + shift, str(count[kind.value]), ha="center", va="center",
                            fontsize=9, color=style.ON_COLOUR if kind is Outcome.SUCCESS else style.INK,
                        )  # fmt: skip
                    left += size
            limit = width.names - 8
            names = [f"{style.short(arm.policy, limit)}, {arm.start.value}" for arm in arms]
            if width.narrow:
                axes.set_yticks([])
                for y, name in enumerate(names):
                    axes.text(0, y - 0.1, name, va="bottom", fontsize=9.5)
            else:
                axes.set_yticks(range(len(arms)), names)
            axes.set(xlim=(0, 100), xlabel="share of trials, %", ylim=(len(arms) - 0.45, -0.6))
            axes.spines[:].set_visible(False)
            handles = [
                Patch(
                    fc=_FILLS[k][0],
                    ec=style.SOFT,
                    hatch=_FILLS[k][1],
                    label=outcome_words(k, robots) + ("" if k.valid else " (invalid)"),
                )
                for k in kinds
            ]
            plot.legend(handles=handles, loc="outside lower left", ncols=min(columns, len(handles)))
        return plot

    text = "; ".join(
        f"{arm.policy} from {arm.start.value}: "
        + ", ".join(f"{count[k.value]} {outcome_words(k, robots)}" for k in kinds if count[k.value])
        for arm, count in zip(arms, counts, strict=True)
    )
    if len(arms) < len(results.arms):
        text += f". The first {len(arms)} of {len(results.arms)} arms; the table has all"
    return style.Figure("outcomes", "How trials ended", f"{text}.", *style.both(draw))
