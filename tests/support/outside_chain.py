"""A platform through every command, in one process, with one import of LeRobot; see the tests that run it.

python -m tests.support.outside_chain FOLDER CHAIN
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.datasets import load_scenarios, write_scenarios
from lerobot_roborecover.logs.trial_log import read_trial_log
from tests.support.factories import save_policy

STEP = 30
TRIALS = 1


@dataclass(frozen=True)
class Pipeline:
    """What differs from platform to platform."""

    env: str
    """Env type."""
    options: Sequence[str]
    """Of it, without `--env.`."""
    collect: Sequence[str]
    """Who drives, and from where."""
    widths: Mapping[str, Any]
    """Of the policy's inputs and output."""
    horizon: int = 50


CHAINS = {
    "crane": Pipeline(
        "roborecover_crane", (), ("--expert", "hurried", "--task", "harbour", "--seeds", "0-1"),
        {"state": 4, "env_state": 1, "action": 1},
    ),
    "pusht": Pipeline(
        "roborecover_lerobot", ("base.type=pusht", "obs_type=state"),
        ("--expert", "expert_biased", "--perturb", "--task", "pusht", "--seeds", "0-3"),
        {"state": 2, "env_state": 16, "action": 2}, 40,
    ),
    "aloha": Pipeline(
        "roborecover_lerobot", ("base.type=aloha", "base.task=AlohaTransferCube-v0"),
        ("--expert", "expert_biased", "--perturb", "--task", "*Transfer*", "--seeds", "0-3"),
        {"state": 14, "env_state": 0, "action": 14, "images": ("observation.images.top",)}, 40,
    ),
}  # fmt: skip


def outcomes(folder: Path) -> list[tuple[str, str, int]]:
    """Scenario, outcome and steps of every trial."""
    rows = read_trial_log(folder / "trials.jsonl")
    return sorted((row.scenario_id, str(row.outcome), row.steps) for row in rows)


def run(root: Path, chain: Pipeline) -> dict:
    """Collects, labels, screens, validates, divides, evaluates in both ways, and reports."""
    options = [f"--env.{option}" for option in chain.options]
    assert main([
        "collect", f"--env.type={chain.env}", *options, *chain.collect, "--horizon", str(chain.horizon),
        "--frames", "none", "--slots", "1", "--out", str(root / "candidates"),
    ]) == 0  # fmt: skip
    found = read_candidates(root / "candidates")
    labelled = [found.scenario(name, STEP, "Move", "Wrong Pose", {}) for name in found.by_id]
    write_scenarios(root / "labelled", labelled, description="labelled by a test")
    policy = save_policy(root / "policy", **chain.widths)
    plain = [word for option in chain.options for word in ("--env", option)]
    assert main([
        "screen", str(root / "labelled"), "--policy", f"p={policy}", "--trials", "2", "--keep", "0", "2",
        "--deterministic", "p", "--slots", "1", "--device", "cpu", *plain, "--out", str(root / "screened"),
    ]) == 0  # fmt: skip
    final = root / "screened"
    if len(labelled) > 3:
        assert main([
            "validate", str(final), "--trials-folder", str(root / "screened.trials"), "--runs", "1",
            "--no-frames", "--out", str(root / "validated"),
        ]) == 0  # fmt: skip
        final = root / "split"
        assert main([
            "split", str(root / "validated"), "--train", "1", "--test", "3", "--out", str(final),
        ]) == 0  # fmt: skip
    common = [
        "--env", chain.env, *options, f"--env.scenarios={final}", f"--policy.path={policy}",
        "--policy.device=cpu", f"--eval.n_episodes={TRIALS}", "--eval.batch_size=1",
    ]  # fmt: skip
    sys.argv = ["roborecover"]
    assert main(["eval", *common, "--runner.slots=1", f"--output_dir={root / 'ours'}"]) == 0

    from lerobot.scripts import lerobot_eval

    import lerobot_roborecover.plugin as plugin

    stock = ["lerobot-eval", *common, "--eval.use_async_envs=false", f"--output_dir={root / 'stock'}"]
    sys.argv = plugin.rewrite_env_argument(stock)
    lerobot_eval.eval_main()
    assert main(["report", str(root / "ours" / "trials.jsonl"), "--out", str(root / "report")]) == 0
    return {
        "candidates": len(found), "lerobot_eval": outcomes(root / "stock"),
        "roborecover_eval": outcomes(root / "ours"), "tested": load_scenarios(str(final), split="test").ids,
    }  # fmt: skip


if __name__ == "__main__":
    print(json.dumps(run(Path(sys.argv[1]), CHAINS[sys.argv[2]])))
