"""Run by `test_outside_platform` in a process that has the example platform: every command, one import.

python -m tests.support.outside_chain FOLDER
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.env.trial_log import read_trial_log
from tests.support.factories import save_policy

STEP = 30
TRIALS = 1


def outcomes(folder: Path) -> list[tuple[str, str, int]]:
    """Scenario, outcome and steps of every trial."""
    rows = read_trial_log(folder / "trials.jsonl")
    return sorted((row.scenario_id, str(row.outcome), row.steps) for row in rows)


def chain(root: Path) -> dict:
    """Collects, labels, screens, evaluates in both ways, and reports."""
    assert main([
        "collect", "--env.type=roborecover_crane", "--expert", "hurried", "--task", "harbour",
        "--seeds", "0-1", "--horizon", "50", "--frames", "none", "--slots", "1",
        "--out", str(root / "candidates"),
    ]) == 0  # fmt: skip
    found = read_candidates(root / "candidates")
    labelled = [found.scenario(name, STEP, "Move", "Wrong Pose", {}) for name in found.by_id]
    write_scenarios(root / "labelled", labelled, description="labelled by a test")
    widths = {"state": 4, "env_state": 1, "action": 1}
    policy = save_policy(root / "policy", **widths)
    assert main([
        "screen", str(root / "labelled"), "--policy", f"p={policy}", "--trials", "2", "--keep", "0", "2",
        "--deterministic", "p", "--slots", "1", "--device", "cpu", "--out", str(root / "screened"),
    ]) == 0  # fmt: skip
    common = [
        "--env", "roborecover_crane", f"--env.scenarios={root / 'screened'}", f"--policy.path={policy}",
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
        "roborecover_eval": outcomes(root / "ours"),
    }  # fmt: skip


if __name__ == "__main__":
    print(json.dumps(chain(Path(sys.argv[1]))))
