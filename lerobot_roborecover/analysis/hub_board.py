"""A benchmark's leaderboard as it stands on the Hub, beside what local trial logs say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lerobot_roborecover.analysis.board import Board, Entry
from lerobot_roborecover.analysis.hub_results import rates_of
from lerobot_roborecover.analysis.leaderboard import Leaderboard
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.tables import Column, Table
from lerobot_roborecover.datasets.benchmark import TASKS
from lerobot_roborecover.datasets.load import HUB_ID


@dataclass(frozen=True)
class HubResult:
    """One result of one model, as the Hub gives it."""

    model: str
    """ "org/name"."""
    task: str
    """Id in the benchmark's `eval.yaml`."""
    value: float
    """Per cent."""
    revision: str | None
    """Revision of the scenario set."""
    pull_request: int | None
    """Number, where it is offered and not merged."""
    notes: str


def read_board(dataset_id: str) -> list[HubResult]:
    """All results that models on the Hub give for a scenario set.

    Args:
        dataset_id: "org/name".

    Raises:
        RowsError: no id, or an answer of another form.
        ScenarioError: the Hub refuses, or does not answer.
    """
    from huggingface_hub import HfApi

    from lerobot_roborecover.datasets.retries import retry

    if not HUB_ID.fullmatch(dataset_id):
        raise RowsError(f"{dataset_id!r:.120} is no data set on the Hub; write it like org/name")
    api, where = HfApi(), f"Hub dataset {dataset_id}"
    # Fine-tuned models are what is evaluated here; the Hub leaves them out unless asked.
    ranked = retry(
        lambda: api.get_dataset_leaderboard(dataset_id, base_model_only=False), f"{where}: its leaderboard"
    )
    found: list[HubResult] = []
    for place in {entry.model_id: entry for entry in ranked}.values():
        info = retry(
            lambda model=place.model_id: api.model_info(model, expand=["evalResults"]),
            f"Hub model {place.model_id}",
        )
        for result in info.eval_results or ():
            if result.dataset_id != dataset_id:
                continue
            if isinstance(result.value, bool) or not isinstance(result.value, int | float):
                raise RowsError(
                    f"Hub model {place.model_id}: the value of {result.task_id} is {result.value!r:.60}, not "
                    "a number. Its owners can put it right"
                )
            found.append(
                HubResult(
                    place.model_id,
                    result.task_id,
                    float(result.value),
                    result.dataset_revision,
                    place.pull_request,
                    result.notes or "",
                )
            )
    return found


def comparison_table(dataset_id: str, results: Sequence[HubResult], local: Leaderboard) -> Table:
    """The Hub's results beside the local ones of the same policies.

    Args:
        dataset_id: the scenario set on the Hub.
        results: of `read_board`.
        local: boards of local logs.
    """
    entries = [
        (board, entry)
        for board in local.boards
        for entry in board.entries
        if entry.provenance.dataset == dataset_id
    ]
    order = {task: n for n, task in enumerate(TASKS)}
    rows = []
    for result in sorted(results, key=lambda r: (order.get(r.task, len(order)), -r.value, r.model)):
        match = _entry_of(result, entries)
        rate = rates_of(match[1]).get(result.task) if match else None
        rows.append(
            (
                result.model,
                result.task,
                result.value / 100,
                rate,
                _verdict(result, match, rate),
                f"pull request {result.pull_request}" if result.pull_request else "merged",
            )
        )
    columns = (
        Column("Model"), Column("Result"), Column("On the Hub %", "percent"), Column("Here %", "percent"),
        Column("Compared"), Column("State"),
    )  # fmt: skip
    notes = (
        "Compared with the local log of the policy that the notes name, or that is called as the model: "
        "the same to two decimals; within the local interval; or outside it.",
    )
    return Table("hub_board", f"Results for {dataset_id} on the Hub", columns, tuple(rows), notes)


def _entry_of(result: HubResult, entries: Sequence[tuple[Board, Entry]]) -> tuple[Board, Entry] | None:
    """The local entry that a result was made from, or that is of the same model."""
    named = [e for e in entries if f"policy {e[1].policy};" in result.notes]
    called = [e for e in entries if e[1].policy.split("@")[0] == result.model]
    return next(iter(named or called), None)


def _verdict(result: HubResult, match: tuple[Board, Entry] | None, rate: Estimate | None) -> str:
    if match is None or rate is None or rate.value != rate.value:
        return "no local trials"
    revision = match[1].provenance.dataset_revision
    if result.revision and revision and result.revision != revision:
        return f"another revision of the set ({result.revision[:12]})"
    if abs(result.value - 100 * rate.value) < 0.005 + 1e-9:
        return "the same"
    inside = rate.low <= result.value / 100 <= rate.high
    return "within the interval" if inside else "outside the interval"
