"""Rows of a demo's log."""

from dataclasses import asdict

from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.logs.row import EvalProtocol, make_row
from lerobot_roborecover.scenario import Outcome


def rows_of(dataset, outcomes: dict[str, list[str]], start: str = "recovery", **more) -> list[dict]:
    protocol = EvalProtocol(start=start, rewind_steps=0, policy="act@1", run_seed=1, execution_horizon=1)
    scenarios = load_scenarios(str(dataset))
    return [
        asdict(
            make_row(
                scenarios[scenario], protocol, dataset="x", dataset_revision=None, trial=k, batch_size=1,
                noise="per_trial", outcome=Outcome(outcome),
                reason="the <worker> died" if outcome == "sim_error" else "",
                steps=scenarios[scenario].task.horizon if outcome == "horizon" else 9,
                handoff=None, sim_s=0.0, policy_s=0.0, actions_sha256="",
            )
        )
        | more
        for scenario, trials in outcomes.items()
        for k, outcome in enumerate(trials)
    ]  # fmt: skip
