"""A run as a record: its file and its command line are the same run, to LeRobot's own parser."""

from __future__ import annotations

import shlex
import sys

import pytest

from lerobot_roborecover.evaluation.spec import RunSpec
from tests.support.factories import save_policy

pytestmark = pytest.mark.lerobot


@pytest.fixture
def parse(monkeypatch):
    def run(*argv: str):
        from lerobot.configs import parser

        import lerobot_roborecover.plugin  # noqa: F401 - registers the env types
        from lerobot_roborecover.evaluation.runner import RecoveryEvalConfig
        from lerobot_roborecover.policies.metadata import policy_metadata

        for store in (parser._config_path_args, parser._config_yaml_overrides):
            store.clear()
        monkeypatch.setattr(sys, "argv", ["roborecover-eval", *argv])
        found = []

        def keep(cfg) -> None:
            found.append(cfg)

        keep.__annotations__["cfg"] = RecoveryEvalConfig
        parser.wrap()(keep)()
        return found[0], policy_metadata(found[0].policy)

    return run


@pytest.mark.parametrize("composite", [False, True])
def test_the_file_and_the_command_line_are_the_same_run(parse, tmp_path, composite):
    act = save_policy(tmp_path / "act")
    policy = {"path": act, "n_action_steps": 1, "device": "cpu"}
    if composite:
        base = {"path": act, "n_action_steps": 2}
        policy = {"type": "roborecover_intervention", "mode": "reversion", "base": base, "device": "cpu"}
    env = {"scenarios": tmp_path / "set", "split": "test", "start": "recovery", "select": "id=a|b"}
    run = RunSpec(
        "fake", {**env, "trial_log": tmp_path / "t.jsonl"}, policy, 3, tmp_path / "out",
        runner={"max_batch": 1, "cross_cpu_deterministic": True, "slots": 0},
    )  # fmt: skip
    command, *words = run.write(tmp_path / "out" / "run.yaml")
    assert command == "eval"
    from_file, facts = parse(*words)
    program, command, *words = shlex.split(run.command_line())
    assert (program, command) == ("roborecover", "eval")
    assert parse(*words) == (from_file, facts)
    assert (from_file.eval.n_episodes, from_file.runner.cross_cpu_deterministic, from_file.env.split) == (
        3,
        True,
        "test",
    )
    assert facts.execution_horizon == (2 if composite else 1)
    assert facts.policy.startswith("act@")
