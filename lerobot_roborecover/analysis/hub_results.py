"""Results as the Hub's evaluation-results metadata: `.eval_results/*.yaml` beside a model's card.

The Hub shows such files on the model's page and on the benchmark data set's own leaderboard
(https://huggingface.co/docs/hub/eval-results).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path

from lerobot_roborecover.analysis.board import Board, Entry
from lerobot_roborecover.analysis.leaderboard import Leaderboard
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.datasets.benchmark import TASKS
from lerobot_roborecover.datasets.load import HUB_ID
from lerobot_roborecover.scenario import ScenarioError


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
            f"{len(entries)} entries fit --policy={policy}; exactly one result can be offered at "
            f"a time. There are: {names}"
        )
    return entries[0]


def results_yaml(board: Board, entry: Entry, dataset_id: str | None = None, source: str | None = None) -> str:
    """The file's text: RSR, Macro and, where there is one, the initial-state rate, in per cent.

    Args:
        board: where the entry stands.
        entry: the result.
        dataset_id: the scenario set's id on the Hub; by default the one in the logs.
        source: address of the published trial log.

    Raises:
        RowsError: the scenario set has no id on the Hub, or the entry is no complete result of the policy
        alone, or the source is no address.
    """
    import yaml
    from huggingface_hub import EvalResultEntry, eval_result_entries_to_yaml

    dataset = dataset_id or entry.provenance.dataset
    if not HUB_ID.fullmatch(dataset):
        raise RowsError(
            f"the scenario set {dataset!r} is not a data set on the Hub, which the metadata must "
            "name. Publish it "
            "(roborecover dataset publish) and evaluate from there, or say --dataset-id ORG/NAME"
        )
    if source is not None and not re.fullmatch(r"https?://\S+", source):
        raise RowsError(
            f"--source {source!r:.200}: write the address of the published trial log, https://..."
        )
    problem = (
        "is an intervention"
        if entry.interventions
        else "was stopped when a sequential comparison was decided"
        if entry.stopped
        else f"covers {entry.scenarios} of {board.scenarios} scenarios"
        if entry.scenarios < board.scenarios
        else f"is incomplete ({entry.missing})"
        if entry.missing
        else ""
    )
    if problem:
        raise RowsError(f"{entry.policy} {problem}: only complete results of a policy alone are offered")
    metrics = {task: rate for task, rate in rates_of(entry).items() if not math.isnan(rate.value)}
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
            source_url=source,
            source_name="RoboRecover trial log" if source else None,
            notes=_notes(entry, estimate, board),
        )
        for task, estimate in metrics.items()
    ]
    return yaml.safe_dump(eval_result_entries_to_yaml(entries), sort_keys=False, allow_unicode=True)


def rates_of(entry: Entry) -> dict[str, Estimate]:
    """An entry's rates in [0, 1] by the benchmark's ids of results; NaN where it has none."""
    return dict(zip(TASKS, (entry.rsr, entry.macro, entry.initial), strict=True))


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


def log_files(folder: Path, entry: Entry) -> dict[str, Path]:
    """The trial logs of an entry, by their path in the model's repository.

    Args:
        folder: where the logs of the leaderboard are.
        entry: the result.

    Raises:
        RowsError: it was made from several logs: there is one source of a result.
    """
    if len(entry.provenance.logs) > 1:
        raise RowsError(
            f"{entry.policy} was made from {len(entry.provenance.logs)} logs, and a result has one source. "
            "Merge them first (roborecover merge)"
        )
    ((name, digest),) = (log.rsplit(" ", 1) for log in entry.provenance.logs)
    return {f"roborecover/trials-{digest}.jsonl": folder / name}


def file_address(repo_id: str, path: str) -> str:
    """Where a file of a model's repository is shown once it is merged."""
    from huggingface_hub import HfApi

    return f"{HfApi().endpoint}/{repo_id}/blob/main/{path}"


def offer_results(repo_id: str, files: Mapping[str, bytes | Path]) -> str:
    """Opens a pull request at a model's repository, which its owners merge or not.

    Args:
        repo_id: the model on the Hub.
        files: by path in the repository.

    Returns:
        Address of the pull request.

    Raises:
        ScenarioError: the Hub refuses, or does not answer.
    """
    from huggingface_hub import CommitOperationAdd, HfApi

    from lerobot_roborecover.datasets.retries import retry

    where = f"Hub model {repo_id}"
    operations = [
        CommitOperationAdd(path, str(content) if isinstance(content, Path) else content)
        for path, content in files.items()
    ]
    commit = retry(
        lambda: HfApi().create_commit(
            repo_id,
            operations,
            commit_message="RoboRecover evaluation results",
            commit_description="Success from recovery points, measured with RoboRecover; the notes of each "
            "result say on how many scenarios and trials, and with which versions.",
            create_pr=True,
        ),
        f"{where}: offering {', '.join(files)}",
    )
    if not commit.pr_url:
        raise ScenarioError(f"{where}: the Hub opened no pull request; look at its community page")
    return commit.pr_url
