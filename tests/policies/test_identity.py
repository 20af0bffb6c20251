"""What makes a trial the same trial: each ingredient changes its key, and nothing else does."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from safetensors.numpy import save_file

from lerobot_roborecover.datasets import ScenarioSet, load_scenarios
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.logs.fields import UNKNOWN_WEIGHTS
from lerobot_roborecover.policies.identity import (
    NO_RESULT,
    object_identity,
    policy_identity,
)
from tests.support.factories import fake_dataset, save_policy

pytestmark = pytest.mark.lerobot
BASE = "base_of_adapter"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", 3, horizon=12)


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    """A folder of checkpoints: one with every kind of file that is loaded, and its adapter's base."""
    root = tmp_path_factory.mktemp("checkpoints")
    policy = save_policy(root / "act")
    base = root / BASE
    base.mkdir()
    (base / "config.json").write_text("{}")
    save_file({"base": np.ones(3, np.float32)}, base / "model.safetensors")
    (policy / "adapter_config.json").write_text(json.dumps({"base_model_name_or_path": str(base)}))
    for name in (
        "adapter_model.safetensors", "model-00001-of-00002.safetensors", "model-00002-of-00002.safetensors",
        "model.safetensors.index.json", "tokenizer.model", "experiment_cfg/metadata.json",
    ):  # fmt: skip
        (policy / name).parent.mkdir(exist_ok=True)
        if name.endswith(".safetensors"):
            save_file({"weight": np.ones(3, np.float32)}, policy / name)
        else:
            (policy / name).write_bytes(b"{}")
    return root


@pytest.fixture
def mine(checkpoints, tmp_path):
    """A copy of the checkpoint, whose adapter's base is a copy as well."""
    shutil.copytree(checkpoints / "act", tmp_path / "act")
    shutil.copytree(checkpoints / BASE, tmp_path / BASE)
    _point_to_base(tmp_path / "act", tmp_path / BASE)
    return tmp_path / "act"


def _point_to_base(policy: Path, base: Path) -> None:
    (policy / "adapter_config.json").write_text(json.dumps({"base_model_name_or_path": str(base)}))


@pytest.fixture
def key(dataset, tmp_path):
    """The key of a trial, from what a run is made of."""
    from lerobot_roborecover.curation.policy_trials import env_config
    from lerobot_roborecover.evaluation.loading import policy_config
    from lerobot_roborecover.evaluation.session import create_session
    from lerobot_roborecover.policies.metadata import policy_metadata

    scenarios = load_scenarios(str(dataset))
    number = [0]

    def call(who, *options, env=(), seed=1, k=0, edit=None, scenario=lambda s: s, order=1, **facts) -> tuple:
        config = policy_config(str(who), options) if isinstance(who, Path) else who
        if edit:
            edit(config)
        spec = env_config("fake", str(dataset), [f"--{option}" for option in env])
        number[0] += 1
        spec.trial_log = str(tmp_path / f"logs/{number[0]}.jsonl")
        chosen = ScenarioSet(
            tuple(map(scenario, tuple(scenarios)[::order])), "memory", None, {"platform": "fake"}
        )
        found, run = create_session(
            spec, spec.run_spec(), workers=True, facts=policy_metadata(config, **facts), scenarios=chosen
        )
        run.pool.acquire()
        run.pool.release()
        run.protocol = replace(run.protocol, run_seed=seed)
        first = next(s for s in found if s.id == min(x.id for x in found))
        return run.keys([(first, k)])[0]

    return call


def test_every_file_of_a_checkpoint_counts(mine, key):
    before = key(mine)
    assert key(mine) == before
    files = [f for folder in (mine, mine.with_name(BASE)) for f in sorted(folder.rglob("*")) if f.is_file()]
    names = {f.name for f in files}
    assert {
        "config.json",
        "model.safetensors",
        "policy_preprocessor.json",
        "policy_postprocessor.json",
    } <= names
    assert any("normalizer_processor.safetensors" in name for name in names)
    for file in files:
        content = file.read_bytes()
        whole = file.suffix == ".safetensors"  # another length would be refused as damaged
        file.write_bytes(content[:-1] + bytes([content[-1] ^ 1]) if whole else content + b" ")
        assert key(mine) != before, file
        file.write_bytes(content)
    assert key(mine) == before
    (mine / "new_file.bin").write_bytes(b"a")
    assert key(mine) != before, "a file that is new"


def test_every_option_of_a_policy_counts(mine, key):
    from lerobot_roborecover.evaluation.loading import policy_config

    before = key(mine)
    names = [f.name for f in fields(policy_config(str(mine)))]
    assert len(names) > 30
    for name in names:
        if name == "pretrained_path":
            continue

        def edit(config, name=name):
            value = getattr(config, name)
            another = {bool: not value, int: 7, float: 0.7, str: "another"}.get(type(value), "another")
            vars(config)[name] = {**value, "x": "y"} if isinstance(value, dict) else another

        changed = key(mine, edit=edit) != before
        assert changed == (name not in NO_RESULT or name == "device"), name
    assert key(mine, "--n_action_steps=1") != before
    assert key(mine, "--n_action_steps=2") == before, "as saved"


def test_only_the_kind_of_device_counts(mine, key):
    def on(device):
        return key(mine, edit=lambda config: vars(config).update(device=device))

    assert on("cuda:0") == on("cuda:1") == on("cuda") != on("cpu")


@pytest.mark.parametrize(
    "change",
    [
        {"rename_map": {"observation.images.a": "observation.images.b"}},
        {"cross_cpu_deterministic": True},
        {"policy": "mine"},
        {"seed": 2},
        {"seed": None},
        {"k": 1},
        {"env": ["start=initial"]},
        {"env": ["start=reversion", "rewind_steps=1"]},
        {"env": ["handoff_check=false"]},
        {"scenario": lambda s: replace(s, task=replace(s.task, horizon=11))},
        {"scenario": lambda s: replace(s, prefix=s.prefix + 1e-9)},
    ],
    ids=lambda change: next(iter(change)),
)  # fmt: skip
def test_what_else_decides_a_result_counts(mine, key, change):
    if "scenario" in change:
        plain = {"scenario": lambda s: replace(s, fingerprint=None)}
        inner = change["scenario"]
        change = {"scenario": lambda s: inner(replace(s, fingerprint=None))}
    else:
        plain = {}
    assert key(mine, **change) != key(mine, **plain)
    assert key(mine, **change) == key(mine, **change)


def test_versions_count(mine, key, monkeypatch):
    monkeypatch.setattr("lerobot_roborecover.platforms.versions.required", lambda platform: {"engine": "1"})
    before = key(mine, env=["strict_versions=false"])
    monkeypatch.setattr("lerobot_roborecover.platforms.versions.installed", lambda name: "9.9")
    assert key(mine, env=["strict_versions=false"]) != before


def test_nothing_else_counts(mine, key, tmp_path):
    before = key(mine, rename_map={"a": "b", "c": "d"})
    same = {"rename_map": {"c": "d", "a": "b"}}
    assert key(mine, **same) == before, "order of a rename map"
    assert key(mine, n_episodes=4, batch_size=2, **same) == before
    assert key(mine, env=["shard=0/3"], **same) == before
    assert key(mine, order=-1, **same) == before
    for file in mine.rglob("*"):
        os.utime(file, (1, 1))
    assert key(mine, **same) == before, "times"
    (mine / "README.md").write_text("a card")
    (mine / "train_config.json").write_text("{}")
    (mine / ".cache").mkdir()
    (mine / ".cache" / "lock").write_text("x")
    (mine / "up").symlink_to(mine.parent)
    results = mine / "eval"
    results.mkdir()
    for name in ("trials.jsonl", "eval_info.json", "anything.json"):
        (results / name).write_text("x")
    assert key(mine, **same) == before, "files that are not loaded"
    elsewhere = tmp_path / "other" / "act"
    shutil.move(mine, elsewhere)
    assert key(elsewhere, **same) == before, "where the folder is"


def test_an_adapters_base_on_the_hub_counts(mine, monkeypatch):
    commits = {"lab/base": "a" * 40}
    monkeypatch.setattr(
        "lerobot_roborecover.policies.identity.snapshot_folder",
        lambda path, revision=None: Path("/snapshots") / (revision or commits[path]),
    )
    _point_to_base(mine, Path("lab/base"))
    before = policy_identity(mine)
    commits["lab/base"] = "b" * 40
    assert policy_identity(mine) != before
    commits["lab/policy"] = "c" * 40
    assert policy_identity("lab/policy") == f"lab/policy@{'c' * 12}"
    assert policy_identity("lab/policy", "d" * 40) == f"lab/policy@{'d' * 12}"


def test_every_part_of_a_composite_policy_counts(mine, key, tmp_path):
    from lerobot_roborecover.policies.interventions.configuration_intervention import (
        MemberConfig,
        MonitorConfig,
        RoboRecoverInterventionConfig,
    )

    correction = tmp_path / "correction"
    monitor = tmp_path / "monitor"
    shutil.copytree(mine, correction)
    shutil.copytree(mine, monitor)

    def composite(member: str = "", mode: str = "monitor_correction", **change):
        given = {"base": {"path": str(mine)}, "correction": {"path": str(correction)},
                 "monitor": {"path": f"{monitor},lag=15"}}  # fmt: skip
        if member:
            given[member] |= change
            change = {}
        return key(
            RoboRecoverInterventionConfig(
                base=MemberConfig(**given["base"]), correction=MemberConfig(**given["correction"]),
                monitor=MonitorConfig(**given["monitor"]), mode=mode, device="cpu", **change,
            )
        )  # fmt: skip

    before = composite()
    assert composite() == before
    changes = [
        {"member": "base", "n_action_steps": 1}, {"member": "base", "rename_map": {"a": "b"}},
        {"member": "correction", "n_action_steps": 1}, {"member": "correction", "rename_map": {"a": "b"}},
        {"member": "monitor", "threshold": 0.5}, {"member": "monitor", "path": f"{monitor},lag=16"},
        {"member": "monitor", "base_model": str(mine)}, {"correction_steps": 7}, {"mode": "correction"},
        {"use_amp": True},
    ]  # fmt: skip
    keys = [composite(**change) for change in changes]
    assert len({before, *keys}) == len(changes) + 1
    for folder in (mine, correction, monitor):
        file = folder / "policy_postprocessor.json"
        content = file.read_bytes()
        file.write_bytes(content + b" ")
        assert composite() != before, folder
        file.write_bytes(content)
    assert composite() == before


@pytest.fixture
def remote(tmp_path, monkeypatch):
    """A remote policy's configuration, and what its server says of itself."""
    from lerobot_roborecover.policies.remote import servers
    from lerobot_roborecover.policies.remote.configuration_remote import RemoteConfig

    metadata: dict = {}
    server = SimpleNamespace(reach=lambda: metadata, close=lambda: None)
    monkeypatch.setattr(servers, "make_server", lambda config, mapping: server)
    mapping = tmp_path / "mine.yaml"
    text = "version: 1\nabout: a server\nimages: [{source: observation.image, key: image}]\n"
    mapping.write_text(text)
    return metadata, mapping, lambda **more: RemoteConfig(mapping=str(mapping), **more)


def test_a_remote_policys_mapping_and_server_count(remote, key):
    metadata, mapping, config = remote
    before = key(config())
    mapping.write_text("# a remark\n" + mapping.read_text())
    assert key(config()) == before, "the content says the same"
    moved = mapping.with_name("folder") / mapping.name
    moved.parent.mkdir()
    moved.write_text(mapping.read_text())
    assert key(replace(config(), mapping=str(moved))) == before
    assert key(config(connections=2, timeout_s=5.0, wait_s=1.0, give_up_after=9)) == before
    metadata["started_at"] = "now"
    assert key(config()) == before, "nothing that tells the policy"
    mapping.write_text(mapping.read_text().replace("key: image", "key: image, flip: horizontal"))
    after = key(config())
    assert after != before
    named = key(config(name="mine"))
    assert key(config(name="mine", n_action_steps=3)) != named
    assert key(config(name="mine", url="ws://127.0.0.1:9000")) == named, "the user vouches for the name"
    metadata["identity"] = "act@1"
    first = key(config(name="mine"))
    metadata["identity"] = "act@2"
    assert len({named, first, key(config(name="mine"))}) == 3


def test_a_row_says_that_a_servers_weights_are_not_known(remote):
    from lerobot_roborecover.policies.metadata import policy_metadata

    metadata, _, config = remote
    metadata["checkpoint"] = "pi0"
    settings = policy_metadata(config()).policy_settings
    assert settings["server"] == {"checkpoint": "pi0"}
    assert settings[UNKNOWN_WEIGHTS] == "not known"
    metadata["identity"] = "pi0@1"
    settings = policy_metadata(config()).policy_settings
    assert settings["server"] == "pi0@1"
    assert UNKNOWN_WEIGHTS not in settings


def test_all_that_a_policy_object_holds_counts(mine):
    import torch
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies import get_policy_class, make_pre_post_processors

    config = PreTrainedConfig.from_pretrained(mine)
    policy = get_policy_class("act").from_pretrained(mine, config=config)
    policy.register_buffer("counter", torch.zeros(3), persistent=False)
    policy.register_buffer("halves", torch.zeros((), dtype=torch.bfloat16))
    both = make_pre_post_processors(config, pretrained_path=str(mine))
    before = object_identity(policy, both)
    assert object_identity(policy, both) == before
    with torch.no_grad():
        for name, tensor in [*policy.named_parameters(), *policy.named_buffers()]:
            last = tensor.view(-1)[-1:]
            value = last.clone()
            last.fill_(float(value) + 1)
            assert object_identity(policy, both) != before, name
            last.copy_(value)
    assert object_identity(policy, both) == before
    policy.config.n_action_steps = 1
    assert object_identity(policy, both) != before
    policy.config.n_action_steps = 2
    policy.config.repo_id = "lab/act"
    assert object_identity(policy, both) == before
    for processor in both:
        (normalizer,) = [s for s in processor.steps if s.state_dict()]
        tensor = next(iter(normalizer._tensor_stats.values()))["mean"]
        tensor += 1
        assert object_identity(policy, both) != before
        tensor -= 1
    assert object_identity(policy, both) == before


def test_a_configuration_without_its_checkpoint_is_refused(mine):
    from lerobot.configs.policies import PreTrainedConfig

    from lerobot_roborecover.policies.metadata import policy_metadata

    config = PreTrainedConfig.from_pretrained(mine)
    with pytest.raises(OptionError, match="names no checkpoint, so its weights would be random"):
        policy_metadata(config)
    config.pretrained_path = mine
    assert policy_metadata(config).policy.startswith("act@")
