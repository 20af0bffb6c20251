"""Trials of the fake simulator, played by its scripted expert or by noise: a policy that succeeds now and
then, without one being trained."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lerobot_roborecover.logs.row import EvalProtocol, LoggedTrial, actions_digest, make_row
from lerobot_roborecover.platforms import make_simulator, platform_named
from lerobot_roborecover.platforms.simulator import advance
from lerobot_roborecover.replay.handoff import Handoff
from lerobot_roborecover.scenario import Outcome, Scenario


def played_trial(scenario: Scenario, start: str, *, expert: bool, run_seed: int = 1000) -> LoggedTrial:
    """One trial.

    Args:
        scenario: of the fake simulator.
        start: `recovery` or `initial`.
        expert: whether the expert drives; else noise, which does not solve it.
        run_seed: of the run.
    """
    simulator = make_simulator("fake")
    simulator.reset(scenario.task, scenario.reset)
    first = len(scenario.prefix) if start == "recovery" else 0
    advance(simulator, scenario.prefix[:first])
    rng = np.random.default_rng(scenario.reset.seed)
    act = platform_named("fake").experts["expert"].make(simulator, scenario.task, rng)
    taken: list[np.ndarray] = []
    while len(taken) < scenario.task.horizon and not simulator.succeeded():
        way = act(len(taken)) if expert else rng.uniform(-0.2, 0.2, 2) - [0.0, 0.8]
        taken.append(np.asarray(way, np.float32))
        simulator.step(taken[-1])
    handoff = Handoff(first, 0.0, False, "", None, None, None, None)
    row = make_row(
        scenario, EvalProtocol(start, 0, "played", run_seed, None), dataset="played", dataset_revision=None,
        trial=0, noise="per_trial", batch_size=1,
        outcome=Outcome.SUCCESS if simulator.succeeded() else Outcome.HORIZON, reason="", steps=len(taken),
        handoff=handoff, sim_s=0.0, policy_s=0.0, actions_sha256=actions_digest(np.asarray(taken)),
    )  # fmt: skip
    return LoggedTrial(row, np.asarray(taken))


def played_trials(scenarios: Sequence[Scenario], start: str) -> list[LoggedTrial]:
    """One trial of each: the expert drives from the start, and from every second recovery point."""
    return [
        played_trial(s, start, expert=start == "initial" or i % 2 == 0)
        for i, s in enumerate(sorted(scenarios, key=lambda s: s.id))
    ]
