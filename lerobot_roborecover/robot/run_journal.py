"""The journal of a run: every event before anything else happens, and what follows from it.

The journal is the truth. A trial log that lacks a row after a crash, or holds one that was taken back, is put
right from it when the run is opened again; so are the verdicts in the run's dataset.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lerobot_roborecover.logs.log_file import TRIALS_FILE
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.robot.trial_columns import verdicts_of, write_columns
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.journal import Journal

JOURNAL_FILE = "journal.jsonl"
SCHEMA = 1


def dataset_folder(run: Path) -> Path:
    """Where a run records its episodes; LeRobot's name of a rollout's dataset."""
    return run / f"rollout_{run.name}"


class RunJournal:
    """The open journal of a run; one process at a time holds it.

    Args:
        folder: of the run.

    Raises:
        ScenarioError: it is damaged, or another console has the run open.
    """

    def __init__(self, folder: Path):
        self._journal = Journal(folder / JOURNAL_FILE, SCHEMA)
        self.log, self._dataset = folder / TRIALS_FILE, dataset_folder(folder)
        self.put_right()

    def note(self, kind: str, **values: Any) -> None:
        """Writes an event; it is on disk when this returns.

        Raises:
            ScenarioError: it could not be written.
        """
        self._journal.append({"kind": kind, **values})

    def finish(self, order: int, row: TrialRow) -> None:
        """Writes how a trial ended, and its row into the log."""
        self.note("trial", order=order, row=asdict(row))
        self.put_right()

    def undo(self) -> int | None:
        """Takes the latest verdict back; returns the trial's place, None where there is none."""
        done = self.rows()
        if not done:
            return None
        order = list(done)[-1]
        self.note("undo", order=order)
        self.put_right()
        return order

    def rows(self) -> dict[int, Mapping[str, Any]]:
        """The rows that count, by the trial's place, in the order in which they were given."""
        found: dict[int, Mapping[str, Any]] = {}
        for record in self._journal.records:
            if record["kind"] == "trial":
                found.pop(record["order"], None)
                found[record["order"]] = record["row"]
            elif record["kind"] == "undo":
                found.pop(record["order"], None)
        return found

    def pending(self) -> dict[str, Any] | None:
        """The last rollout that has no verdict yet: after a crash, or where a verdict was taken back."""
        rollouts: dict[int, dict[str, Any]] = {}
        for record in self._journal.records:
            if record["kind"] == "rollout":
                rollouts[record["order"]] = record
            elif record["kind"] == "undo" and record["order"] in rollouts:
                # The button that ended it was the verdict that was taken back.
                rollouts[record["order"]] = {**rollouts[record["order"]], "button": ""}
        done = self.rows()
        waiting = [record for order, record in rollouts.items() if order not in done]
        return waiting[-1] if waiting else None

    def cut_off(self) -> int | None:
        """The trial whose rollout was under way when the run was cut off; None where there is none."""
        if not self._journal.records or self._journal.records[-1]["kind"] != "restored":
            return None
        record = self._journal.records[-1]
        return None if record["reason"] or record["order"] in self.rows() else int(record["order"])

    def external(self) -> dict[str, int]:
        """The trial's place by the name that another program has given it (`RunConfig.external`)."""
        records = self._journal.records
        return {r["external"]: r["order"] for r in records if r["kind"] == "restored" and r.get("external")}

    def put_right(self) -> None:
        """Makes the trial log and the dataset hold the verdicts that count, and no others."""
        rows = self.rows()
        text = "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows.values())
        before = self.log.read_text("utf-8") if self.log.is_file() else ""
        if text != before:
            atomic_write(self.log, text)
        write_columns(self._dataset, verdicts_of(self._journal.records, rows))

    def close(self) -> None:
        self._journal.close()
