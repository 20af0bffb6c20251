"""The averaged weights of Correction's training: as defined, saved, resumed and exported."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from tests.support.factories import fake_scenario
from tests.support.training import lerobot_train

pytestmark = pytest.mark.lerobot

CONFIGS = Path(__file__).parents[2] / "policies" / "train"


def test_the_average_is_the_defined_one_and_survives_a_reload_in_float32():
    import torch

    from lerobot_roborecover.policies.ema import SHADOW, EmaAdamW

    def train(weight, optimizer, steps, first=0):
        for step in range(first, first + steps):
            optimizer.zero_grad()
            (weight.float() * (step + 1.0)).sum().backward()
            optimizer.step()

    def fresh():
        weight = torch.nn.Parameter(torch.linspace(-1, 1, 5).to(torch.bfloat16))
        return weight, EmaAdamW([weight, torch.nn.Parameter(torch.zeros(2))], lr=0.1, ema_decay=0.9)

    weight, optimizer = fresh()
    plain = torch.nn.Parameter(weight.detach().clone())
    stock = torch.optim.AdamW([plain], lr=0.1)
    expected = weight.detach().float()
    for step in range(4):
        train(weight, optimizer, 1, step)
        train(plain, stock, 1, step)
        torch.testing.assert_close(weight, plain, rtol=0, atol=0)
        expected = 0.9 * expected + 0.1 * weight.detach().float()
    shadow = optimizer.state[weight][SHADOW]
    assert shadow.dtype == torch.float32
    torch.testing.assert_close(shadow, expected)
    assert len(optimizer.state_dict()["state"]) == 1, "a weight without gradient has no average"

    weight, optimizer = fresh()
    train(weight, optimizer, 2)
    again, other = fresh()
    with torch.no_grad():
        again.copy_(weight)
    other.load_state_dict(optimizer.state_dict())
    train(again, other, 2, 2)
    torch.testing.assert_close(other.state[again][SHADOW], shadow, rtol=0, atol=0)


def write_fake_donors(root: Path, **options) -> Path:
    """A donor dataset of the fake simulator, as `roborecover curate donors` writes them."""
    from lerobot_roborecover.datasets.episodes import to_frame
    from lerobot_roborecover.datasets.trajectory_write import Trajectory, write_trajectories
    from lerobot_roborecover.platforms import make_simulator

    simulator = make_simulator("fake", **options)
    trajectories = []
    for index in range(2):
        scenario = fake_scenario(index)
        simulator.reset(scenario.task, scenario.reset)
        actions = np.random.default_rng(index).uniform(-1, 1, (8, 2))
        frames = []
        for action in actions:
            frames.append(to_frame("fake", simulator.observe()))
            simulator.step(action)
        trajectories.append(Trajectory(scenario.task, "noise", actions, frames, True, scenario=scenario))
    return write_trajectories(root, "donors", trajectories, fps=20)


@pytest.fixture(scope="module")
def donors(tmp_path_factory):
    return write_fake_donors(tmp_path_factory.mktemp("donors") / "set")


def arguments(donors: Path, base: Path, out: Path) -> list[str]:
    return [
        f"--config_path={CONFIGS / 'correction_act.yaml'}", f"--policy.path={base}",
        "--dataset.repo_id=local/donors", f"--dataset.root={donors}", f"--output_dir={out}",
        "--batch_size=4", "--num_workers=0", "--save_freq=2", "--log_freq=0", "--optimizer.ema_decay=0.5",
        "--policy.dropout=0.0",
    ]  # fmt: skip


@pytest.mark.nightly
def test_correction_act_trains_saves_resumes_and_exports(donors, tmp_path, capsys):
    import torch
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies import get_policy_class
    from safetensors.torch import load_file

    from lerobot_roborecover.cli.main import main
    from tests.support.factories import save_policy

    base = save_policy(tmp_path / "base")
    lerobot_train(*arguments(donors, base, tmp_path / "whole"), "--steps=4")
    first = tmp_path / "part"
    lerobot_train(*arguments(donors, base, first), "--steps=4", "--save_checkpoint=true")
    # As after a crash at step 2: what came later is gone.
    shutil.rmtree(first / "checkpoints" / "000004")
    last = first / "checkpoints" / "last"
    last.unlink()
    last.symlink_to("000002")
    resume = last / "pretrained_model" / "train_config.json"
    lerobot_train(f"--config_path={resume}", "--resume=true")

    def state(run: Path, step: str) -> dict:
        return load_file(run / "checkpoints" / step / "training_state" / "optimizer_state.safetensors")

    whole, resumed = state(tmp_path / "whole", "000004"), state(first, "000004")
    shadows = [key for key in whole if key.endswith("/ema")]
    assert shadows
    for key in shadows:
        torch.testing.assert_close(resumed[key], whole[key], rtol=1e-4, atol=1e-5)
    assert any(not torch.equal(whole[k], state(tmp_path / "whole", "000002")[k]) for k in shadows)

    checkpoint, out = tmp_path / "whole" / "checkpoints" / "last", tmp_path / "exported"
    assert main(["export-ema", str(checkpoint), "--out", str(out)]) == 0
    assert str(len(shadows)) in capsys.readouterr().out
    config = PreTrainedConfig.from_pretrained(out)
    policy = get_policy_class("act").from_pretrained(out, config=config)
    trained = get_policy_class("act").from_pretrained(checkpoint / "pretrained_model", config=config)
    averaged, plain = dict(policy.named_parameters()), dict(trained.named_parameters())
    for index, name in enumerate(averaged):
        shadow = whole.get(f"state/{index}/ema", plain[name])
        torch.testing.assert_close(averaged[name].detach(), shadow.detach(), rtol=0, atol=0)
    assert any(not torch.equal(averaged[n], plain[n]) for n in averaged)
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        assert (out / name).is_file()


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize(("kind", "executed"), [("pi05", 10), ("smolvla", 6)])
def test_correction_of_a_vision_language_policy(kind, executed, tmp_path, monkeypatch):
    """The paper's configuration on a small random checkpoint: trains, goes on after a crash, exports."""
    from huggingface_hub import constants
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies import get_policy_class
    from lerobot.policies.pi05 import modeling_pi05

    from lerobot_roborecover.policies.export_ema import export_ema
    from tests.support.small_families import fix_sizes, save_family
    from tests.support.small_hub import make_hub

    cache = make_hub(tmp_path / "hub")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(cache))
    fix_sizes(monkeypatch.setattr)
    # Training reshapes to eight heads, whatever the configuration says.
    heads = {"width": 32, "depth": 2, "mlp_dim": 32, "num_heads": 8, "num_kv_heads": 1, "head_dim": 16}
    monkeypatch.setattr(modeling_pi05, "get_gemma_config", lambda _: modeling_pi05.GemmaConfig(**heads))
    base = save_family(tmp_path / kind, kind, cache, images=("observation.image",))
    found = write_fake_donors(tmp_path / "donors", obs_type="pixels_agent_pos", observation_size=64)
    out = tmp_path / "out"
    lerobot_train(
        f"--config_path={CONFIGS / f'correction_{kind}.yaml'}", f"--policy.path={base}",
        "--policy.device=cpu", "--dataset.repo_id=local/donors", f"--dataset.root={found}",
        f"--output_dir={out}", "--steps=2", "--batch_size=2", "--num_workers=0", "--save_freq=1",
        # The small smolvla's chunks have six actions.
        *([f"--policy.n_action_steps={executed}"] if kind == "smolvla" else []),
    )  # fmt: skip
    # As after a crash at step 1: what came later is gone.
    shutil.rmtree(out / "checkpoints" / "000002")
    last = out / "checkpoints" / "last"
    last.unlink()
    last.symlink_to("000001")
    resume = last / "pretrained_model" / "train_config.json"
    lerobot_train(f"--config_path={resume}", "--resume=true")
    assert last.resolve().name == "000002"
    assert export_ema(last, tmp_path / "exported") > 10
    config = PreTrainedConfig.from_pretrained(tmp_path / "exported")
    assert config.n_action_steps == executed
    get_policy_class(kind).from_pretrained(tmp_path / "exported", config=config)


@pytest.mark.slow
def test_where_lerobot_averages_by_itself(donors, tmp_path, capsys):
    """LeRobot's main: ours works and says what to use instead, and that makes a checkpoint like any other."""
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.policies import get_policy_class

    from tests.support.factories import save_policy

    if "ema" not in {field.name for field in fields(TrainPipelineConfig)}:
        pytest.skip("this LeRobot keeps no average of its own: scripts/test.sh --lerobot-main PATH")
    base = save_policy(tmp_path / "base")
    few = ("--steps=2", "--save_checkpoint=true")
    lerobot_train(*arguments(donors, base, tmp_path / "ours"), *few)
    assert "--ema.enable=true --ema.decay=0.5" in capsys.readouterr().err
    config = tmp_path / "correction.yaml"
    text = (CONFIGS / "correction_act.yaml").read_text()
    config.write_text(
        re.sub(r"  ema_decay: .*\n", "", text.replace("type: roborecover_ema_adamw", "type: adamw"))
    )
    given = [a for a in arguments(donors, base, tmp_path / "theirs") if "ema_decay" not in a]
    lerobot_train(f"--config_path={config}", *given[1:], *few, "--ema.enable=true", "--ema.decay=0.5")
    last = tmp_path / "theirs" / "checkpoints" / "last"
    act = get_policy_class("act")
    averaged, plain = (
        dict(act.from_pretrained(path, config=PreTrainedConfig.from_pretrained(path)).named_parameters())
        for path in (last / "pretrained_model_ema", last / "pretrained_model")
    )
    assert any(not averaged[name].equal(plain[name]) for name in plain)


def test_what_holds_no_average_is_refused(tmp_path, capsys):
    from lerobot_roborecover.cli.main import main

    assert main(["export-ema", str(tmp_path), "--out", str(tmp_path / "o")]) == 2
    assert "checkpoints/<step>" in capsys.readouterr().err
    model = tmp_path / "pretrained_model"
    model.mkdir()
    (model / "config.json").write_text("{}")
    (model / "train_config.json").write_text(json.dumps({"optimizer": {"type": "adamw"}}))
    (tmp_path / "training_state").mkdir()
    (tmp_path / "training_state" / "optimizer_state.safetensors").write_bytes(b"")
    assert main(["export-ema", str(tmp_path), "--out", str(tmp_path / "o")]) == 2
    assert "keeps no average" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["correction_pi05", "correction_smolvla", "correction_act"])
def test_the_configurations_are_the_papers(name):
    import yaml

    found = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())
    assert found["use_policy_training_preset"] is False
    assert found["optimizer"]["type"] == "roborecover_ema_adamw"
    assert found["optimizer"]["grad_clip_norm"] == 1.0
    if name == "correction_pi05":
        assert (found["policy"]["chunk_size"], found["policy"]["n_action_steps"]) == (10, 10)
        assert (found["batch_size"], found["steps"]) == (256, 3000)
        assert (found["optimizer"]["lr"], found["optimizer"]["ema_decay"]) == (5e-5, 0.999)
        assert found["scheduler"]["num_warmup_steps"] == 200
