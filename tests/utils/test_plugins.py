"""Installed plugins of LeRobot's are known in Python and in every command, quietly."""

from __future__ import annotations

import json
import logging
import sys

import pytest

from lerobot_roborecover.utils import plugins

pytestmark = pytest.mark.lerobot

ENV = '''
from dataclasses import dataclass
from lerobot.envs.configs import EnvConfig

@EnvConfig.register_subclass("cupboard")
@dataclass
class CupboardEnv(EnvConfig):
    """A third-party env type."""
    task: str = "Open-v0"
    door_mass_kg: float = 2.0
    @property
    def gym_kwargs(self): return {}
'''
POLICY = '''
from dataclasses import dataclass
from lerobot.configs.policies import PreTrainedConfig

@PreTrainedConfig.register_subclass("opener")
@dataclass
class OpenerConfig(PreTrainedConfig):
    """A third-party policy type."""
    grip_n: float = 5.0
    observation_delta_indices = action_delta_indices = reward_delta_indices = None
    def get_optimizer_preset(self): return None
    def get_scheduler_preset(self): return None
    def validate_features(self): pass
'''


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Three plugins, of which one cannot be imported, as pip installs them; nothing is registered yet."""
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.envs.configs import EnvConfig

    broken = "import a_module_that_is_missing\n"
    sources = {"lerobot_env_cupboard": ENV, "lerobot_policy_opener": POLICY, "lerobot_env_broken": broken}
    for name, source in sources.items():
        (tmp_path / f"{name}.py").write_text(source)
        (tmp_path / f"{name}-1.0.dist-info").mkdir()
        (tmp_path / f"{name}-1.0.dist-info" / "METADATA").write_text(f"Name: {name}\nVersion: 1.0\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(plugins, "_registered", False)
    yield
    EnvConfig._choice_registry.pop("cupboard", None)
    PreTrainedConfig._choice_registry.pop("opener", None)
    for name in sources:
        sys.modules.pop(name, None)


def test_env_types_and_policies_are_known_in_python_and_in_commands(installed, tmp_path, caplog):
    from lerobot_roborecover.curation.policy_trials import env_config
    from lerobot_roborecover.evaluation.evaluate import _env_config
    from lerobot_roborecover.evaluation.loading import policy_config
    from lerobot_roborecover.platforms import platform_named

    with caplog.at_level(logging.DEBUG):
        mine = _env_config({"base": {"type": "cupboard", "door_mass_kg": 3.0}}, "lerobot_cupboard")
    assert mine.base.door_mass_kg == 3.0
    told = [r for r in caplog.records if "third-party" in r.getMessage() and "lerobot_" in r.getMessage()]
    assert [r.levelname for r in told if r.name == "root" and r.levelno > logging.DEBUG] == ["WARNING"]
    assert (
        "lerobot_env_broken (ModuleNotFoundError: No module named 'a_module_that_is_missing')" in caplog.text
    )
    assert "Traceback" not in caplog.text
    assert (
        env_config("lerobot_cupboard", "", ["--base.type=cupboard"]).base.task == "Open-v0"
    )  # collect, screen
    assert platform_named("lerobot_cupboard").facts.title == "LeRobot's cupboard"
    checkpoint = tmp_path / "checkpoint"
    checkpoint.mkdir()
    (checkpoint / "config.json").write_text(json.dumps({"type": "opener", "grip_n": 7.0}))
    assert policy_config(str(checkpoint)).grip_n == 7.0


def test_they_are_imported_once(installed, monkeypatch):
    from lerobot.utils import import_utils

    calls = []
    monkeypatch.setattr(import_utils, "register_third_party_plugins", lambda: calls.append(1))
    plugins.register_plugins()
    plugins.register_plugins()
    assert calls == [1]
