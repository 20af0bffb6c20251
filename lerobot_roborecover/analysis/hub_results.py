"""Results as the Hub's evaluation-results metadata: `.eval_results/*.yaml` beside a model's card.

The Hub shows such files on the model's page and on the benchmark data set's own leaderboard
(https://huggingface.co/docs/hub/eval-results).
"""

from __future__ import annotations

import math
import re

from lerobot_roborecover.analysis.estimators import RowsError
from lerobot_roborecover.analysis.intervals import Estimate
from lerobot_roborecover.analysis.leaderboard import Board, Entry, Leaderboard

_HUB_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,95}/[A-Za-z0-9][A-Za-z0-9._-]{0,95}")


def find_entry(found: Leaderboard, policy: str | None) -> tuple[Board, Entry]:
    """The one entry that is meant.

    Args:
        found: the leaderboard.
        policy: its name; None where there is only one.

    Raises:
        RowsError: none, or more than one.
    """
    entries = [(b, e) for b in found.boards for e in b.entries if policy in (None, e.policy)]
    if len(entries) != 1:
        names = ", ".join(sorted({e.policy for b in found.boards for e in b.entries})) or "none"
        raise RowsError(
            f"{len(entries)} entries fit --policy={policy}; exactly one result can be pushed at a "
            f"time. There are: {names}"
        )
    return entries[0]


def results_yaml(board: Board, entry: Entry, dataset_id: str | None = None) -> str:
    """The file's text: RSR, Macro and, where there is one, the initial-state rate, in per cent.

    Args:
        board: where the entry stands.
        entry: the result.
        dataset_id: the scenario set's id on the Hub; by default the one in the logs.

    Raises:
        RowsError: the scenario set has no id on the Hub, or the entry is no complete result of the policy
        alone.
    """
    import yaml
    from huggingface_hub import EvalResultEntry, eval_result_entries_to_yaml

    dataset = dataset_id or entry.provenance.dataset
    if not _HUB_ID.fullmatch(dataset):
        raise RowsError(
            f"the scenario set {dataset!r} is not a data set on the Hub, which the metadata must "
            "name. Publish it "
            "(roborecover publish) and evaluate from there, or say --dataset-id ORG/NAME"
        )
    if entry.scenarios < board.scenarios or entry.interventions:
        what = (
            "is an intervention"
            if entry.interventions
            else f"covers {entry.scenarios} of {board.scenarios} scenarios"
        )
        raise RowsError(f"{entry.policy} {what}: only complete results of a policy alone are pushed")
    metrics = {"recovery_success_rate": entry.rsr, "macro_recovery_success_rate": entry.macro}
    if not math.isnan(entry.initial.value):
        metrics["initial_state_success_rate"] = entry.initial
    entries = [
        EvalResultEntry(
            dataset_id=dataset,
            task_id=task,
            value=round(100 * estimate.value, 2),
            # A revision belongs to the data set that the logs name, not to another one that holds the same.
            dataset_revision=entry.provenance.dataset_revision
            if dataset == entry.provenance.dataset
            else None,
            date=entry.provenance.finished_at,
            notes=_notes(entry, estimate, board),
        )
        for task, estimate in metrics.items()
    ]
    return yaml.safe_dump(eval_result_entries_to_yaml(entries), sort_keys=False, allow_unicode=True)


def _notes(entry: Entry, estimate: Estimate, board: Board) -> str:
    p = entry.provenance
    interval = counts = ""
    if not math.isnan(estimate.low):
        bounds = f"{100 * estimate.low:.2f} to {100 * estimate.high:.2f}"
        interval = f"{100 * board.options.level:g} % interval {bounds}; "
    if estimate is not entry.initial:
        invalid = f"{entry.invalid} invalid (counted as failures)"
        counts = f"{entry.scenarios} scenarios, {entry.trials} trials, {invalid}; "
    versions = ", ".join(f"{name} {version}" for name, version in p.versions.items())
    made = f"policy {entry.policy}; {versions}; run seed {p.run_seed}; logs {', '.join(p.logs)}"
    return f"{interval}{counts}{made}"


def file_name(board: Board) -> str:
    """Path of the file in the model's repository: pushing a result again replaces it."""
    name = re.sub(r"[^A-Za-z0-9]+", "-", board.dataset).strip("-").lower()
    return f".eval_results/roborecover-{name}.yaml"


def push_results(repo_id: str, path: str, text: str) -> str:
    """Commits the file to a model's repository.

    Args:
        repo_id: the model on the Hub.
        path: in the repository.
        text: the file.

    Returns:
        Address of the commit.

    Raises:
        ScenarioError: the Hub refuses, or does not answer.
    """
    from huggingface_hub import HfApi

    from lerobot_roborecover.datasets.retries import again

    commit = again(
        lambda: HfApi().upload_file(
            path_or_fileobj=text.encode(),
            path_in_repo=path,
            repo_id=repo_id,
            repo_type="model",
            commit_message="RoboRecover evaluation results",
        ),
        f"Hub model {repo_id}: pushing {path}",
    )
    return commit.commit_url
