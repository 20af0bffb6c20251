"""The rollouts of a collection: experts in the workers, policies through the engine; every end is noted."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lerobot_roborecover.curation.collect.record import RolloutOutcome, record_path
from lerobot_roborecover.curation.collect.starts import RolloutSpec
from lerobot_roborecover.evaluation.session import EvalSession
from lerobot_roborecover.evaluation.trial import FAILURES, Trial
from lerobot_roborecover.evaluation.work_items import WorkItem, WorkQueue
from lerobot_roborecover.logs.row import EvalProtocol, TrialRow
from lerobot_roborecover.scenario import Outcome, ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.journal import Journal
from lerobot_roborecover.workers.dispatch import map_unordered
from lerobot_roborecover.workers.messages import SlotFailure
from lerobot_roborecover.workers.slots import SlotPool

ROLLOUTS_FILE = "rollouts.jsonl"
RECORDS_FOLDER = "rollouts"
SCHEMA_VERSION = 1


class RolloutJournal:
    """The journal of a working folder and the records beside it; one process at a time.

    Args:
        work: the folder.

    Raises:
        ScenarioError: the journal is damaged, or another process has it open.
    """

    def __init__(self, work: Path):
        self.work, self.records = work, work / RECORDS_FOLDER
        self._journal = Journal(work / ROLLOUTS_FILE, SCHEMA_VERSION)
        self._ended: dict[str, RolloutOutcome] = {}
        for row in self._journal.records:
            try:
                ended = RolloutOutcome(**{k: v for k, v in row.items() if k != "schema"})
                Outcome(ended.outcome)
            except (TypeError, ValueError) as err:
                self._journal.close()
                raise ScenarioError(
                    f"{self._journal.path}: {row!r:.200} is not a rollout's end ({err})"
                ) from None
            self._ended[ended.rollout] = ended

    def find(self, rollout: str, *, retry_errors: bool = False) -> RolloutOutcome | None:
        """How a rollout ended; None where it is still to be done.

        Args:
            rollout: its id.
            retry_errors: one that broke is to be done again.
        """
        ended = self._ended.get(rollout)
        if ended is None or (retry_errors and not ended.recorded):
            return None
        if ended.recorded and not record_path(self.records, rollout).is_file():
            return None
        return ended

    def add(self, ended: RolloutOutcome, record: bytes) -> None:
        """Writes an end down, its record first, so that no end is without one.

        Args:
            ended: how.
            record: content of the record's file; empty where it did not come to its end.
        """
        if record:
            atomic_write(record_path(self.records, ended.rollout), record)
        self._journal.append(asdict(ended))
        self._ended[ended.rollout] = ended

    def close(self) -> None:
        """Lets go of the journal."""
        self._journal.close()


type OnEnd = Callable[[RolloutOutcome, bytes], None]
"""Called when a rollout ends, with the content of its record's file."""


def run_expert(units: Iterable[RolloutSpec], pool: SlotPool, slots: int, on_end: OnEnd) -> None:
    """Drives rollouts in the workers.

    Args:
        units: what to drive.
        pool: of slots with `collect_server.SERVER` and settings that name the expert.
        slots: how many.
        on_end: called with each.
    """
    queue = WorkQueue(WorkItem(u, u.trial) for u in units)

    def take(last: WorkItem | None, busy: list[WorkItem]) -> WorkItem | None:
        return queue.take(last, [u.task for u in busy])

    workers = pool.worker_slots(min(slots, max(len(queue), 1)))
    for unit, reply in map_unordered(workers, "roll_out", take, lambda u: u.scenario):
        if isinstance(reply, SlotFailure):
            on_end(
                RolloutOutcome(unit.scenario.record_name, FAILURES[reply.kind].value, 0, reply.message), b""
            )
        else:
            on_end(*reply)


def run_policy(
    passes: Iterable[Sequence[RolloutSpec]],
    pool: SlotPool,
    make_host: Callable[[], Any],
    places: Any,
    *,
    driver: str,
    seed: int,
    most: int,
    on_end: OnEnd,
) -> None:
    """Lets a policy drive, through the engine.

    Args:
        passes: what to drive, one after the other, each asked for once the one before has ended; two in a
            pass have different ids.
        pool: of slots with `collect_server.SERVER`.
        make_host: loads the policy.
        places: where, an `EngineConfig` of `evaluation.launch`.
        driver: the policy's name in the rollouts.
        seed: of the run; a trial's noise comes from it and from the rollout's id.
        most: rollouts in a pass, at most.
        on_end: called with each.

    Raises:
        ScenarioError: the policy went away, so that some were not driven.
    """
    from lerobot_roborecover.evaluation.launch import run_passes

    def keep(trial: Trial, row: TrialRow) -> None:
        assert isinstance(trial.scenario, RolloutSpec)
        on_end(
            RolloutOutcome(trial.scenario.record_name, row.outcome, row.steps, row.reason), trial.attachment
        )

    protocol = EvalProtocol("recovery", 0, driver, seed, None)
    run = EvalSession(pool, protocol, None, "collect", None, handoff_check=False, on_trial_end=keep)
    items = ([WorkItem(u, u.trial) for u in wanted] for wanted in passes)
    run_passes(run, items, make_host, places, most=most).check_all_run()
