"""Checkpoints that cannot be loaded are one line with the remedy, in every command that loads a policy."""

from __future__ import annotations

import json
import re
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.policies.checkpoint import check_checkpoint
from tests.support.factories import fake_dataset, save_policy

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"


def weights(count: int = 4) -> bytes:
    header = json.dumps({"__metadata__": {}, "w": {"dtype": "F32", "shape": [count],
                                                  "data_offsets": [0, 4 * count]}}).encode()  # fmt: skip
    return struct.pack("<Q", len(header)) + header + bytes(4 * count)


def checkpoint(folder: Path, config: object = None, model: bytes | None = None) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps({"type": "act"} if config is None else config))
    (folder / "model.safetensors").write_bytes(weights() if model is None else model)
    return folder


def problem(path: Path | str) -> str:
    with pytest.raises(OptionError) as raised:
        check_checkpoint(path)
    text = str(raised.value)
    assert text.startswith(f"--policy.path={path}: ")
    assert "\n" not in text
    return text


def test_a_whole_one_passes(tmp_path):
    check_checkpoint(checkpoint(tmp_path / "whole"))
    remote = tmp_path / "remote"
    remote.mkdir()
    (remote / "config.json").write_text('{"type": "remote"}')
    check_checkpoint(remote)


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (POINTER, "model.safetensors is a git-LFS pointer, not the file itself. Run git lfs pull"),
        (weights()[:-1], r"has \d+ bytes where its header says \d+: it was cut"),
        (weights() + b"x", r"has \d+ bytes where its header says \d+: it was cut"),
        (weights()[:20], "is damaged"),
        (b"", r"\(0 bytes\) is damaged"),
        (struct.pack("<Q", 2**60) + bytes(100), "is damaged"),
        (struct.pack("<Q", 2) + b"[]", "is damaged"),
    ],
)
def test_weights_that_are_not_whole(tmp_path, model, words):
    assert re.search(words, problem(checkpoint(tmp_path / "it", model=model)))


def test_other_files_that_are_pointers(tmp_path):
    folder = checkpoint(tmp_path / "it")
    (folder / "policy_preprocessor_step_3_normalizer_processor.safetensors").write_bytes(POINTER)
    assert "normalizer_processor.safetensors is a git-LFS pointer" in problem(folder)
    (folder / "config.json").write_bytes(POINTER)
    assert "config.json is a git-LFS pointer" in problem(folder)


@pytest.mark.parametrize(
    ("config", "words"),
    [({"n_obs_steps": 1}, "no field 'type'"), ({"type": 3}, "no field 'type'"), ([], "no field 'type'")],
)
def test_a_configuration_of_something_else(tmp_path, config, words):
    assert words in problem(checkpoint(tmp_path / "it", config))


def test_a_configuration_that_is_no_json(tmp_path):
    folder = checkpoint(tmp_path / "it")
    (folder / "config.json").write_text('{"type": ')
    assert "config.json is not JSON" in problem(folder)


def test_which_folder_to_name_instead(tmp_path):
    run = tmp_path / "run"
    whole = checkpoint(run / "checkpoints" / "001000" / "pretrained_model")
    (run / "checkpoints" / "002000" / "training_state").mkdir(parents=True)
    assert problem(whole.parent).endswith(f"Name {whole}")
    assert problem(run).endswith(f"Name one of {whole}")
    assert problem(run / "checkpoints" / "002000").endswith(f"name one of {whole}")
    assert "its checkpoints/last/pretrained_model folder" in problem(tmp_path)
    assert "is a file" in problem(whole / "config.json")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("/nowhere/at/all", "no LeRobot policy there: there is no such folder"),
        ("~/policy", "your shell replaces ~ only at the start of a word"),
        ("nobody/such-a-policy", "the Hub cannot be reached or HF_HUB_OFFLINE is set"),
    ],
)
def test_what_is_neither_here_nor_on_the_hub(name, words, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    assert words in problem(name)


# --- commands


@pytest.fixture(scope="module")
def broken(tmp_path_factory):
    """A folder of checkpoints that LeRobot would end with a traceback of."""
    root = tmp_path_factory.mktemp("broken")
    whole = save_policy(root / "whole")
    for name in ("pointer", "cut", "no_weights", "typeless", "unknown", "other_weights", "no_processors"):
        shutil.copytree(whole, root / name)
    model = (whole / "model.safetensors").read_bytes()
    config = json.loads((whole / "config.json").read_text())
    (root / "pointer" / "model.safetensors").write_bytes(POINTER)
    (root / "cut" / "model.safetensors").write_bytes(model[:-100])
    (root / "typeless" / "config.json").write_text(json.dumps({**config, "type": None}))
    (root / "unknown" / "config.json").write_text(json.dumps({**config, "type": "act_of_tomorrow"}))
    (root / "other_weights" / "config.json").write_text(json.dumps({**config, "dim_model": 32}))
    (root / "no_weights" / "model.safetensors").unlink()
    (root / "no_processors" / "policy_preprocessor.json").unlink()
    (root / "checkpoints" / "1000").mkdir(parents=True)
    return root


@pytest.fixture(scope="module")
def scenarios(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", 2, horizon=5)


WORDS = {
    "pointer": "git-LFS pointer",
    "cut": "it was cut",
    "typeless": "no field 'type'",
    "unknown": "'act_of_tomorrow'",
    "other_weights": "config.json and the weights are of different policies",
    "no_processors": "no processor files",
    "no_weights": "the checkpoint is not whole",
    "checkpoints/1000": "a training step without pretrained_model",
    "nowhere": "no LeRobot policy there",
}


@pytest.mark.lerobot
@pytest.mark.parametrize(
    ("command", "name"),
    [
        *(("eval", name) for name in WORDS),
        *(
            (command, name)
            for command in ("serve", "collect", "member")
            for name in ("pointer", "other_weights", "nowhere")
        ),
        ("collect", "unknown"),
    ],
)
def test_every_command_says_it_in_one_line(command, name, broken, scenarios, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    policy, here = str(broken / name), f"--env.scenarios={scenarios}"
    run = ["eval", "--env", "roborecover_fake", here, "--runner.slots=1", f"--output_dir={tmp_path / 'out'}"]
    arguments = {
        "eval": [*run, f"--policy.path={policy}", "--policy.device=cpu"],
        "serve": ["serve", f"--policy.path={policy}", "--policy.device=cpu", "--port=0"],
        "collect": [
            "collect", "--env.type=roborecover_fake", f"--policy.path={policy}", "--device", "cpu",
            "--task", "push-left", "--seeds", "0", "--slots", "1", "--out", str(tmp_path / "out"),
        ],
        "member": [
            *run, "--policy.type=roborecover_intervention", "--policy.mode=reversion",
            f"--policy.base.path={policy}", "--policy.device=cpu",
        ],
    }[command]  # fmt: skip
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert "Traceback" not in said
    last = said.splitlines()[-1]
    assert last.startswith(f"roborecover {'eval' if command == 'member' else command}: ")
    assert policy in last
    assert WORDS[name] in last


@pytest.mark.slow
def test_eval_refuses_a_wrong_folder_before_lerobot_is_imported():
    program = (
        "import sys; from lerobot_roborecover.cli.main import main; "
        "status = main(['eval', '--env', 'roborecover_libero', '--policy.path=/nowhere/at/all']); "
        "sys.exit(status if not {'lerobot', 'torch'} & set(sys.modules) else 99)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "--policy.path=/nowhere/at/all: no LeRobot policy there: there is no such folder" in line
