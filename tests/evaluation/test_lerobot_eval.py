"""The user's own command, through LeRobot's own parser, loaders and evaluation loop."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_roborecover.logs.trial_log import read_trial_log
from tests.support.factories import fake_dataset, save_policy
from tests.support.loop import outcomes

pytestmark = pytest.mark.lerobot


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", 4, horizon=20)


@pytest.fixture(scope="module")
def act(tmp_path_factory):
    return save_policy(tmp_path_factory.mktemp("act"), "act")


@pytest.fixture(scope="module")
def diffusion(tmp_path_factory):
    return save_policy(tmp_path_factory.mktemp("diffusion"), "diffusion")


@pytest.fixture
def lerobot_eval(run_lerobot_eval, dataset):
    """`lerobot-eval` on the fake set; returns the output folder."""

    def run(
        policy: Path, *args: str, out: str = "out", env: tuple[str, ...] = ("--env", "roborecover_fake")
    ) -> Path:
        common = (f"--env.scenarios={dataset}", f"--policy.path={policy}", "--eval.use_async_envs=false")
        return run_lerobot_eval(*env, *common, *args, out=out)

    return run


def test_scenario_ids_are_the_task_ids(lerobot_eval, act):
    out = lerobot_eval(act, "--eval.n_episodes=2", "--eval.batch_size=2")
    info = json.loads((out / "eval_info.json").read_text())
    rows = read_trial_log(out / "trials.jsonl")
    assert {t["task_id"] for t in info["per_task"]} == {r.scenario_id for r in rows}
    assert info["overall"]["n_episodes"] == len(rows) == 8
    by_id = {t["task_id"]: t["metrics"]["successes"] for t in info["per_task"]}
    for row in rows:
        assert by_id[row.scenario_id][row.trial] == row.success
        assert row.execution_horizon == 2
        assert row.run_seed == 1000
        assert row.policy.startswith(f"{act.name}@")


@pytest.mark.parametrize("group", ["suite", "cell", "source"])
def test_groups(lerobot_eval, act, group):
    out = lerobot_eval(act, f"--env.group_by={group}", "--eval.n_episodes=1")
    groups = set(json.loads((out / "eval_info.json").read_text())["per_group"])
    expected = {
        "suite": {"toy"},
        "source": {"natural", "perturbed"},
        "cell": {"Approach-Wrong_Pose", "Place-Wrong_Target", "Move-Wrong_Pose"},
    }
    assert groups == expected[group]


def test_all_spellings_of_the_env_argument_agree(lerobot_eval, act):
    spellings = [("--env", "roborecover_fake"), ("--env=roborecover_fake",), ("--env.type=roborecover_fake",)]
    results = [
        outcomes(
            read_trial_log(lerobot_eval(act, "--eval.n_episodes=1", out=str(i), env=env) / "trials.jsonl")
        )
        for i, env in enumerate(spellings)
    ]
    assert results[0] == results[1] == results[2]


@pytest.mark.nightly
def test_a_stock_stochastic_policy_at_batch_1_depends_on_the_trial_alone(lerobot_eval, diffusion, tmp_path):
    common = ("--eval.n_episodes=3", "--eval.batch_size=1")
    whole = read_trial_log(lerobot_eval(diffusion, *common, out="a") / "trials.jsonl")
    assert {r.noise for r in whole} == {"per_trial"}
    assert len({r.actions_sha256 for r in whole}) == len(whole) == 12, "the policy must be stochastic"
    shards = []
    for k in range(2):
        out = lerobot_eval(diffusion, *common, f"--env.shard={k}/2", out=f"s{k}")
        shards += read_trial_log(out / "trials.jsonl")
    assert outcomes(shards) == outcomes(whole)
    # Resumed: keep every third line, in the order they were written, and run again.
    partial = tmp_path / "partial.jsonl"
    lines = (tmp_path / "a" / "trials.jsonl").read_text().splitlines()
    partial.write_text("".join(line + "\n" for line in lines[::3]))
    lerobot_eval(diffusion, *common, f"--env.trial_log={partial}", out="r")
    assert outcomes(read_trial_log(partial)) == outcomes(whole)
    other = read_trial_log(lerobot_eval(diffusion, *common, "--seed=7", out="seed") / "trials.jsonl")
    assert {r.actions_sha256 for r in other}.isdisjoint({r.actions_sha256 for r in whole})


def test_a_stochastic_policy_in_a_batch_is_marked(lerobot_eval, diffusion):
    rows = read_trial_log(
        lerobot_eval(diffusion, "--eval.n_episodes=2", "--eval.batch_size=2") / "trials.jsonl"
    )
    assert {r.noise for r in rows} == {"per_batch"}


def test_a_resumed_run_reports_what_was_logged(lerobot_eval, act):
    first = lerobot_eval(act, "--eval.n_episodes=2", out="a")
    info = json.loads((first / "eval_info.json").read_text())
    again = lerobot_eval(act, "--eval.n_episodes=2", f"--env.trial_log={first / 'trials.jsonl'}", out="b")
    resumed = json.loads((again / "eval_info.json").read_text())
    for a, b in zip(info["per_task"], resumed["per_task"], strict=True):
        assert (a["task_id"], a["metrics"]["successes"]) == (b["task_id"], b["metrics"]["successes"])
    assert len(read_trial_log(first / "trials.jsonl")) == 8


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (
            ("--eval.n_episodes=5", "--eval.batch_size=2"),
            r"batch_size=2 does not divide .*n_episodes=5.*\[1, 5\]",
        ),
        (("--env.select=suite=nowhere",), "nowhere"),
        (("--env.start=middle",), r"start=middle.*recovery"),
        (("--env.shard=4/4",), "0 <= k < n"),
        (("--env.shard=5/9",), "cannot fill 9 shards"),
        (("--env.max_parallel_tasks=2",), "must be 1"),
        (("--env.group_by=colour",), "group_by=colour"),
        (("--env.watchdog_s=0",), "watchdog_s=0"),
    ],
)
def test_bad_options_are_refused_before_a_simulator_starts(lerobot_eval, act, args, words, monkeypatch):
    from lerobot_roborecover.workers import slots

    def no_simulator(*_):
        raise AssertionError("a simulator was started")

    monkeypatch.setattr(slots.InlineSlot, "__init__", no_simulator)
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # a batch that LeRobot itself would choose is not refused
    with pytest.raises(Exception, match=f"(?s){words}"):
        lerobot_eval(act, *args)


@pytest.mark.slow
def test_the_installed_command_finds_the_plugin(dataset, act, tmp_path):
    """A plain, non-editable install, found by stock LeRobot under the user's spelling, in fresh processes."""
    site = plain_install(tmp_path)
    script = Path(sys.executable).with_name("lerobot-eval")
    result = subprocess.run(
        [
            str(script), "--env", "roborecover_fake", f"--env.scenarios={dataset}", f"--policy.path={act}",
            "--policy.device=cpu", "--eval.n_episodes=2", "--eval.batch_size=2",
            f"--output_dir={tmp_path / 'out'}",
        ],
        capture_output=True, text=True, cwd=tmp_path, check=False,
        env={**os.environ, "PYTHONPATH": str(site)},
    )  # fmt: skip
    assert result.returncode == 0, result.stderr[-3000:]
    rows = read_trial_log(tmp_path / "out" / "trials.jsonl")
    assert len(rows) == 8
    assert {r.handoff_identical for r in rows} == {True}


def plain_install(tmp_path: Path) -> Path:
    """Builds the wheel from a copy of the tree and unpacks it, as `pip install` would, ahead of any editable
    one."""
    import zipfile

    root = Path(__file__).parents[2]
    tree = tmp_path / "tree"
    skip = shutil.ignore_patterns("__pycache__", "*.egg-info", "*_recovery")  # the large sets
    shutil.copytree(root / "lerobot_roborecover", tree / "lerobot_roborecover", ignore=skip)
    for name in ("pyproject.toml", "README.md", "LICENSE", "lerobot_env_roborecover.py"):
        shutil.copy(root / name, tree)
    code = "import sys, setuptools.build_meta as b; print(b.build_wheel(sys.argv[1]))"
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], cwd=tree, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    assert list(tmp_path.glob("site/lerobot_roborecover/data/*_starter/**/scenarios.parquet"))
    code = "import lerobot_roborecover; print(lerobot_roborecover.__file__)"
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path / "site")},
    )  # fmt: skip
    assert found.stdout.startswith(str(tmp_path / "site"))
    return tmp_path / "site"
