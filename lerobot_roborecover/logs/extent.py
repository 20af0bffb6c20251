"""What a set of trials lacks of what its run was to evaluate: scenarios, shards, trials."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from lerobot_roborecover.logs.row import TrialRow

_SHOWN_SHARDS = 6


@dataclass(frozen=True)
class Missing:
    """What one policy's trials from one start lack; both empty where nothing is missing, or nothing known."""

    scenarios: str = ""
    """Such as `7 of 10 scenarios; shard 1/3 is missing`."""
    trials: str = ""
    """Such as `3 of 5 trials`."""

    def __bool__(self) -> bool:
        return bool(self.scenarios or self.trials)

    @property
    def words(self) -> str:
        return "; ".join(filter(None, (self.scenarios, self.trials)))


def missing(rows: Sequence[TrialRow]) -> Missing:
    """Returns what rows of one policy, start and setting lack. Rows before schema 3 claim nothing.

    Args:
        rows: of one run or of the shards of one; each says how much its run was to evaluate.
    """
    wanted = max((row.run_scenarios or 0 for row in rows), default=0)
    trials = max((row.run_trials or 0 for row in rows), default=0)
    done: dict[str, set[int]] = {}
    for row in rows:
        done.setdefault(row.scenario_id, set()).add(row.trial)
    scenarios = ""
    if len(done) < wanted:
        scenarios = f"{len(done)} of {wanted} scenarios{_missing_shards(rows)}"
    short = Counter(len(ks) for ks in done.values() if len(ks) < trials)
    if not short:
        return Missing(scenarios)
    if short.total() == len(done):
        low, high = min(short), max(short)
        return Missing(scenarios, f"{low if low == high else f'{low} to {high}'} of {trials} trials")
    return Missing(scenarios, f"{short.total()} of {len(done)} scenarios have fewer than {trials} trials")


def _missing_shards(rows: Sequence[TrialRow]) -> str:
    """The shards without a row, where the run was divided."""
    shards = Counter(row.shard for row in rows if row.shard)
    counts = {int(shard.partition("/")[2]) for shard in shards}
    if len(counts) != 1:
        return ""
    (n,) = counts
    lacking = [f"{k}/{n}" for k in range(min(n, 10_000)) if f"{k}/{n}" not in shards]
    if not lacking:
        return ""
    more = f" and {len(lacking) - _SHOWN_SHARDS} more" if len(lacking) > _SHOWN_SHARDS else ""
    are = "shard {} is missing" if len(lacking) == 1 else "shards {} are missing"
    return "; " + are.format(", ".join(lacking[:_SHOWN_SHARDS]) + more)
