"""A policy ships without what belongs to the machine that trained it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SHIPPED = sorted(
    path
    for folder in (ROOT / "policies", ROOT / "lerobot_roborecover" / "data")
    for path in folder.rglob("config.json")
    if (path.parent / "model.safetensors").is_file()
)


@pytest.mark.parametrize("config", SHIPPED, ids=lambda p: "-".join(p.relative_to(ROOT).parts[-3:-1]))
def test_no_shipped_policy_names_a_place(config):
    found = json.loads(config.read_text())
    assert found["pretrained_path"] is None
    assert found["device"] == "cpu"


@pytest.mark.lerobot
def test_ship(tmp_path):
    import torch
    from safetensors.torch import load_file, save_file

    from recipes.ship import ship

    made = tmp_path / "pretrained_model"
    made.mkdir()
    save_file({"w": torch.ones(2), "n": torch.ones(2, dtype=torch.int64)}, made / "model.safetensors")
    config = {"type": "act", "device": "cuda", "pretrained_path": "/home/somebody/act", "use_amp": True}
    (made / "config.json").write_text(json.dumps(config))
    (made / "policy_preprocessor.json").write_text('{"device": "cuda"}')
    (made / "train_config.json").write_text("{}")
    ship(made, tmp_path / "out")
    shipped = {path.name for path in (tmp_path / "out").iterdir()}
    assert shipped == {"model.safetensors", "config.json", "policy_preprocessor.json"}
    found = json.loads((tmp_path / "out" / "config.json").read_text())
    assert found == config | {"device": "cpu", "pretrained_path": None, "use_amp": False}
    assert json.loads((tmp_path / "out" / "policy_preprocessor.json").read_text()) == {"device": "cpu"}
    weights = load_file(tmp_path / "out" / "model.safetensors")
    assert (weights["w"].dtype, weights["n"].dtype) == (torch.float16, torch.int64)
    ship(made, tmp_path / "acts", only=["w"])
    assert set(load_file(tmp_path / "acts" / "model.safetensors")) == {"w"}
    with pytest.raises(ValueError, match="begins with v; there are n, w"):
        ship(made, tmp_path / "never", only=["v"])
