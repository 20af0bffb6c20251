"""The throughput benchmark runs LeRobot's own classes, here in tiny sizes on the CPU."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.small_families import fix_sizes

pytestmark = pytest.mark.lerobot


@pytest.fixture(autouse=True)
def _benchmarks(monkeypatch):
    """On the path for one test: numba asks for the library `coverage`, and the folder has a namesake."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))


SMALL = {"chunk_size": 10, "tokenizer_max_length": 12, "max_state_dim": 16, "max_action_dim": 8}
LAYERS = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 2}
BACKBONE = {
    "vision_config": {**LAYERS, "num_attention_heads": 2, "image_size": 32, "patch_size": 8},
    "text_config": {
        **LAYERS, "model_type": "llama", "num_attention_heads": 2, "num_key_value_heads": 1, "head_dim": 16,
        "vocab_size": 40, "pad_token_id": 0,
    },
    "scale_factor": 2,
    "image_token_id": 39,
}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        pytest.param(
            "pi05", {"image_resolution": [32, 32], "num_inference_steps": 2}, marks=pytest.mark.nightly
        ),
        pytest.param(
            "smolvla",
            {"resize_imgs_with_padding": [32, 32], "num_steps": 2, "num_vlm_layers": 2,
             "self_attn_every_n_layers": 2},
            marks=pytest.mark.nightly,
        ),
    ],
)  # fmt: skip
def test_every_batch_is_timed_and_means_something(kind, changes, monkeypatch, capsys):
    import policy_throughput

    fix_sizes(monkeypatch.setattr)
    changes = {k: tuple(v) if isinstance(v, list) else v for k, v in changes.items()}
    policy_throughput.main(
        ["--policy", kind, "--device=cpu", "--dtype=float32", "--batches", "1", "3", "--repeat=2",
         "--config", json.dumps({**SMALL, **changes}), "--backbone", json.dumps(BACKBONE)]
    )  # fmt: skip
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [r["batch"] for r in result["rows"]] == [1, 3]
    assert result["parameters_m"] < 1
    best = max(r["chunks_per_s"] for r in result["rows"])
    assert result["meaning"]["chunks"] == 1000 * 300 / 10
    assert result["meaning"]["policy_minutes"] == pytest.approx(30_000 / best / 60)


@pytest.mark.nightly
def test_a_batch_that_does_not_fit_ends_the_series(monkeypatch):
    import policy_throughput
    import torch

    class Policy:
        def reset(self):
            pass

        def predict_action_chunk(self, batch):
            if len(batch["observation.state"]) > 2:
                raise torch.cuda.OutOfMemoryError("CUDA out of memory")
            return torch.zeros(len(batch["observation.state"]), 10, 7)

    rows = policy_throughput.measure(Policy(), "pi05", "cpu", "float32", [1, 2, 4, 8], 1, 5)
    assert [r["batch"] for r in rows] == [1, 2, 4]
    assert rows[-1] == {"batch": 4, "out_of_memory": True}
    assert policy_throughput.meaning(rows, 10, 100, 10)["chunks"] == 100
