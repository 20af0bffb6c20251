"""Every file of `policies/eval`, read by LeRobot's own parser, against its policy class and our envs."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

pytestmark = pytest.mark.lerobot

FOLDER = Path(__file__).parents[2] / "policies" / "eval"
FILES = sorted(FOLDER.glob("*.yaml"))
NATIVE = {
    "pi0_libero": ("pi0", 50),
    "pi05_libero": ("pi05", 50),
    "fastwam_libero": ("fastwam", 32),
    "smolvla_robotwin": ("smolvla", 50),
    "pi05_robotwin": ("pi05", 50),
    "fastwam_robotwin": ("fastwam", 32),
    "lingbot_va_robotwin": ("lingbot_va", 16),
    "xvla_robotwin": ("xvla", 30),
}
"""Policy type of each config that a LeRobot checkpoint fills, and that checkpoint's chunk."""
CAMERAS = {
    "smolvla_robotwin": ("camera1", "camera2", "camera3"),
    "pi05_robotwin": ("cam_high", "cam_left_wrist", "cam_right_wrist"),
    "fastwam_robotwin": ("image",),
    "lingbot_va_robotwin": ("head_camera", "left_camera", "right_camera"),
    "xvla_robotwin": ("image", "image2", "image3"),
}
"""Camera names of RoboTwin checkpoints, in the order of their features; LIBERO's are image and image2."""
ROWS = {
    "libero": {"pi0", "pi05", "being_h05", "unifolm_vla", "cosmos_policy", "fastwam"},
    "robotwin": {"xvla", "lingbot_vla", "smolvla", "pi05", "fastwam", "lingbot_va"},
}
"""The paper's rows."""


def stand_in(folder: Path, name: str) -> Path:
    """The configuration file of a checkpoint as its makers describe it; no weights."""
    kind, chunk = NATIVE[name]
    state, action = (8, 7) if name.endswith("libero") else (14, 16 if "lingbot" in name else 14)
    pictures = CAMERAS.get(name, ("image", "image2"))
    size = {"fastwam_libero": (224, 224), "fastwam_robotwin": (384, 320)}.get(name, (256, 256))
    config = {
        "type": kind, "device": "cpu",
        "input_features": {
            **{f"observation.images.{p}": {"type": "VISUAL", "shape": (3, *size)} for p in pictures},
            "observation.state": {"type": "STATE", "shape": (state,)},
        },
        "output_features": {"action": {"type": "ACTION", "shape": (action,)}},
    }  # fmt: skip
    if kind == "fastwam":
        image = (384, 320) if name == "fastwam_robotwin" else (224, 448)
        config |= {"action_dim": action, "proprio_dim": state, "image_size": image, "base_model_id": None}
    elif kind != "lingbot_va":
        config |= {"chunk_size": chunk, "n_action_steps": chunk}
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(config))
    return folder


@pytest.fixture
def parse(monkeypatch, tmp_path):
    """The configuration that `lerobot-eval` would run with, and what RoboRecover finds in it.

    A remote policy's server answers, and says nothing of itself.
    """
    silent = SimpleNamespace(reach=dict, close=lambda: None)
    monkeypatch.setattr("lerobot_roborecover.policies.remote.servers.make_server", lambda *_: silent)

    def run(file: Path, *args: str):
        from lerobot.configs import parser
        from lerobot.configs.eval import EvalPipelineConfig

        import lerobot_roborecover.plugin  # noqa: F401 - registers the env types
        from lerobot_roborecover.evaluation.lerobot_introspection import metadata_of_caller

        for store in (parser._config_path_args, parser._config_yaml_overrides):
            store.clear()
        if file.stem in NATIVE:
            args = (f"--policy.path={stand_in(tmp_path / file.stem, file.stem)}", *args)
        monkeypatch.setattr(sys, "argv", ["lerobot-eval", f"--config_path={file}", *args])
        found = []

        def keep(cfg) -> None:
            found.extend([cfg, metadata_of_caller(cfg.env)])

        keep.__annotations__["cfg"] = EvalPipelineConfig  # LeRobot reads the class itself, not its name
        parser.wrap()(keep)()
        return tuple(found)

    return run


def test_every_row_of_the_paper_has_a_config():
    names = {f.stem for f in FILES}
    expected = {f"{family}_{platform}" for platform, families in ROWS.items() for family in families}
    assert expected <= names
    assert names - expected == {"openpi_libero"}


@pytest.mark.parametrize("file", FILES, ids=lambda f: f.stem)
def test_it_parses_and_fits_its_policy_and_its_env(parse, file):
    from lerobot.configs import FeatureType
    from lerobot.envs.utils import env_to_policy_features

    cfg, facts = parse(file)
    raw = yaml.safe_load(file.read_text())
    platform = file.stem.rsplit("_", 1)[1]
    assert cfg.env.type == f"roborecover_{platform}"
    assert cfg.eval.n_episodes == facts.n_episodes == 5
    assert cfg.eval.n_episodes % cfg.eval.batch_size == 0
    cfg.env.check()
    if cfg.policy.type == "roborecover_remote":
        from lerobot_roborecover.policies.remote.mapping import load_mapping

        assert file.stem not in NATIVE
        load_mapping(cfg.policy.mapping)
        assert cfg.policy.n_action_steps == facts.execution_horizon == raw["policy"]["n_action_steps"]
        return
    kind, chunk = NATIVE[file.stem]
    assert cfg.policy.type == kind
    horizon = raw.get("policy", {}).get("n_action_steps", chunk)
    assert cfg.policy.n_action_steps == horizon <= chunk
    if kind != "lingbot_va":  # it has no option: the whole chunk, always
        assert facts.execution_horizon == horizon
    features = env_to_policy_features(cfg.env)
    seen = {cfg.rename_map.get(key, key): f for key, f in features.items()}
    assert set(cfg.rename_map) <= set(features), "only what the env gives can be renamed"
    wanted = {k for k, f in cfg.policy.input_features.items() if f.type is FeatureType.VISUAL}
    assert wanted == {k for k, f in seen.items() if f.type is FeatureType.VISUAL}
    order = list(cfg.policy.image_features)
    head_first = [cfg.rename_map.get(k, k) for k in features if features[k].type is FeatureType.VISUAL]
    assert order == head_first, "cameras must keep their order: head, left, right; scene, wrist"
    width = 20 if kind == "xvla" else features["action"].shape[0]
    assert width == (20 if kind == "xvla" else cfg.policy.output_features["action"].shape[0])


def test_what_a_config_says_about_actions(parse):
    modes = {}
    for file in FILES:
        env = yaml.safe_load(file.read_text())["env"]
        modes[file.stem] = (env.get("action_mode", ""), env.get("control_mode", ""))
    libero = {m for name, m in modes.items() if name.endswith("libero")}
    assert libero == {("", "relative")}
    assert modes["xvla_robotwin"] == ("ee", "absolute")
    assert modes["lingbot_va_robotwin"] == ("ee", "relative")
    joint = {name for name, mode in modes.items() if mode[0] == "joint"}
    assert joint == {f"{f}_robotwin" for f in ("smolvla", "pi05", "fastwam", "lingbot_vla")}


def test_the_command_line_wins_over_the_file(parse):
    cfg, facts = parse(FOLDER / "fastwam_libero.yaml", "--policy.n_action_steps=16",
                       "--policy.inference_seed=null", "--env.observation_height=224")  # fmt: skip
    assert (cfg.policy.n_action_steps, facts.execution_horizon) == (16, 16)
    assert cfg.policy.inference_seed is None
    assert cfg.policy.torch_dtype == "float32"
    assert (cfg.env.observation_height, cfg.env.observation_width) == (224, 256)
