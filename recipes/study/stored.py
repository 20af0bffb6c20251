"""The report of stored outcomes: a study's tables again from `outcomes.csv`, without a trial being run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.logs.row import EvalProtocol, make_row
from lerobot_roborecover.scenario import Outcome, ScenarioError, Start
from lerobot_roborecover.utils.atomic_io import atomic_write
from recipes.study.arms import StudyArm, arms
from recipes.study.definition import StudyDefinition
from recipes.study.outcomes import read_outcomes

if TYPE_CHECKING:
    from lerobot_roborecover.analysis.results import Results
    from lerobot_roborecover.analysis.tables import Table


def write_stored_logs(study: StudyDefinition, out: Path) -> list[StudyArm]:
    """Writes the stored outcomes as trial logs, one an arm.

    What `outcomes.csv` does not say is not in them: times, handoff errors, when an intervention acted.

    Args:
        study: what.
        out: folder; its own, never that of a run.

    Returns:
        The arms.

    Raises:
        ScenarioError: nothing is stored, or an outcome is of no scenario of the study.
    """
    if not study.outcomes.exists():
        raise ScenarioError(
            f"{study.root} has no stored outcomes; run the study without --use-stored-outcomes"
        )
    stored = read_outcomes(study.outcomes)
    dataset = load_scenarios(study.scenarios, split=study.split)
    scenarios = {s.id: s for s in dataset}
    found = list(arms(study, out))
    by_label: dict[str, list[str]] = {arm.label: [] for arm in found}
    names = {arm.label: arm for arm in found}
    for (label, scenario_id, trial), (outcome, steps) in sorted(stored.items()):
        if label not in names or scenario_id not in scenarios or outcome not in list(Outcome):
            raise ScenarioError(
                f"{study.outcomes}: {label} {scenario_id} {outcome} is no outcome of this study's arms and "
                "scenarios; it was stored by another version of it. Run the study without "
                "--use-stored-outcomes"
            )
        arm, scenario = names[label], scenarios[scenario_id]
        options = dict(study.env)
        if arm.name in study.interventions:
            options["intervention"] = arm.name
        row = make_row(
            scenario,
            EvalProtocol(arm.start, 0, arm.name, None, None, options=options),
            dataset=study.root.name,
            dataset_revision=None,
            trial=trial,
            noise="unseeded",
            batch_size=1,
            outcome=Outcome(outcome),
            reason="" if Outcome(outcome).valid else "stored without its reason",
            steps=steps,
            handoff=None,
            sim_s=0.0,
            policy_s=0.0,
            actions_sha256="",
        )
        if arm.start == Start.RECOVERY:
            row = replace(row, handoff_step=len(scenario.prefix))
        by_label[label].append(json.dumps(asdict(row)))
    for arm in found:
        atomic_write(arm.log, "".join(f"{line}\n" for line in by_label[arm.label]))
    return found


def summary_tables(study: StudyDefinition, done: Sequence[StudyArm]) -> str:
    """Returns the tables of README.md and of the study's page as Markdown: policies, inverted pairs, and the
    gains of interventions, over tasks and by controller.

    Args:
        study: what.
        done: arms with logs.
    """
    from lerobot_roborecover.analysis.analyse import analyse
    from lerobot_roborecover.analysis.gain_tables import gain_tables, inversions
    from lerobot_roborecover.analysis.logs import read_study
    from lerobot_roborecover.analysis.options import Options
    from lerobot_roborecover.analysis.report_tables import interventions
    from lerobot_roborecover.analysis.tables import to_markdown

    options = Options(baseline=study.base, interventions=study.interventions)
    results = analyse(read_study([f"{arm.name}={arm.log}" for arm in done]), options)
    tables = [_policies(results)]
    if len(results.matched) > 1:
        tables.append(inversions(results))
    if results.costs:
        tables += [interventions(results), *gain_tables(results)]
    return "\n".join(to_markdown(table) for table in tables)


def _policies(results: Results) -> Table:
    from lerobot_roborecover.analysis.policy_tables import overall
    from lerobot_roborecover.analysis.tables import Cell, Table

    whole = overall(results)
    wanted = [
        i
        for i, column in enumerate(whole.columns)
        if column.title.startswith(("Policy", "Initial", "RSR %", "Macro", "Retention"))
        and "without" not in column.title
    ]
    places: dict[Cell, int] = {results.ranked.arms[p]: place for place, p in enumerate(results.best_first)}
    rows = sorted(whole.rows, key=lambda row: places.get(row[0], len(places)))
    return Table(
        "overall",
        "The study's policies",
        tuple(whole.columns[i] for i in wanted),
        tuple(tuple(row[i] for i in wanted) for row in rows),
    )
