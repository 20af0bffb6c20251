"""What a command line gets wrong is told before LeRobot's import, in one line with what is nearest."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_roborecover.cli.config_command import EVAL, RUN_PLAN, help_text
from lerobot_roborecover.evaluation.early_checks import CommandLine, env_class, join_values, policy_types
from lerobot_roborecover.platforms.env_options import NOT_OPTIONS
from lerobot_roborecover.utils.config_source import read_class
from tests.support.processes import PATIENCE_S

POLICY = str(Path(__file__).parents[2] / "lerobot_roborecover" / "data" / "metaworld_act")
SOUND = ["--env", "roborecover_metaworld", f"--policy.path={POLICY}", "--env.obs_type=state"]
INTERVENTION = ["--env", "roborecover_metaworld", "--policy.type=roborecover_intervention"]
REFUSALS = [
    (["eval"], "no environment: give --env with one of roborecover_libero, roborecover_metaworld"),
    (["eval", "--env=roborecover_metaworld"], "no policy: give a checkpoint with --policy.path="),
    (["eval", "--env", "roborecover_metawrld"], "the nearest is roborecover_metaworld"),
    (["eval", "--env.type=libero", f"--policy.path={POLICY}"], "the nearest is roborecover_libero"),
    (["eval", "--env.type=pusht"], "give --env roborecover_wrapped --env.base.type=pusht"),
    (["check", "policy", "--env=metaworld"], "the nearest is roborecover_metaworld"),
    (["eval", *SOUND, "--evl.n_episodes=5"], "no option --evl.n_episodes; the nearest is --eval.n_episodes"),
    (["eval", *SOUND, "--eval.nepisodes", "5"], "the nearest is --eval.n_episodes"),
    (["eval", *SOUND, "--env.splitt=test"], "no option --env.splitt; the nearest is --env.split"),
    (["eval", *SOUND, "--env.assets_dir=x"], "there is no option --env.assets_dir"),
    (["eval", *SOUND, "--policy.n_actoin_steps=5"], "the nearest is --policy.n_action_steps"),
    (["eval", *SOUND, "--runner.slot_count=5"], "there is no option --runner.slot_count"),
    (["eval", *SOUND, "--shrd=0/2"], "no option --shrd; the nearest is --shard"),
    (["eval", *SOUND, "--env.scenario=x"], "no option --env.scenario; the nearest is --env.scenarios"),
    (["eval", *SOUND, "--env.s=x"], "--env.s can be --env.scenarios, --env.select"),
    (["eval", *SOUND, "--shard=4/2"], "--env.shard=4/2: must be k/n"),
    (["eval", *SOUND, "--env.start=recover"], "--env.start=recover: not one of ['recovery'"),
    (["eval", *SOUND, "--eval.n_episodes=five"], "--eval.n_episodes=five: must be a whole number"),
    (["eval", *SOUND, "--env.realtime=si"], "--env.realtime=si: must be true or false"),
    (["eval", *SOUND, "--env.watchdog_s=1e"], "--env.watchdog_s=1e: must be a number"),
    (["eval", *SOUND, "--policy.type=act"], "a checkpoint has a type; leave one out"),
    (["eval", *SOUND, "stray", "words"], "'stray' belongs to no option"),
    (["eval", *SOUND[:2], "--policy.path", f"{POLICY}s"], f"the nearest is {POLICY}"),
    (["eval", "--env=roborecover_libero", SOUND[2]], "have 4 values, roborecover_libero takes 7"),
    (["eval", *SOUND[:2], "--policy.path="], "no policy: give a checkpoint"),
    (["eval", *SOUND[:2], "--policy.path=user/with a space"], "no Hub id (USER/NAME)"),
    (["eval", *SOUND[:2], "--policy.path=user//name"], "no Hub id (USER/NAME)"),
    (["eval", *SOUND[:2], "--policy.path", "nobody/nothing"], "the Hub cannot be reached or HF_HUB_OFFLINE"),
    (["eval", *SOUND[:2], "--policy.type=diffusoin"], "no such policy type; the nearest is diffusion"),
    (["eval", *INTERVENTION, f"--policy.base.path={POLICY}s"], f"--policy.base.path={POLICY}s: no LeRobot"),
    (["eval", *INTERVENTION, "--policy.base.pth=x"], "the nearest is --policy.base.path"),
    (["eval", "--config_path=none.yaml"], "--config_path=none.yaml: there is no such file"),
    (["check", "policy", *SOUND, "--jsno"], "no option --jsno; the nearest is --json"),
    (["serve", "--policy.path", f"{POLICY}s"], f"the nearest is {POLICY}"),
    (["serve", f"--policy.path={POLICY}", "--prot=1"], "no option --prot; the nearest is --port"),
    (["robot", "capture", f"--policy.path={POLICY}s"], f"the nearest is {POLICY}"),
    (["robot", "run", "--plam=x"], "no option --plam; the nearest is --plan"),
    (["curate", "collect", "--out=o", "--env.type=roborecover_metawrld"], "nearest is roborecover_metaworld"),
    (["curate", "collect", "--out=o", *SOUND[:2], f"--policy.path={POLICY}s"], f"the nearest is {POLICY}"),
    (["curate", "collect", "--out=o", *SOUND, "--env.renderquality=x"], "is --env.render_quality"),
    (["curate", "screen", "s", "--out=o", "--policy", f"a={POLICY}s"], f"--policy=a={POLICY}s: no LeRobot"),
    (["detect", "fork", "l", "--out=o", "--policy", f"{POLICY}s"], f"the nearest is {POLICY}"),
    (["demo", f"--policy.path={POLICY}s"], f"the nearest is {POLICY}"),
]  # fmt: skip
RUN = """
import contextlib, io, json, sys
from lerobot_roborecover.cli.main import main
found = []
for argv in json.load(sys.stdin):
    error = io.StringIO()
    with contextlib.redirect_stderr(error):
        try:
            status = main(argv)
        except SystemExit as end:
            status = end.code
    loaded = sorted({name.partition(".")[0] for name in sys.modules} & {"torch", "lerobot"})
    found.append([status, error.getvalue(), loaded])
print(json.dumps(found))
"""


def shown_options(words: list[str]) -> dict[str, str]:
    """The sentence of each option in the help, by its name."""
    text = help_text(EVAL.source, "", words)
    pairs = re.findall(r"^  (--[\w.]+)(?:[= ].*)?\n((?:      .*(?:\n|$))*)", text, re.MULTILINE)
    return {name: " ".join(doc.split()) for name, doc in pairs}


@pytest.mark.slow
def test_refusals_are_one_line_and_import_neither_lerobot_nor_torch():
    done = subprocess.run(
        [sys.executable, "-c", RUN], input=json.dumps([argv for argv, _ in REFUSALS]),
        capture_output=True, text=True, check=True, timeout=PATIENCE_S,
    )  # fmt: skip
    for (argv, said), (status, told, loaded) in zip(REFUSALS, json.loads(done.stdout), strict=True):
        assert (status, loaded) == (2, []), argv
        (line,) = told.splitlines()
        assert line.startswith("roborecover "), argv
        assert said in line, argv


@pytest.mark.parametrize("kind", ["roborecover_wrapped", "roborecover_lerobot", "roborecover_metaworld"])
def test_a_checkpoint_fits_its_own_platform_and_any_wrapped_environment(kind):
    line = CommandLine(EVAL.source, [f"--env.type={kind}", f"--policy.path={POLICY}"])
    line.check()
    line.check_action_widths()


def test_values_may_stand_behind_a_space():
    assert join_values(["--policy.path", "x", "--json", "--env", "a", "--b=c"]) == [
        "--policy.path=x", "--json", "--env=a", "--b=c",
    ]  # fmt: skip


@pytest.mark.parametrize("platform", ["libero", "metaworld", "robotwin", "fake", "lerobot"])
def test_help_has_a_sentence_for_every_option_of_an_environment(platform):
    shown = shown_options([f"--env=roborecover_{platform}"])
    found = env_class(platform)
    assert found is not None
    missing = {
        f"--env.{name}"
        for name, one in found.fields.items()
        if name not in (*NOT_OPTIONS, "max_parallel_tasks") and not one.doc.startswith("Earlier name of")
    } - set(shown)
    assert not missing
    assert "--policy.path" in shown
    assert not [name for name, doc in shown.items() if "." in name and len(doc.split()) < 3]


def test_help_shows_paths_with_their_defaults():
    text = help_text(RUN_PLAN.source, "", [])
    assert "--plan=PATH\n      Points, policies, repeats and seed (plan.yaml)" in text
    assert "--out=PATH" in text
    assert "--tls_key=PATH" in text


def test_help_with_a_policy_shows_its_options():
    assert "--policy.n_action_steps=N" in help_text(EVAL.source, "", [f"--policy.path={POLICY}"])
    assert "--policy.url=VALUE" in help_text(EVAL.source, "", ["--policy.type=roborecover_remote"])


@pytest.mark.lerobot
def test_the_source_says_what_the_classes_have():
    """A field or a type that the source's reader does not see would be refused though it is there."""
    import lerobot.policies  # noqa: F401 - registers types
    from lerobot.configs import PreTrainedConfig

    import lerobot_env_roborecover  # noqa: F401 - registers types
    from lerobot_roborecover.evaluation.check_policy import CheckPolicyConfig
    from lerobot_roborecover.evaluation.env_configs import ENV_TYPES

    def names(kind: type) -> set[str]:
        return {field.name for field in dataclasses.fields(kind)}

    for platform, kind in ENV_TYPES.items():
        if (found := env_class(platform)) is not None:
            assert set(found.fields) == names(kind), platform
    ours = ("lerobot.", "lerobot_roborecover.")
    types = {n: k for n, k in PreTrainedConfig.get_known_choices().items() if k.__module__.startswith(ours)}
    assert set(policy_types()) == set(types)
    for name, kind in types.items():
        found = read_class(*policy_types()[name])
        assert found is not None
        assert found.complete, name
        assert set(found.fields) == names(kind), name
    found = read_class(CheckPolicyConfig.__module__, CheckPolicyConfig.__name__)
    assert found is not None
    assert set(found.fields) == names(CheckPolicyConfig)


@pytest.mark.parametrize(("mine", "wanted"), [(None, "PASSIVE"), ("ACTIVE", "ACTIVE")])
def test_threads_of_the_policy_do_not_spin_unless_asked_to(mine, wanted):
    """Their runtime reads this when torch is loaded, so it has to be there before."""
    program = (
        "import os, sys, types\n"
        "from lerobot_roborecover.cli.main import main\n"
        "def seen(argv): print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules); return 0\n"
        "sys.modules['lerobot_roborecover.evaluation.runner'] = types.SimpleNamespace(main=seen)\n"
        "main(['eval', '--env.type=roborecover_fake', '--policy.type=act'])"
    )
    env = {k: v for k, v in os.environ.items() if k != "OMP_WAIT_POLICY"}
    env |= {} if mine is None else {"OMP_WAIT_POLICY": mine}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env=env, check=True
    )
    assert done.stdout.split() == [wanted, "False"]
