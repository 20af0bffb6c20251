"""A rerun into the same log after something was put right: its trials run again, and are never mixed."""

from __future__ import annotations

import json
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.logs.trial_log import read_trial_log
from tests.support.factories import fake_dataset, save_policy
from tests.support.policy_servers import OpenpiServer
from tests.support.trial_rows import write_log

pytestmark = pytest.mark.lerobot
COUNT = 2


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", COUNT, horizon=8)


@pytest.fixture
def run(dataset, tmp_path, capfd):
    """Runs the command into one log; returns the log's rows, and what was printed."""

    def call(*extra: str, status: int = 0):
        argv = [
            "eval", "--env", "roborecover_fake", f"--env.scenarios={dataset}", "--eval.n_episodes=1",
            "--runner.slots=1", f"--output_dir={tmp_path / 'out'}",
            f"--env.trial_log={tmp_path / 'trials.jsonl'}", *extra,
        ]  # fmt: skip
        assert main(argv) == status
        printed = capfd.readouterr()
        rows = read_trial_log(tmp_path / "trials.jsonl")
        info = json.loads((tmp_path / "out" / "eval_info.json").read_text())
        assert info["overall"]["n_episodes"] == COUNT, "the table is of this run alone"
        return rows, printed.out + printed.err

    return call


def _statistics(policy: Path) -> Path:
    (file,) = policy.glob("policy_postprocessor*.safetensors")
    return file


def _shift_actions(policy: Path) -> None:
    """Gives the postprocessor another mean of the actions."""
    from safetensors.numpy import load_file, save_file

    found = load_file(_statistics(policy))
    save_file({k: v + 5 if k.endswith("action.mean") else v for k, v in found.items()}, _statistics(policy))


def test_corrected_statistics(run, tmp_path):
    policy = save_policy(tmp_path / "act")
    right = _statistics(policy).read_bytes()
    _shift_actions(policy)
    wrong, _ = run(f"--policy.path={policy}")
    assert len(wrong) == COUNT
    _statistics(policy).write_bytes(right)
    rows, printed = run(f"--policy.path={policy}")
    assert len(rows) == 2 * COUNT
    assert f"{COUNT} row(s) of this policy under other settings are in" in printed
    assert "are not reused" in printed
    assert len({r.policy for r in rows}) == 2
    assert {r.actions_sha256 for r in rows[:COUNT]}.isdisjoint(r.actions_sha256 for r in rows[COUNT:])
    again, _ = run(f"--policy.path={policy}")
    assert again == rows, "the corrected ones are there"


@pytest.mark.nightly
def test_another_number_of_inference_steps(run, tmp_path, capfd):
    policy = save_policy(tmp_path / "diffusion", "diffusion")
    run(f"--policy.path={policy}", "--policy.num_inference_steps=3")
    rows, printed = run(f"--policy.path={policy}", "--policy.num_inference_steps=4")
    assert len(rows) == 2 * COUNT
    assert "under other settings" in printed
    assert [r.policy_settings["num_inference_steps"] for r in rows] == [3] * COUNT + [4] * COUNT
    rows, _ = run(f"--policy.path={policy}")
    assert "num_inference_steps" not in rows[-1].policy_settings, "as saved"
    assert main(["report", str(tmp_path / "trials.jsonl"), "--out", str(tmp_path / "report")]) == 0
    text = (tmp_path / "report" / "report.md").read_text()
    for label in ("[num_inference_steps=3]", "[num_inference_steps=4]", "[num_inference_steps as saved]"):
        assert label.strip("[]") in text
    assert main(["merge", str(tmp_path / "trials.jsonl"), "--out", str(tmp_path / "m.jsonl")]) == 2
    assert "policy setting num_inference_steps is 3" in capfd.readouterr().err


def test_a_corrected_rename_map(run, tmp_path):
    policy = save_policy(tmp_path / "act")
    wrong = '--rename_map={"observation.image": "observation.images.wrong"}'
    right = '--rename_map={"observation.image": "observation.images.right"}'
    run(f"--policy.path={policy}", wrong)
    rows, printed = run(f"--policy.path={policy}", right)
    assert len(rows) == 2 * COUNT
    assert "under other settings" in printed


MAPPING = "version: 1\nabout: a server\nstate: [{key: state, parts: [{source: observation.state}]}]\n"


@contextmanager
def _server(metadata=None):
    """A server whose actions are zero."""
    server = OpenpiServer(lambda *_: {"actions": np.zeros((8, 2), np.float32)}, metadata)
    with server.running() as url:
        yield f"--policy.url={url}"


@pytest.mark.nightly
def test_a_corrected_mapping_and_another_server(run, tmp_path):
    mapping = tmp_path / "mine.yaml"
    mapping.write_text(MAPPING + "actions: {scale: [1.0, 2.0]}\n")
    remote = ["--policy.type=roborecover_remote", f"--policy.mapping={mapping}", "--policy.name=mine"]
    with _server() as url:
        rows, printed = run(*remote, url)
        assert rows[0].policy_settings["server_weights"] == "not known"
        rows, printed = run(*remote, url)
        assert len(rows) == COUNT
        assert f"no identity: {COUNT} row(s) of mine in" in printed
        mapping.write_text(MAPPING)
        rows, printed = run(*remote, url)
    assert len(rows) == 2 * COUNT
    assert "under other settings" in printed
    with _server({"identity": "pi0@1"}) as url:
        rows, _ = run(*remote, url)
    assert len(rows) == 3 * COUNT
    assert rows[-1].policy_settings["server"] == "pi0@1"
    with _server({"identity": "pi0@1"}) as url:
        assert len(run(*remote, url)[0]) == 3 * COUNT, "another port, the same policy"
    assert main(["report", str(tmp_path / "trials.jsonl"), "--out", str(tmp_path / "report")]) == 0
    assert "weights are not known" in (tmp_path / "report" / "report.md").read_text()


def test_rows_of_an_earlier_version(run, tmp_path):
    policy = save_policy(tmp_path / "act")
    rows, _ = run(f"--policy.path={policy}")
    old = [{**json.loads(line), "schema": 2} for line in (tmp_path / "trials.jsonl").read_text().splitlines()]
    for row in old:
        for name in ("first_state", "policy_settings", "run_scenarios", "run_trials", "shard"):
            del row[name]
        row["config_hash"] = "another"
    (tmp_path / "trials.jsonl").write_text("".join(json.dumps(row) + "\n" for row in old))
    rows, printed = run(f"--policy.path={policy}")
    assert len(rows) == 2 * COUNT
    assert f"{COUNT} row(s) of this policy in" in printed
    assert "written by an earlier version" in printed
    assert "--env.trial_log" in printed
    alone = write_log(tmp_path / "old.jsonl", [r for r in rows if r.policy_settings is None])
    assert main(["report", str(alone), "--out", str(tmp_path / "report")]) == 0
    assert main(["merge", str(alone), "--out", str(tmp_path / "m.jsonl")]) == 0


def test_random_weights_are_refused(dataset, tmp_path, capsys):
    from lerobot.configs.policies import PreTrainedConfig

    import lerobot_roborecover as roborecover
    from lerobot_roborecover.errors import OptionError

    policy = save_policy(tmp_path / "act")
    config = PreTrainedConfig.from_pretrained(policy)
    with pytest.raises(OptionError, match="names no checkpoint"):
        roborecover.evaluate(config, dataset, trials=1, progress=False, slots=1)
    config.pretrained_path = policy
    (row, *_) = roborecover.evaluate(config, dataset, trials=1, progress=False, slots=1)
    assert row.policy.startswith("act@")
    argv = ["eval", "--env", "roborecover_fake", f"--env.scenarios={dataset}", "--policy.type=act",
            f"--output_dir={tmp_path / 'out'}"]  # fmt: skip
    assert main(argv) == 2
    assert "its weights would be random" in capsys.readouterr().err


def test_an_object_and_a_name_are_known_by_content(dataset, tmp_path):
    import torch
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies import get_policy_class, make_pre_post_processors

    import lerobot_roborecover as roborecover

    saved = save_policy(tmp_path / "act")
    config = PreTrainedConfig.from_pretrained(saved)
    policy = get_policy_class("act").from_pretrained(saved, config=config)
    both = make_pre_post_processors(config, pretrained_path=str(saved))
    log = tmp_path / "trials.jsonl"
    options = {"trials": 1, "progress": False, "slots": 1, "log": log, "name": "mine"}
    roborecover.evaluate(policy, dataset, processors=both, **options)
    roborecover.evaluate(policy, dataset, processors=both, **options)
    assert len(read_trial_log(log)) == COUNT
    with torch.no_grad():
        policy.model.action_head.bias.add_(0.1)
    rows = roborecover.evaluate(policy, dataset, processors=both, **options)
    assert len(rows) == COUNT
    assert len(read_trial_log(log)) == 2 * COUNT
    assert {r.policy for r in rows} == {"mine"}
