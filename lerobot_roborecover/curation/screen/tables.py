"""The result of a screening as text."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from lerobot_roborecover.curation.screen.screening import PolicyCount, Screened, ScreenRule
from lerobot_roborecover.utils.text import align

_BAR = 40


def histogram(found: Sequence[Screened]) -> list[int]:
    """Scenarios by number of successes, from none to all, those with too many invalid trials included."""
    total = max((s.trials for s in found), default=0)
    counts = Counter(s.successes for s in found)
    return [counts[n] for n in range(total + 1)]


def format_histogram(found: Sequence[Screened], rule: ScreenRule) -> str:
    """The histogram as text; successes that stay are marked."""
    bars = histogram(found)
    low, high = rule.check(len(found[0].counts)) if found else (0, 0)
    scale = max(max(bars, default=0) / _BAR, 1.0)
    lines = [f"{'successes':>9} {'scenarios':>9}   (| stays)"]
    for successes, count in enumerate(bars):
        mark = "|" if low <= successes <= high else " "
        lines.append(f"{successes:>9} {count:>9} {mark} {'#' * math.ceil(count / scale)}".rstrip())
    return "\n".join(lines)


def format_settled(found: Sequence[Screened]) -> str:
    """After how many trials verdicts were settled, as text; for a curtailed screening, whose counts of
    successes are not complete."""
    run = Counter((sum(c.trials for c in s.counts.values()), s.decision.reason or "stays") for s in found)
    reasons = sorted({reason for _, reason in run}, key=lambda reason: (reason != "stays", reason))
    counts = [[n, *(run[n, reason] for reason in reasons)] for n in sorted({trials for trials, _ in run})]
    return "\n".join(align([["trials", *reasons], *counts], left=()))


def format_policies(found: Sequence[Screened]) -> str:
    """Each policy's recovery rate over all screened scenarios, and over those that stay, as text.

    Rates weigh scenarios equally; intervals are those of every table (`analysis/stats/intervals.py`), over
    the platform's units. A policy that has not tried every scenario as often as the rule says has no rate:
    those that it tried are those that others left open.
    """
    kept = [s for s in found if s.decision.verdict == "kept"]
    names = sorted({name for s in found for name in s.counts})
    rows: list[tuple[object, ...]] = [("policy", "recovered %", "of those kept %", "trials", "invalid")]
    for name in names:
        counts = [s.counts[name] for s in found]
        trials, invalid = (sum(ns) for ns in ([c.trials for c in counts], [*map(_invalid, counts)]))
        rows.append((name, _rate(found, name), _rate(kept, name), trials, invalid))
    return "\n".join(align(rows, left=(0, 1, 2)))


def _invalid(count: PolicyCount) -> int:
    return sum(count.invalid.values())


def _rate(found: Sequence[Screened], policy: str) -> str:
    from lerobot_roborecover.analysis.stats.units import default_unit, unit_labels
    from lerobot_roborecover.analysis.summary import rate_estimate

    if not found:
        return "n/a"
    counts = [s.counts[policy] for s in found]
    if any(s.counts[policy].trials * s.counts[policy].each_counts < s.rule.trials for s in found):
        return "n/a (curtailed)"
    rates = np.array([c.successes / c.trials for c in counts])
    scenarios = [s.scenario for s in found]
    unit = default_unit(scenarios[0].task.platform)
    ids, clusters = [s.id for s in scenarios], [s.cluster for s in scenarios]
    units = unit_labels(unit, ids, clusters, [s.task.name for s in scenarios])
    estimate = rate_estimate(rates, units.tolist())
    value, low, high = (100 * x for x in (estimate.value, estimate.low, estimate.high))
    return f"{value:5.1f}" if low != low else f"{value:5.1f} [{low:.1f}, {high:.1f}]"
