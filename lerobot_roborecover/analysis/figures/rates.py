"""Figures of rates: forest, cells, source × recovery, paired differences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from lerobot_roborecover.analysis.figures import style
from lerobot_roborecover.analysis.figures.prefix import prefix_figure
from lerobot_roborecover.analysis.figures.retries import retries
from lerobot_roborecover.analysis.figures.runs import runs_figure
from lerobot_roborecover.analysis.figures.slope import slope
from lerobot_roborecover.analysis.figures.trials import interventions, mosaic, oracle_bars, time_to_recover
from lerobot_roborecover.analysis.policy_tables import initial_estimates
from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.stats.groups import group_rates, source_matrix
from lerobot_roborecover.analysis.stats.intervals import Estimate

MOST_COLUMNS = {False: 24, True: 10}
"""Policies that a heat map shows, the best first, by whether it is narrow; its table has all."""


def all_figures(results: Results) -> list[style.Figure]:
    """Every figure that the study has something for."""
    figures = [forest(results)]
    if results.several_runs:
        figures.append(runs_figure(results))
    several = len(results.recovery.arms) > 1
    if (found := slope(results)) is not None:
        figures.append(found)
    figures.append(cell_heat_map(results))
    if (found := prefix_figure(results)) is not None:
        figures.append(found)
    if matrix := source_matrix(results.recovery, results.draws):
        figures.append(source_heat_map(results, matrix))
    if several:
        figures.append(paired_differences(results))
    figures.append(time_to_recover(results))
    if (found := retries(results)) is not None:
        figures.append(found)
    if several:
        figures.append(oracle_bars(results))
    if results.costs:
        figures.append(interventions(results))
    figures.append(mosaic(results))
    return figures


def forest(results: Results) -> style.Figure:
    """RSR with intervals, best first; initial-state rates as hollow markers with theirs."""
    panel, chosen = results.recovery, results.compared.policies
    rsr, initial = dict(zip(chosen, results.ranked_rates, strict=True)), initial_estimates(results)
    order = [chosen[p] for p in reversed(results.best_first[: style.MOST_ROWS])]
    level = f"{100 * results.draws.level:g} % interval"

    def draw(width: style.Width) -> style.Plot:
        with style.drawing() as subplots:
            plot, axes = subplots(width.inches, 0.8 + style.row_height(width, 0.46) * len(order))
            for y, p in enumerate(order):
                if not math.isnan(initial[p].value):
                    at = y - 0.2
                    if not math.isnan(initial[p].low):
                        axes.plot(
                            [100 * initial[p].low, 100 * initial[p].high], [at, at], color=style.SOFT, lw=1.2
                        )
                    axes.plot(100 * initial[p].value, at, "o", color=style.SOFT, mfc=style.PAPER, ms=5.5)
                if not math.isnan(rsr[p].low):
                    axes.plot([100 * rsr[p].low, 100 * rsr[p].high], [y, y], color=style.colour(p), lw=3)
                axes.plot(
                    100 * rsr[p].value,
                    y,
                    style.marker(p),
                    color=style.colour(p),
                    ms=9,
                    mec=style.PAPER,
                    mew=1,
                )
                if not width.narrow:
                    at = 100 * rsr[p].value, y
                    value = f"{100 * rsr[p].value:.1f}"
                    axes.annotate(value, at, (0, 8), textcoords="offset points", ha="center", fontsize=9)
            names = [style.short(panel.arms[p], width.names) for p in order]
            if width.narrow:  # beside the name: above the row's end the value would be read as another mark's
                names = [f"{name}  {100 * rsr[p].value:.1f}" for name, p in zip(names, order, strict=True)]
            style.name_rows(axes, names, width)
            axes.set(xlim=(-1, 101), ylim=(-0.6, len(order) - 0.15))
            hollow = any(not math.isnan(e.value) for e in initial)
            texts = [f"RSR, %, with {level}", "hollow: from initial states"][: 1 + hollow]
            axes.set_xlabel(("\n" if width.narrow else "; ").join(texts))
            axes.grid(axis="x", color=style.LINE, lw=0.6)
            axes.set_axisbelow(True)
            axes.spines["left"].set_visible(False)
        return plot

    words = "; ".join(f"{panel.arms[p]} {_words(rsr[p])}" for p in reversed(order))
    text = style.the_best(f"RSR in per cent, best first: {words}.", len(order), len(chosen))
    if results.left_out:
        text += f" Not ranked, because not run on all scenarios: {', '.join(results.left_out)}."
    return style.Figure("forest", "Recovery success rate", text, *style.both(draw))


def _words(estimate: Estimate) -> str:
    if math.isnan(estimate.low):
        return f"{100 * estimate.value:.1f}"
    return f"{100 * estimate.value:.1f} ({100 * estimate.low:.1f} to {100 * estimate.high:.1f})"


def cell_heat_map(results: Results) -> style.Figure:
    """Cells × policies; sparse cells hatched and pale, counts in the labels."""
    groups = group_rates(results.recovery, "cell", results.draws)
    labels = [f"{g.label.replace('-', ', ', 1)}  (N={g.scenarios})" for g in groups]
    values = np.array([[e.value for e in g.estimates] for g in groups])
    sparse = [g.underpowered for g in groups]
    plots = _heat_map(values, labels, results.recovery.arms, sparse)
    arms = results.recovery.arms[: MOST_COLUMNS[False]]
    words = "; ".join(
        f"{label}: {', '.join(f'{a} {style.number(100 * v)}' for a, v in zip(arms, row, strict=False))}"
        for label, row in zip(labels, values, strict=True)
    )
    text = style.the_best(f"RSR in per cent. {words}.", len(arms), len(results.recovery.arms))
    return style.Figure("cells", "Recovery by stage and deviation type", text, *plots)


def source_heat_map(results: Results, matrix: Sequence) -> style.Figure:
    """Source policies × recovery policies."""
    labels = [f"{style.short(row.source_policy)}  (N={row.scenarios})" for row in matrix]
    values = np.array([[e.value for e in row.rates] for row in matrix])
    solid = [(i, row.own) for i, row in enumerate(matrix) if row.own is not None]
    dashed = [(i, row.best_other) for i, row in enumerate(matrix) if row.best_other is not None]
    sparse = [row.underpowered for row in matrix]
    plots = _heat_map(values, labels, results.recovery.arms, sparse, solid, dashed)
    words = "; ".join(
        f"scenarios of {row.source_policy}: best other {results.recovery.arms[row.best_other]} "
        f"{style.number(100 * row.rates[row.best_other].value)}"
        + (f", itself {style.number(100 * row.rates[row.own].value)}" if row.own is not None else "")
        for row in matrix
        if row.best_other is not None
    )
    text = f"RSR in per cent; solid outline: the source policy itself, dashed: observed best other. {words}"
    return style.Figure("source_matrix", "Who recovers from whose deviations", text, *plots)


def _heat_map(
    values: np.ndarray,
    labels: Sequence[str],
    policies: Sequence[str],
    sparse: Sequence[bool],
    solid: Sequence[tuple[int, int]] = (),
    dashed: Sequence[tuple[int, int]] = (),
) -> tuple[style.Plot, style.Plot]:
    """Rows × policies as coloured fields with their numbers, wide and narrow."""
    from matplotlib import colormaps
    from matplotlib.patches import Rectangle

    shades = colormaps[style.HEAT]
    every, all_values = policies, values

    def draw(width: style.Width) -> style.Plot:
        policies = every[: MOST_COLUMNS[width.narrow]]
        values = all_values[:, : len(policies)]
        with style.drawing() as subplots:
            tall = style.row_height(width, 0.44)
            plot, axes = subplots(width.inches, 0.9 + tall * len(labels) + 0.25 * width.narrow)
            for i, j in np.ndindex(values.shape):
                known = math.isfinite(values[i, j])
                low = 0.16 if width.narrow else 0.46
                field = Rectangle(
                    (j - 0.48, i - low), 0.96, low + 0.46, fc=shades(values[i, j]) if known else "none",
                    ec=style.LINE if not known or sparse[i] else "none", lw=0.8,
                    alpha=0.55 if sparse[i] else 1, hatch="///" if sparse[i] and known else None,
                )  # fmt: skip
                axes.add_patch(field)
                dark = known and values[i, j] < 0.55
                text = axes.text(
                    j, i + (0.46 - low) / 2, style.number(100 * values[i, j]), ha="center", va="center",
                    color=style.ON_COLOUR if dark else style.ON_LIGHT if known else style.SOFT,
                )  # fmt: skip
                if sparse[i] and known:
                    text.set_bbox({"fc": shades(values[i, j]), "ec": "none", "pad": 1.5})
            for cells, dashes in ((dashed, (0, (4, 2))), (solid, "-")):
                for i, j in (cell for cell in cells if cell[1] < len(policies)):
                    low = 0.12 if width.narrow else 0.42
                    corner, size = (j - 0.44, i - low), (0.88, low + 0.42)
                    axes.add_patch(Rectangle(corner, *size, fill=False, ec=style.ON_COLOUR, lw=4))
                    axes.add_patch(Rectangle(corner, *size, fill=False, ec="#d55e00", lw=2, ls=dashes))
            tilt = {"rotation": 30, "ha": "left", "rotation_mode": "anchor"} if width.narrow else {}
            limit = 14 if width.narrow else max(8, int(120 / len(policies)))
            axes.set_xticks(range(len(policies)), [style.short(p, limit) for p in policies], **tilt)
            axes.xaxis.tick_top()
            if width.narrow:
                axes.set_yticks([])
                for i, label in enumerate(labels):
                    axes.text(-0.48, i - 0.22, label, va="bottom", fontsize=9.5)
            else:
                axes.set_yticks(range(len(labels)), labels)
            axes.set(xlim=(-0.5, len(policies) - 0.5), ylim=(len(labels) - 0.5, -0.62))
            if len(policies) < len(every):
                axes.set_xlabel(f"the best {len(policies)} of {len(every)} policies")
            axes.tick_params(length=0, labelcolor=style.INK)
            axes.spines[:].set_visible(False)
        return plot

    return style.both(draw)


def paired_differences(results: Results) -> style.Figure:
    """All pairs with their intervals; separated ones filled."""
    pairs = set(results.shown_pairs)
    every = zip(combinations(range(len(results.recovery.arms)), 2), results.contrasts, strict=True)
    found = sorted((c for pair, c in every if pair in pairs), key=lambda c: c.difference.value)
    shown = [c for c in found if not math.isnan(c.difference.value)]
    level = f"{100 * results.draws.level:g} % interval"

    def draw(width: style.Width) -> style.Plot:
        with style.drawing() as subplots:
            plot, axes = subplots(width.inches, 0.9 + style.row_height(width, 0.3) * max(1, len(shown)))
            axes.axvline(0, color=style.SOFT, lw=1)
            for y, c in enumerate(shown):
                d = c.difference
                clear = c.verdict.separated
                shade = style.colour(0) if clear else style.SOFT
                if not math.isnan(d.low):
                    axes.plot([100 * d.low, 100 * d.high], [y, y], color=shade, lw=2.2)
                axes.plot(100 * d.value, y, "o", color=shade, mfc=shade if clear else style.PAPER, ms=7)
            limit = 15 if width.narrow else 22
            style.name_rows(
                axes, [f"{style.short(c.a, limit)} − {style.short(c.b, limit)}" for c in shown], width
            )
            axes.set(ylim=(-0.7, max(1, len(shown)) - (0.1 if width.narrow else 0.3)))
            texts = f"RSR, A − B, points, with {level}", "filled: separated (Holm)"
            axes.set_xlabel(("\n" if width.narrow else "; ").join(texts))
            axes.grid(axis="x", color=style.LINE, lw=0.6)
            axes.set_axisbelow(True)
            axes.spines["left"].set_visible(False)
        return plot

    clear = [c for c in shown if c.verdict.separated]
    text = f"{len(clear)} of {len(shown)} pairs are separated after adjustment for their number (Holm)."
    if len(shown) < len(results.contrasts):
        text = (
            f"{results.recovery.arms[0]} against every other policy: {text} The table has all "
            f"{len(results.contrasts)} pairs."
        )
    return style.Figure("paired_differences", "Paired differences in RSR", text, *style.both(draw))
