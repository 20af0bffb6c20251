"""An EnvHub repository, made by the command and used as LeRobot uses such: `HubEnvConfig`, `make_env`."""

from __future__ import annotations

import json
import runpy
import shlex

import pytest

from lerobot_roborecover._version import __version__
from lerobot_roborecover.cli.main import main
from tests.support.factories import fake_dataset
from tests.support.hub_client import REPO, commit_of
from tests.support.hub_server import Repo

ENV_REPO = "lab/recovery-env"

USE = """
import json, sys
from dataclasses import dataclass
from lerobot.envs.configs import HubEnvConfig
from lerobot.envs.factory import make_env

@dataclass
class Ours(HubEnvConfig):
    start: str = "initial"
    trial_log: str = sys.argv[2]

cfg = Ours(hub_path=sys.argv[1], task=sys.argv[3] or None)
envs = make_env(cfg, n_envs=2, trust_remote_code=True)
steps = []
for group, scenarios in envs.items():
    for name, env in scenarios.items():
        env.reset(seed=[0, 1])
        *_, info = env.step(env.action_space.sample())
        steps.append([group, name, env.num_envs])
        env.close()
print(json.dumps({"envs": steps}))
"""


@pytest.mark.lerobot
@pytest.mark.slow
@pytest.mark.nightly
def test_lerobot_makes_the_environment_of_a_repository_on_the_hub(hub, client, tmp_path):
    commit = commit_of(client.publish(fake_dataset(tmp_path / "local", 6)))
    out = tmp_path / "env"
    made = client.roborecover("envhub", REPO, "--repo-id", ENV_REPO, "--split", "test", "--out", out)
    assert made.returncode == 0, made.stderr
    assert f"hf upload {ENV_REPO} {out}" in made.stdout
    text = (out / "env.py").read_text()
    assert commit in text, "the commit that was read, whatever main is later"
    wanted = (out / "requirements.txt").read_text().split()
    assert f"\npip install {shlex.join(wanted)}\n" in (out / "README.md").read_text()
    hub.repos[ENV_REPO] = repo = Repo()
    sha = repo.commit({path.name: path.read_bytes() for path in out.iterdir()})
    done = client.run(USE, f"{ENV_REPO}@{sha}", tmp_path / "log.jsonl", "")
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout.splitlines()[-1])["envs"]
    assert len(found) == 6
    assert {envs for *_, envs in found} == {2}


@pytest.mark.lerobot
def test_a_shipped_set_and_what_cannot_be_offered(tmp_path, capsys):
    from lerobot_roborecover.evaluation.envhub import HubScenarios, make_hub_processors

    common = ["--repo-id", "lab/env", "--out", str(tmp_path / "env")]
    assert main(["envhub", "metaworld_starter", *common]) == 0
    make_env = runpy.run_path(str(tmp_path / "env" / "env.py"))["make_env"]
    card = (tmp_path / "env" / "README.md").read_text()
    assert "--env.type=roborecover_metaworld --env.scenarios=metaworld_starter" in card
    wanted = f"lerobot_env_roborecover=={__version__}"
    assert f"\npip install {wanted}\n" in card, "no folder of this machine"
    assert callable(make_env)
    assert (tmp_path / "env" / "requirements.txt").read_text() == f"{wanted}\n"
    before, after = runpy.run_path(str(tmp_path / "env" / "env.py"))["make_env_processors"]()
    assert (before.steps, after.steps) == ([], []), "Meta-World needs none"
    before, _ = make_hub_processors(HubScenarios("libero", "libero_starter"))
    assert [type(step).__name__ for step in before.steps] == ["LiberoProcessorStep"]
    capsys.readouterr()
    folder = fake_dataset(tmp_path / "set", 2)
    assert main(["envhub", str(folder), *common]) == 2
    assert "roborecover dataset publish" in capsys.readouterr().err
    assert main(["envhub", "metaworld_study", *common]) == 2, "of a clone alone"
    assert "which others do not have" in capsys.readouterr().err
    assert main(["envhub", "metaworld_starter", "--repo-id", "no id", "--out", str(tmp_path / "x")]) == 2
    assert "org/name" in capsys.readouterr().err


def test_env_files_of_earlier_versions_find_their_import():
    from lerobot_roborecover.env.envhub import make_hub_env

    from lerobot_roborecover.env import envhub as before
    from lerobot_roborecover.evaluation import envhub

    assert make_hub_env is envhub.make_hub_env
    assert before.make_hub_env is envhub.make_hub_env
    assert before.HubScenarios is envhub.HubScenarios


@pytest.mark.lerobot
def test_fields_that_are_no_options_are_refused(tmp_path):
    from dataclasses import make_dataclass

    from lerobot.envs.configs import HubEnvConfig

    from lerobot_roborecover.errors import OptionError
    from lerobot_roborecover.evaluation.envhub import HubScenarios, make_hub_env

    odd = make_dataclass("Odd", [("startt", str, "initial")], bases=(HubEnvConfig,))
    with pytest.raises(OptionError, match=r"Odd.startt: no option.*start, "):
        make_hub_env(HubScenarios("fake", str(fake_dataset(tmp_path / "set", 2))), cfg=odd())
    chosen = make_dataclass(
        "Chosen", [("trial_log", str, str(tmp_path / "log.jsonl"))], bases=(HubEnvConfig,)
    )
    envs = make_hub_env(HubScenarios("fake", str(tmp_path / "set")), n_envs=1, cfg=chosen(task="push-left"))
    assert sum(len(group) for group in envs.values()) == 1
    for group in envs.values():
        for env in group.values():
            env.close()
