"""`roborecover eval --sequential`: a run that may be looked at, and that stops when its comparison is
decided.

1. Scenarios are run in `analysis.stats.sequential`'s order, all trials of one before the next one's.
2. A scenario counts when all its trials and those of all scenarios before it are in. Whatever ends early
   counts no earlier for it, and what slots have run ahead does not count at all.
3. The line shows the rate and, against another policy's log, the difference with their confidence sequences.
   When the sequential test has decided the run stops.
4. `trials.sequential.json` beside the log records this for later readers of the log.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_roborecover.analysis.stats.intervals import LEVEL
from lerobot_roborecover.analysis.stats.sequential import RateSequence, SequentialTest, grid_of, sequence
from lerobot_roborecover.analysis.stats.units import default_unit, initial_unit, unit_labels
from lerobot_roborecover.analysis.stats.verdicts import LEAST_DIFFERING
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.options import ALONE
from lerobot_roborecover.evaluation.progress import RunProgress
from lerobot_roborecover.logs.row import EvalProtocol, TrialRow
from lerobot_roborecover.logs.sequential_record import SequentialRecord, read_record, write_record
from lerobot_roborecover.logs.trial_log import read_log
from lerobot_roborecover.scenario import Scenario, Start


@dataclass(frozen=True)
class Reference:
    """The other policy's stored trials."""

    policy: str
    config_hash: str
    path: Path
    sha256: str
    rates: Mapping[str, float]
    """Rates by scenario, invalid trials as failures."""
    trials: tuple[int, ...]
    """How many a scenario has; each number that occurs."""

    def outcomes(self) -> str:
        """Returns a SHA-256 of its rates, so that a changed log is detected at a later look."""
        text = "\n".join(f"{name} {rate!r}" for name, rate in sorted(self.rates.items()))
        return hashlib.sha256(text.encode()).hexdigest()


def read_reference(path: Path, scenarios: Sequence[Scenario], protocol: EvalProtocol) -> Reference:
    """Reads the log that a run is to be compared with.

    Args:
        path: a log, or a folder that holds `trials.jsonl`.
        scenarios: of the run.
        protocol: of the run.

    Raises:
        TrialLogError: the log cannot be read.
        OptionError: it is not of one policy, or cannot be compared with the run.
    """
    path = path / "trials.jsonl" if path.is_dir() else path
    option = f"--sequential={path}"
    rows = [r for r in read_log(path).rows if r.start == protocol.start]
    kinds = {(r.policy, r.config_hash) for r in rows}
    if len(kinds) != 1:
        names = ", ".join(sorted({policy for policy, _ in kinds})) or "no policy"
        raise OptionError(
            f"{option}: {len(kinds)} settings from {protocol.start} starts (of {names}); it must hold one "
            "policy under one setting"
        )
    of: dict[str, list[TrialRow]] = {}
    for row in rows:
        of.setdefault(row.scenario_id, []).append(row)
    lacking = sorted(s.id for s in scenarios if s.id not in of)
    if lacking:
        raise OptionError(
            f"{option} lacks {len(lacking)} of the run's {len(scenarios)} scenarios ({lacking[0]}, ...). "
            "Complete it, or choose the scenarios that it has with --env.select"
        )
    for scenario in scenarios:
        if of[scenario.id][0].scenario_sha256 != scenario.sha256():
            raise OptionError(
                f"{option}: its scenario {scenario.id} has another content than the run's. Take the log of "
                "this scenario set"
            )
    first = rows[0]
    for name in sorted({*first.versions, *protocol.versions} - {"lerobot"}):
        if first.versions.get(name) != protocol.versions.get(name):
            raise OptionError(
                f"{option}: {name} was {first.versions.get(name)} there and is "
                f"{protocol.versions.get(name)} here. Simulator versions change scores; take one for both"
            )
    for name in ("handoff_check", "approximate_snapshots"):
        if first.options.get(name, name == "handoff_check") != protocol.options.get(
            name, name == "handoff_check"
        ):
            raise OptionError(f"{option}: --env.{name} was another one there. Evaluate both with one")
    (kind,) = kinds
    chosen = [of[s.id] for s in scenarios]
    return Reference(
        *kind,
        path,
        hashlib.sha256(path.read_bytes()).hexdigest(),
        {group[0].scenario_id: sum(r.success for r in group) / len(group) for group in chosen},
        tuple(sorted({len(group) for group in chosen})),
    )


class Watch(RunProgress):
    """Counts trials as `RunProgress` does, and says at any time what they show.

    Args:
        scenarios: of the run.
        protocol: of the run.
        trials: of every scenario.
        reference: the trials to compare with; None compares with none.
        level: confidence level.
    """

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        protocol: EvalProtocol,
        trials: int,
        reference: Reference | None = None,
        level: float = LEVEL,
    ):
        super().__init__(protocol.start, [s.id for s in scenarios], trials)
        initial = protocol.start == Start.INITIAL
        labels = unit_labels(
            initial_unit(None) if initial else default_unit(scenarios[0].platform),
            [s.id for s in scenarios],
            [s.cluster for s in scenarios],
            [""] * len(scenarios),
            [s.first_state_sha256() for s in scenarios],
        )
        self._unit_of = dict(zip([s.id for s in scenarios], labels.tolist(), strict=True))
        self._members: dict[str, list[Scenario]] = {}
        for label, scenario in zip(labels.tolist(), scenarios, strict=True):
            self._members.setdefault(label, []).append(scenario)
        for members in self._members.values():
            members.sort(key=lambda s: s.id)
        self._left = sequence(self._members)
        self.order = [s for unit in self._left for s in self._members[unit]]
        """Scenarios in the order in which they are to be run."""
        self._protocol, self._trials_each, self._reference = protocol, trials, reference
        self._rate = RateSequence(level)
        self._taken = 0
        grid = grid_of([trials, *reference.trials]) if reference else 1
        self._test = SequentialTest(len(self._left), grid, level) if reference else None

    def add(self, rows: list[dict[str, Any]]) -> None:
        """Counts rows in, and takes in every scenario whose turn has come."""
        super().add(rows)
        while self._left and all(self._whole(s.id) for s in self._members[self._left[0]]):
            members = self._members[self._left.pop(0)]
            rates = [self._counts[s.id][0] / self._trials_each for s in members]
            self._rate.add(sum(rates) / len(rates))
            self._taken += len(members)
            if self._test is not None and self._reference is not None:
                others = self._reference.rates
                total = sum(rate - others[s.id] for rate, s in zip(rates, members, strict=True))
                self._test.add(total, len(members))

    def _whole(self, scenario: str) -> bool:
        return self._counts.get(scenario, (0, 0))[1] >= self._trials_each

    @property
    def rate(self) -> float | None:
        """Success rate over the scenarios that count; None before the first."""
        return self._rate.estimate.value if self._rate.count else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The rate's confidence sequence, which holds whenever it is looked at."""
        found = self._rate.estimate
        return (found.low, found.high) if self._rate.count else None

    @property
    def note(self) -> str:
        """What the line says beside the rate."""
        text = f"on {self._taken} of {len(self.order)} scenarios"
        if self._test is None or not self._test.steps:
            return text
        d = self._test.difference
        return f"{text}, difference {100 * d.value:+.1f} [{100 * d.low:+.1f}, {100 * d.high:+.1f}]"

    @property
    def decided(self) -> bool:
        """Whether the comparison is settled: the test has decided, and enough units differ."""
        test = self._test
        return test is not None and test.decided_after is not None and test.differing >= LEAST_DIFFERING

    @property
    def words(self) -> str:
        """What the comparison says so far, in a sentence."""
        if self._test is None or self._reference is None:
            return ""
        d, other = self._test.difference, self._reference.policy
        bounds = f"{100 * d.low:+.1f} to {100 * d.high:+.1f}"
        if not self.decided:
            return f"not decided against {other} on {self._taken} of {len(self.order)} scenarios ({bounds})"
        which = "better" if d.value > 0 else "worse"
        return (
            f"decided after {self._taken_at} of {len(self.order)} scenarios: {which} than {other}, by "
            f"{100 * abs(d.value):.1f} points ({bounds}), p {max(self._test.p, 1e-4):.4f}"
        )

    @property
    def _taken_at(self) -> int:
        return self._taken if self._test is None else self._test.scenarios

    def record(self, log: Path) -> Path | None:
        """Writes the record beside the log; None where there is nothing to compare with."""
        if self._test is None or self._reference is None:
            return None
        return write_record(
            log,
            SequentialRecord(
                policy=self._protocol.policy,
                config_hash=self._protocol.config_hash(),
                start=self._protocol.start,
                trials=self._trials_each,
                scenarios=tuple(s.id for s in self.order),
                level=self._test.level,
                against=self._reference.policy,
                against_config_hash=self._reference.config_hash,
                against_log=self._reference.path.name,
                against_sha256=self._reference.sha256,
                decided=self.decided,
                after_scenarios=self._taken_at,
                p=self._test.p if self._test.steps else None,
                words=self.words,
                units=tuple(self._unit_of[s.id] for s in self.order),
                against_outcomes=self._reference.outcomes(),
            ),
        )


def open_watch(
    value: str, scenarios: Iterable[Scenario], protocol: EvalProtocol, trials: int, *, log: Path, shard: str
) -> Watch | None:
    """The watch that `--runner.sequential` asks for; None without the option.

    Raises:
        OptionError, TrialLogError: see `read_reference`; or a shard was to decide, or the log is
            the run's own.
    """
    if not value:
        return None
    chosen = list(scenarios)
    if value == ALONE:
        return Watch(chosen, protocol, trials)
    if shard not in ("", "0/1"):
        raise OptionError(
            f"--sequential={value} with --shard={shard}: a part cannot decide for the whole. Run all "
            "scenarios in one command, or watch the rate alone with --sequential"
        )
    path = Path(value)
    reference = read_reference(path, chosen, protocol)
    if log.exists() and reference.path.resolve() == log.resolve():
        raise OptionError(f"--sequential={value}: this is the run's own log; name another policy's")
    _check_same_question(log, reference, {s.id for s in chosen}, trials)
    return Watch(chosen, protocol, trials, reference)


def _check_same_question(log: Path, reference: Reference, scenarios: set[str], trials: int) -> None:
    """Refuses another comparison, or another plan, than that of the first look."""
    before = read_record(log)
    if before is None:
        return
    begun = f"--sequential={reference.path}: {log} was begun as a comparison with {before.against}"
    if before.against_config_hash != reference.config_hash:
        raise OptionError(f"{begun}, and one run answers one question. Give this run another --output_dir")
    if set(before.scenarios) != scenarios or before.trials != trials:
        raise OptionError(
            f"{begun} on {len(before.scenarios)} scenarios with {before.trials} trials each, and not on "
            f"{len(scenarios)} with {trials}: the plan is fixed at the first look. Take the same "
            "--env.select and --eval.n_episodes, or another --output_dir"
        )
    if before.against_outcomes and before.against_outcomes != reference.outcomes():
        raise OptionError(
            f"{begun}, whose outcomes have changed since. Bring back the log as it was, or give this run "
            "another --output_dir"
        )
