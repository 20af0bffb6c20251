"""LeRobot's own reward models as detectors, with random weights and without the Hub."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lerobot_roborecover.policies.detectors.interface import DetectorError
from tests.support.small_qwen3vl import small_qwen3vl

pytestmark = [pytest.mark.lerobot, pytest.mark.slow]
CAMERA, STATE = "observation.images.top", "observation.state"
CLIP = "openai/clip-vit-base-patch32"


def load(what: str):
    from lerobot_roborecover.policies.detectors.loading import load_detector

    return load_detector(what, "cpu")


def frames(steps: int, size: int = 64) -> list[dict]:
    """Pictures and states of a made-up trial."""
    import torch

    rng = np.random.default_rng(0)
    return [
        {
            CAMERA: torch.from_numpy(rng.uniform(0, 1, (3, size, size)).astype(np.float32)),
            STATE: torch.from_numpy(rng.normal(0, 1, 4).astype(np.float32)),
        }
        for _ in range(steps)
    ]


def ask(detector, seen, steps):
    """What it says at the steps, each with its own history."""
    from lerobot_roborecover.policies.detectors.interface import DetectorWindow, StepObservation

    observations = [StepObservation(o) for o in seen]
    past = detector.needs.past
    return detector.judge_windows(
        [DetectorWindow(observations[max(n - past, 0) : n + 1], "push the puck", n) for n in steps]
    )


@pytest.fixture(scope="module")
def qwen(tmp_path_factory) -> Path:
    return small_qwen3vl(tmp_path_factory.mktemp("qwen") / "base")


@pytest.fixture(scope="module")
def topreward(tmp_path_factory, qwen) -> Path:
    from lerobot.rewards.topreward.configuration_topreward import TOPRewardConfig

    folder = tmp_path_factory.mktemp("topreward")
    config = TOPRewardConfig(
        vlm_name=str(qwen), torch_dtype="float32", image_key=CAMERA, max_frames=2, device="cpu"
    )
    config._save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def robometer(tmp_path_factory, qwen) -> Path:
    import torch
    from lerobot.rewards.robometer.configuration_robometer import RobometerConfig
    from lerobot.rewards.robometer.modeling_robometer import RobometerRewardModel

    folder = tmp_path_factory.mktemp("robometer")
    config = RobometerConfig(
        pretrained_path=None, base_model_id=str(qwen), torch_dtype="float32", image_key=CAMERA, max_frames=2,
        device="cpu",
    )  # fmt: skip
    torch.manual_seed(0)
    RobometerRewardModel(config).save_pretrained(folder)
    return folder


@pytest.fixture
def sarm(tmp_path, monkeypatch) -> Path:
    """A small SARM, and a small random CLIP under the Hub's name in a cache of its own."""
    import torch
    from lerobot.rewards.sarm.configuration_sarm import SARMConfig
    from lerobot.rewards.sarm.modeling_sarm import SARMRewardModel

    put_clip_into_cache(tmp_path / "hub", monkeypatch)
    config = SARMConfig(
        image_dim=16, text_dim=16, hidden_dim=24, num_heads=2, num_layers=1, max_state_dim=8, frame_gap=2,
        image_key=CAMERA, device="cpu",
    )  # fmt: skip
    torch.manual_seed(0)
    SARMRewardModel(config).save_pretrained(tmp_path / "sarm")
    return tmp_path / "sarm"


def put_clip_into_cache(cache: Path, monkeypatch) -> None:
    from huggingface_hub import constants
    from transformers import (
        CLIPConfig,
        CLIPImageProcessor,
        CLIPModel,
        CLIPProcessor,
        CLIPTokenizerFast,
    )

    commit = "0" * 40
    folder = cache / f"models--{CLIP.replace('/', '--')}"
    snapshot = folder / "snapshots" / commit
    snapshot.mkdir(parents=True)
    (folder / "refs").mkdir()
    (folder / "refs" / "main").write_text(commit)
    sizes = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    ends = {"bos_token_id": 0, "eos_token_id": 1, "pad_token_id": 1}
    CLIPModel(
        CLIPConfig(
            text_config={**sizes, **ends, "vocab_size": 40, "max_position_embeddings": 32},
            vision_config={**sizes, "image_size": 32, "patch_size": 16}, projection_dim=16,
        )
    ).save_pretrained(snapshot)  # fmt: skip
    letters = [*"abcdefghijklmnopqrstuvwxyz", *(f"{c}</w>" for c in "abcdefghij")]
    vocabulary = {t: i for i, t in enumerate(["<|startoftext|>", "<|endoftext|>", *letters])}
    (snapshot / "vocab.json").write_text(json.dumps(vocabulary))
    (snapshot / "merges.txt").write_text("#version: 0.2\n")
    tokenizer = CLIPTokenizerFast(
        vocab_file=str(snapshot / "vocab.json"), merges_file=str(snapshot / "merges.txt"), model_max_length=32
    )
    pictures = CLIPImageProcessor(
        size={"shortest_edge": 32}, crop_size={"height": 32, "width": 32}, do_convert_rgb=True
    )
    CLIPProcessor(pictures, tokenizer).save_pretrained(snapshot)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(cache))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)


@pytest.mark.parametrize("kind", ["topreward", "robometer", "sarm"])
def test_rewards_become_scores(kind, request):
    folder = request.getfixturevalue(kind)
    seen = frames(12)
    whole = load(f"{folder},lag=0,stride=2")
    falls = load(f"{folder},lag=3,stride=2,threshold=-100")
    assert set(whole.needs.features) == ({CAMERA, STATE} if kind == "sarm" else {CAMERA})
    assert falls.needs.past == whole.needs.past + 3
    rewards = -ask(whole, seen, range(12)).scores
    assert np.isfinite(rewards).all()
    assert len(set(np.round(rewards, 6))) > 6  # it looks at the pictures
    if kind == "topreward":
        assert (rewards < 0).all()  # a log probability
    else:
        assert ((rewards >= 0) & (rewards <= 1)).all()
    fallen = ask(falls, seen, [1, 5, 11])
    assert fallen.scores[0] == 0.0  # three steps have not been yet
    assert fallen.scores[1] == pytest.approx(rewards[2] - rewards[5], abs=1e-5)
    assert fallen.triggers.all()
    assert not ask(whole, seen, [3]).triggers.any()
    # The same in any batch.
    alone = [ask(falls, seen, [n]).scores[0] for n in (5, 11)]
    np.testing.assert_allclose(alone, fallen.scores[1:], atol=1e-5)


def test_what_cannot_be_loaded_is_said_with_what_it_takes(topreward, robometer, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    config = json.loads((topreward / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps({**config, "vlm_name": "no-such/model"}))
    with pytest.raises(
        DetectorError, match=r"needs the model no-such/model with its processor; without a network"
    ):
        load(str(tmp_path))
    config = json.loads((robometer / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(DetectorError, match="needs its own weights and the tokenizer and image processor of"):
        load(str(tmp_path))
    with pytest.raises(DetectorError, match="whole numbers"):
        load(f"{topreward},lag=soon")
    with pytest.raises(DetectorError, match="lag=-1"):
        load(f"{topreward},lag=-1")
