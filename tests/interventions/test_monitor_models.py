"""Both monitors through the real `lerobot-train`: train, save, resume, reload, push; and what they refuse."""

from __future__ import annotations

import functools
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.curation.continuations import Continuation
from lerobot_roborecover.detection.data.choice import BALANCED, NATURAL, TRAIN, DataOptions, choose
from lerobot_roborecover.detection.data.data import write_monitor_data
from lerobot_roborecover.policies.detectors.interface import DetectorError
from tests.support.factories import fake_scenario
from tests.support.training import lerobot_train

pytestmark = pytest.mark.lerobot

CONFIGS = Path(__file__).parents[2] / "policies" / "train"
CAMERA, STATE, ENV_STATE = "observation.image", "observation.state", "observation.environment_state"


def load_monitor(*args, **options):
    """Ours, imported where it is needed: it loads torch."""
    from lerobot_roborecover.policies.detectors import loading

    return loading.load_monitor(*args, **options)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """Frames with pictures and states, a few per trajectory."""
    made = []
    for i in range(4):
        scenario = replace(fake_scenario(i, steps=6), split="train")
        actions = np.random.default_rng(i).uniform(-1, 1, (6, 2)).astype(np.float32)
        made.append(Continuation(scenario, "noise", actions, False))
    root = tmp_path_factory.mktemp("monitor") / "data"
    parts = choose(made, DataOptions(validation=0.25))
    write_monitor_data(root, parts, simulator={"obs_type": "pixels_agent_pos", "observation_size": 64})
    return root


@pytest.fixture(scope="module")
def base(tmp_path_factory) -> Path:
    """A small random Qwen3-VL."""
    from tests.support.small_qwen3vl import small_qwen3vl

    return small_qwen3vl(tmp_path_factory.mktemp("qwen") / "base")


def options(kind: str, data: Path, base: Path) -> list[str]:
    found = [f"--config_path={CONFIGS / kind}.yaml", f"--dataset.root={data / TRAIN}", "--num_workers=0"]
    found += ["--steps=4", "--save_freq=2", "--log_freq=2", "--reward_model.device=cpu"]
    # Without dropout: the loader of a resumed run draws a seed first, which shifts torch's generator.
    if kind == "monitor_small":
        sizes = ["--reward_model.hidden_dim=16", "--reward_model.image_size=32", "--reward_model.dropout=0"]
        return [*found, *sizes, "--batch_size=8"]
    # 6 frames in pieces of 4: the last piece is smaller.
    found += ["--batch_size=6", "--reward_model.dtype=float32", "--reward_model.lora_dropout=0"]
    return [*found, f"--reward_model.base_model={base}"]


def weights(checkpoint: Path) -> dict[str, np.ndarray]:
    from safetensors.numpy import load_file

    (file,) = checkpoint.glob("*model.safetensors")
    return load_file(file)


BOTH = ["monitor_small", pytest.param("monitor_qwen3vl", marks=pytest.mark.nightly)]


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory, request):
    """A monitor's run folder by its config's name, each trained once."""

    @functools.cache
    def run(kind: str) -> Path:
        base = request.getfixturevalue("base") if kind == "monitor_qwen3vl" else Path()
        out = tmp_path_factory.mktemp(kind) / "run"
        lerobot_train(*options(kind, data, base), f"--output_dir={out}")
        return out

    return run


def final(run: Path) -> Path:
    return run / "checkpoints" / "last" / "pretrained_model"


@pytest.mark.parametrize("kind", BOTH)
def test_train_save_resume_and_reload(kind, trained, tmp_path, request):
    saved_to = final(trained(kind))
    names = {p.name for p in saved_to.iterdir()}
    assert {"config.json", "train_config.json", "monitor_training.json"} <= names
    if kind == "monitor_qwen3vl":
        assert {"adapter_model.safetensors", "adapter_config.json"} <= names
        assert "model.safetensors" not in names  # the base is not saved again
        assert all("lora_" in name for name in weights(saved_to))
        saved = json.loads((saved_to / "config.json").read_text())
        assert saved["base_model"] == str(request.getfixturevalue("base"))
        assert len(saved["base_fingerprint"]) == 64
    record = json.loads((saved_to / "monitor_training.json").read_text())
    assert record["labels"] == {"train:0": 18, "train:1": 18}
    assert len(record["scenarios"]) == 3

    # Resumed from the middle, the same weights come out.
    resumed = tmp_path / "resumed"
    shutil.copytree(trained(kind), resumed, symlinks=True)
    shutil.rmtree(resumed / "checkpoints" / "000004")
    middle = resumed / "checkpoints" / "000002" / "pretrained_model"
    lerobot_train(f"--config_path={middle / 'train_config.json'}", "--resume=true", f"--output_dir={resumed}")
    once, twice = weights(saved_to), weights(resumed / "checkpoints" / "000004" / "pretrained_model")
    assert once.keys() == twice.keys()
    assert any(not np.array_equal(weights(middle)[k], once[k]) for k in once)
    for name in once:
        np.testing.assert_allclose(once[name], twice[name], rtol=1e-5, atol=1e-6, err_msg=name)

    # Loaded again, it says the same, whatever shares the batch.
    import torch

    monitor = load_monitor(str(saved_to), device="cpu")
    torch.manual_seed(0)
    seen = {k: torch.rand(5, *f.shape) for k, f in monitor.needs.features.items()}
    told = ["push the puck to the goal", "x", "push the puck to the goal", "a longer instruction", "y"]
    together = monitor.judge_batch({**seen, "observation.other": torch.zeros(5, 3), "task": told})
    assert together.scores.shape == together.triggers.shape == (5,)
    assert not together.triggers[np.isnan(together.scores)].any()
    answers = monitor.answer({**seen, "task": told})
    for i in range(5):
        alone = monitor.answer({**{k: v[i : i + 1] for k, v in seen.items()}, "task": told[i : i + 1]})
        assert alone.scores[0].item() == pytest.approx(answers.scores[i].item(), abs=2e-5)
    reward = monitor.compute_reward({**seen, "task": told})
    assert reward.tolist() == together.triggers.astype(float).tolist()


def qwen_monitor(base: Path, **settings):
    """In training, with adapters that are not zero."""
    import torch
    from lerobot.configs import FeatureType, PolicyFeature

    from lerobot_roborecover.policies.detectors.monitor.configuration_roborecover_monitor import (
        RoboRecoverMonitorConfig,
    )
    from lerobot_roborecover.policies.detectors.monitor.modeling_roborecover_monitor import (
        RoboRecoverMonitorRewardModel,
    )

    config = RoboRecoverMonitorConfig(
        base_model=str(base), device="cpu", dtype="float32", lora_dropout=0.0,
        input_features={CAMERA: PolicyFeature(FeatureType.VISUAL, (3, 64, 64))}, **settings,
    )  # fmt: skip
    model = RoboRecoverMonitorRewardModel(config).train()
    torch.manual_seed(1)
    for name, parameter in model.named_parameters():
        if "lora_B" in name:  # zero at the start, which would leave half of the gradients zero
            torch.nn.init.normal_(parameter, std=0.3)
    batch = {
        CAMERA: torch.rand(5, 3, 64, 64), "task": ["a", "another task", "b", "c", "d"],
        "next.reward": torch.tensor([0.0, 1, 1, 0, 1]),
    }  # fmt: skip
    return model, batch


@pytest.mark.parametrize("checkpointing", [False, True])
def test_a_piece_is_seen_once_and_its_gradient_is_right(base, checkpointing):
    """The frozen vision encoder runs once a piece, the language model once, or twice with checkpoints; loss
    and gradient are those of the whole batch at once."""
    import torch

    model, batch = qwen_monitor(base, gradient_checkpointing=checkpointing)
    inner, passes = model.model.get_base_model().model, {"vision": 0, "language": 0}

    def count(name):
        return lambda *_: passes.__setitem__(name, passes[name] + 1)

    inner.visual.blocks[0].attn.register_forward_hook(count("vision"))
    inner.language_model.layers[0].self_attn.register_forward_hook(count("language"))

    def step(size, scale=1.0):
        model.config.micro_batch_size = size
        model.zero_grad()
        passes.update(vision=0, language=0)
        loss, said = model.forward(batch)
        (scale * loss).backward()
        return loss.item(), [p.grad.clone() for p in model.get_optim_params()], said

    loss, whole, said = step(5)
    again, pieces, same = step(2)
    assert passes == {"vision": 3, "language": 3 * (1 + checkpointing)}
    assert again == pytest.approx(loss, rel=1e-5)
    assert same == said
    assert max(g.abs().max() for g in whole) > 0.01
    for a, b, scaled in zip(whole, pieces, step(2, 3.0)[1], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-5)
        torch.testing.assert_close(3 * b, scaled)
    with torch.no_grad():
        assert model.forward(batch)[0].item() == pytest.approx(loss, rel=1e-5)


@pytest.mark.nightly
def test_one_backward_over_pieces_is_the_whole_batch_s_gradient(base):
    import torch

    model, batch = qwen_monitor(base, gradient_checkpointing=False)
    config = model.config

    def gradient(size: int, checkpointing: bool) -> tuple[float, list[torch.Tensor]]:
        config.micro_batch_size = size
        inner = model.model.get_base_model()
        if checkpointing:
            inner.gradient_checkpointing_enable({"use_reentrant": False})
        model.zero_grad()
        loss, _ = model.forward(batch)
        loss.backward()
        return loss.item(), [p.grad.clone() for p in model.get_optim_params()]

    loss, whole = gradient(5, False)
    assert max(g.abs().max() for g in whole) > 0.01
    for size, checkpointing in ((2, False), (1, False), (2, True)):
        again, pieces = gradient(size, checkpointing)
        assert again == pytest.approx(loss, rel=1e-5)
        for a, b in zip(whole, pieces, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-5)

    # It can learn: dark pictures are 0, bright ones 1; and what cannot be read becomes readable.
    before = model.eval().judge_batch(batch)
    assert np.isnan(before.scores).all()
    assert not before.triggers.any()
    optimizer = torch.optim.AdamW(model.get_optim_params(), lr=1e-2)
    config.micro_batch_size = 8
    label = torch.tensor([0.0, 1.0] * 4)
    batch = {CAMERA: torch.rand(8, 3, 64, 64) * 0.1 + 0.8 * label[:, None, None, None], "task": ["push"] * 8}
    model.train()
    for _ in range(25):
        loss, _ = model.forward({**batch, "next.reward": label})
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    after = model.eval().judge_batch(batch)
    assert after.triggers.tolist() == label.bool().tolist()
    assert (after.scores[::2] < 0.5).all()
    assert (after.scores[1::2] > 0.5).all()


@pytest.mark.nightly
def test_the_small_monitor_reads_what_it_is_told_to(data, tmp_path):
    kind = options("monitor_small", data, Path())
    lerobot_train(
        *kind, f"--reward_model.inputs={ENV_STATE}", f"--output_dir={tmp_path / 'run'}", "--steps=2"
    )
    monitor = load_monitor(str(tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"), device="cpu")
    assert list(monitor.needs.features) == [ENV_STATE]
    with pytest.raises(DetectorError, match=r"no observation\.images\.wrist .*observation\.state"):
        lerobot_train(
            *kind,
            "--reward_model.inputs=observation.state,observation.images.wrist",
            f"--output_dir={tmp_path / 'no'}",
        )


@pytest.mark.nightly
@pytest.mark.parametrize("kind", BOTH)
def test_a_monitor_is_measured_on_held_out_frames_only(kind, data, trained, tmp_path, capsys, monkeypatch):
    argv = ["detect", "evaluate-frames", "--monitor", str(final(trained(kind))), "--device", "cpu"]
    argv += ["--out", str(tmp_path / "out"), "--data", str(data / NATURAL), "--data", f"b={data / BALANCED}"]
    monkeypatch.setattr(sys, "argv", ["roborecover", *argv])
    assert main(argv) == 0
    assert "validation_natural" in capsys.readouterr().out
    numbers = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert set(numbers["datasets"]) == {"validation_natural", "b"}
    natural = numbers["datasets"]["validation_natural"]
    assert sum(natural["confusion"].values()) == natural["frames"] == 12
    assert natural["episodes"]["every_step"] is True
    assert main([*argv[:-4], "--data", str(data / TRAIN)]) == 2
    assert "3 scenarios are in training and in validation" in capsys.readouterr().err
    if kind == "monitor_small":
        assert main([*argv, "--choose-threshold", "youden"]) == 0
        assert "chosen by youden on validation_natural" in capsys.readouterr().out


def damaged(source: Path, folder: Path, change) -> Path:
    """A copy that was tampered with."""
    shutil.copytree(source, folder)
    change(folder)
    return folder


def configured(folder: Path, **changes) -> None:
    path = folder / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def refused(path: Path, words: str, **overrides) -> None:
    with pytest.raises(DetectorError) as caught:
        load_monitor(str(path), device="cpu", **overrides)
    assert words in str(caught.value), (path, str(caught.value))


def test_what_does_not_fit_is_refused(data, trained, tmp_path):
    import torch

    small = final(trained("monitor_small"))
    with pytest.raises(DetectorError, match=r"shape \(4,\); here it is \(9,\)"):
        load_monitor(str(small), device="cpu").judge_batch(
            {
                STATE: torch.zeros(1, 9),
                ENV_STATE: torch.zeros(1, 6),
                CAMERA: torch.zeros(1, 3, 8, 8),
                "task": ["x"],
            }
        )
    changes = [
        (lambda f: (f / "model.safetensors").unlink(), "model.safetensors"),
        (lambda f: configured(f, hidden_dim=32), "does not fit its config.json"),
        (lambda f: configured(f, type="act"), "type 'act'"),
        (lambda f: (f / "config.json").write_text("["), "not a checkpoint"),
    ]
    for index, (change, words) in enumerate(changes):
        refused(damaged(small, tmp_path / str(index), change), words)
    refused(tmp_path, "config.json")
    refused(small, "threshold=1.5", threshold="1.5")
    with pytest.raises(DetectorError, match="neither a folder nor a Hub model"):
        load_monitor("nobody/nothing")
    # A dataset without labels.
    from lerobot_roborecover.datasets.trajectory_write import write_trajectories
    from tests.datasets.test_trajectories import trajectory

    plain = write_trajectories(tmp_path / "plain", "donors", [trajectory(0), trajectory(1)], fps=20)
    with pytest.raises(DetectorError, match=r"no column next\.reward"):
        lerobot_train(
            *options("monitor_small", data, Path()), f"--dataset.root={plain}",
            f"--output_dir={tmp_path / 'o'}",
        )  # fmt: skip


@pytest.mark.nightly
def test_an_adapter_that_does_not_fit_is_refused(trained, tmp_path):
    import torch

    from tests.support.small_qwen3vl import small_qwen3vl

    large = final(trained("monitor_qwen3vl"))
    monitor = load_monitor(str(large), device="cpu")
    with pytest.raises(DetectorError, match=r"reads observation\.image, which the environment does not give"):
        monitor.judge_batch({"observation.images.top": torch.rand(1, 3, 64, 64), "task": ["x"]})
    other = small_qwen3vl(tmp_path / "other", seed=1)
    changes = [
        (lambda f: (f / "adapter_model.safetensors").unlink(), "adapter_model"),
        (lambda f: configured(f, base_model=str(other)), "another base"),
        (lambda f: configured(f, lora_rank=8), "does not fit its config.json"),
    ]
    for index, (change, words) in enumerate(changes):
        refused(damaged(large, tmp_path / str(index), change), words)
    refused(large, "another base", base_model=str(other))
    refused(large, "cannot be loaded", base_model=str(tmp_path / "none"))


@pytest.mark.nightly
def test_training_ends_with_a_push(data, base, tmp_path, monkeypatch):
    """LeRobot 0.6.1 calls the last push with arguments that its own base class does not take; its main pushes
    by itself, in several commits, with a card that it asks the Hub about."""
    import lerobot.utils.hub
    from huggingface_hub import RepoCard
    from lerobot.common import train_utils

    from lerobot_roborecover.policies.detectors.monitor import base as module

    uploads: list[tuple[str, set[str]]] = []

    class Hub:
        def __init__(self, *_, **__):
            pass

        def create_repo(self, repo_id, **_):
            return SimpleNamespace(repo_id=repo_id)

        def upload_folder(self, *, repo_id, folder_path, **_):
            uploads.append((repo_id, {p.name for p in Path(folder_path).iterdir()}))
            if (Path(folder_path) / "README.md").exists():
                uploads[-1][1].add((Path(folder_path) / "README.md").read_text()[:3])
            return SimpleNamespace(repo_url=SimpleNamespace(url=f"hub/{repo_id}"))

    monkeypatch.setattr(module, "HfApi", Hub)
    monkeypatch.setattr(lerobot.utils.hub, "HfApi", Hub)
    monkeypatch.setattr(train_utils, "HfApi", Hub)
    monkeypatch.setattr(RepoCard, "validate", lambda *_, **__: None)
    push = ["--reward_model.push_to_hub=true", "--reward_model.repo_id=lab/monitor", "--steps=1"]
    lerobot_train(*options("monitor_qwen3vl", data, base), *push, f"--output_dir={tmp_path / 'run'}")
    assert {repo for repo, _ in uploads} == {"lab/monitor"}
    files = set().union(*(names for _, names in uploads))
    assert {"adapter_model.safetensors", "config.json", "train_config.json", "README.md", "---"} <= files
