"""LeRobot policies that misbehave, under `evaluate()` and `roborecover eval`."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import threading

import pytest

import lerobot_roborecover as roborecover
from lerobot_roborecover.cli.main import main
from lerobot_roborecover.evaluation.first_trials import PolicyFailedError
from lerobot_roborecover.logs.trial_log import read_trial_log
from tests.support.factories import fake_dataset, save_policy
from tests.support.processes import PATIENCE_S

pytestmark = pytest.mark.lerobot

COUNT, TRIALS = 2, 2


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", COUNT, horizon=6)


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    return {kind: save_policy(tmp_path_factory.mktemp(kind), kind) for kind in ("act", "diffusion")}


METHODS = {"act": "predict_action_chunk", "diffusion": "select_action"}
"""A policy that is asked about a batch, and one that is asked about a trial at a time."""


@pytest.fixture
def spoil(monkeypatch):
    """Replaces what a kind of policy gives."""
    from lerobot.policies import get_policy_class

    def put(kind, change):
        kind_of_policy = get_policy_class(kind)
        good = getattr(kind_of_policy, METHODS[kind])
        monkeypatch.setattr(
            kind_of_policy, METHODS[kind], lambda *args, **options: change(good(*args, **options))
        )

    return put


def bad_tensors():
    import torch

    return {
        "a row": (lambda t: t[:1] if len(t) > 1 else torch.cat([t, t]), "for a batch of"),
        "one column": (lambda t: t[..., :1], "1) for a batch of"),
        "no columns": (lambda t: t[..., :0], "0) for a batch of"),
        "an axis less": (lambda t: t[0], "for a batch of"),
        "an axis more": (lambda t: t[None], "for a batch of"),
        "a column more": (lambda t: torch.cat([t, t[..., :1]], -1), ""),
        "complex": (lambda t: t + 1j, "complex64; actions are real numbers"),
        "truth values": (lambda t: t > 0, "bool; actions are real numbers"),
        "nothing": (lambda t: None, "gave a NoneType"),
        "a list": (lambda t: t.tolist(), "gave a list"),
        "NaN": (lambda t: t * float("nan"), "non-finite action [nan, nan]"),
        "infinity": (lambda t: t + float("inf"), "non-finite action"),
    }


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        ("act", ("a row", "one column", "complex")),
        pytest.param("act", None, marks=pytest.mark.nightly),
        pytest.param(
            "diffusion",
            ("a row", "one column", "an axis less", "complex", "nothing"),
            marks=pytest.mark.nightly,
        ),
    ],
)
def test_what_evaluate_makes_of_bad_tensors(dataset, checkpoints, spoil, kind, names):
    """One column would be broadcast by the normalisation, and one row to the whole batch."""
    now = [lambda tensor: tensor]
    spoil(kind, lambda tensor: now[0](tensor))
    bad = bad_tensors()
    for name in names or bad:
        now[0], words = bad[name]
        with pytest.raises(PolicyFailedError, match=r"first 3 trials .* same policy error") as told:
            roborecover.evaluate(checkpoints[kind], dataset, trials=TRIALS, slots=2, progress=False)
        assert words in str(told.value)


@pytest.mark.nightly
def test_evaluate_comes_back_from_a_policy_that_blocks(dataset, checkpoints, spoil, caplog):
    release = threading.Event()
    spoil("act", lambda tensor: release.wait())
    rows = roborecover.evaluate(
        checkpoints["act"], dataset, trials=TRIALS, slots=2, progress=False, env={"policy_watchdog_s": 5.0}
    )
    release.set()
    assert 1 <= len(rows) <= 2
    assert {r.outcome for r in rows} == {"policy_error"}
    assert all("did not answer within 5 s" in r.reason for r in rows)
    assert "could not be run, and have no row" in caplog.text


@pytest.mark.parametrize(
    ("extra", "status"),
    [pytest.param("--env.policy_watchdog_s=5", 1, marks=pytest.mark.nightly), ("--limit-seconds=1", 0)],
)
def test_the_command_ends_where_the_policy_blocks(
    dataset, checkpoints, spoil, tmp_path, capsys, extra, status
):
    release = threading.Event()
    spoil("act", lambda tensor: release.wait())
    arguments = [
        "--env", "roborecover_fake", f"--env.scenarios={dataset}", f"--policy.path={checkpoints['act']}",
        "--policy.device=cpu", f"--eval.n_episodes={TRIALS}", "--runner.slots=2",
        f"--output_dir={tmp_path / 'out'}",
    ]  # fmt: skip
    assert main(["eval", *arguments, extra]) == status
    release.set()
    said = capsys.readouterr().err
    rows = read_trial_log(tmp_path / "out" / "trials.jsonl")
    if status:
        assert {r.outcome for r in rows} == {"policy_error"}
        assert "could not be run, and left no row" in said
    else:
        assert rows == []
        assert "time limit reached: 0 of 4 trials done" in said
    assert "run the same command with --env.trial_log=" in said
    assert (tmp_path / "out" / "eval_info.json").exists()


@pytest.mark.nightly
def test_the_process_ends_where_the_policy_blocks(dataset, checkpoints, tmp_path):
    program = """
        import sys, time
        from lerobot.policies.act.modeling_act import ACTPolicy
        from lerobot_roborecover.cli.main import main

        ACTPolicy.predict_action_chunk = lambda *_, **__: time.sleep(10**6)
        sys.exit(main())
    """
    done = subprocess.run(
        [
            sys.executable, "-c", textwrap.dedent(program), "eval", "--env", "roborecover_fake",
            f"--env.scenarios={dataset}", f"--policy.path={checkpoints['act']}", "--policy.device=cpu",
            "--eval.n_episodes=1", "--runner.slots=1", "--env.policy_watchdog_s=5",
            f"--output_dir={tmp_path / 'out'}",
        ],
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert "1 trial could not be run, and left no row" in done.stderr
    (row,) = read_trial_log(tmp_path / "out" / "trials.jsonl")
    assert row.outcome == "policy_error"
