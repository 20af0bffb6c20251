"""What RoboTwin's simulator refuses, and what it says then; and trials that end as rows with a reason."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.platforms import SimulatorError, make_simulator
from lerobot_roborecover.platforms.robotwin import PLATFORM
from lerobot_roborecover.platforms.robotwin.checkout import RobotwinCheckout
from lerobot_roborecover.platforms.robotwin.setup import import_task, mend
from lerobot_roborecover.scenario import Reset, Scenario, ScenarioError, Task
from tests.support.loop import evaluate
from tests.support.robotwin_checkouts import ROOT, STANDIN, on_standin

pytestmark = pytest.mark.robotwin

TASK = Task("robotwin", "demo_clean", "stack_blocks_two", "Stack the blocks.", 800)


@pytest.fixture(scope="module")
def simulator():
    made = make_simulator("robotwin", robotwin_root=ROOT, obs_type="state")
    made.reset(TASK, Reset(seed=3))
    yield made
    made.close()


@pytest.fixture
def copied(tmp_path):
    """A copy of the stand-in checkout that a test may damage."""
    return shutil.copytree(STANDIN, tmp_path / "RoboTwin")


def refusal(call, *words: str, error: type[Exception] = SimulatorError) -> None:
    with pytest.raises(error) as caught:
        call()
    for word in words:
        assert word in str(caught.value), str(caught.value)


def test_no_checkout_is_named(monkeypatch):
    monkeypatch.delenv("ROBOTWIN_ROOT", raising=False)
    refusal(RobotwinCheckout, "ROBOTWIN_ROOT", "--env.robotwin_root", "git")


def test_a_folder_that_is_no_checkout(tmp_path):
    refusal(lambda: RobotwinCheckout(tmp_path), "not a RoboTwin checkout", str(tmp_path))
    refusal(lambda: RobotwinCheckout(tmp_path / "absent"), "not a folder")


def test_an_incomplete_working_tree(copied):
    (copied / "task_config" / "_eval_step_limit.yml").unlink()
    refusal(lambda: RobotwinCheckout(copied), "incomplete", "_eval_step_limit.yml")


def test_the_robot_is_missing(copied):
    shutil.rmtree(copied / "assets" / "embodiments")
    refusal(lambda: RobotwinCheckout(copied).embodiment, "config.yml", "Download")


def test_the_newer_layout_is_found_and_is_the_same_code(copied):
    before = RobotwinCheckout(copied)
    limits, hashes = before.step_limits, before.hashes("stack_blocks_two")
    (copied / "env_cfg").mkdir()
    shutil.move(copied / "task_config", copied / "env_cfg" / "task_config")
    globals_file = copied / "envs" / "_GLOBAL_CONFIGS.py"
    globals_file.write_text(globals_file.read_text().replace("task_config/", "env_cfg/task_config/"))
    after = RobotwinCheckout(copied)
    assert after.configs == copied / "env_cfg" / "task_config"
    assert after.step_limits == limits
    assert after.hashes("stack_blocks_two") == hashes


def test_code_that_decides_physics_changes_the_hash_and_other_code_does_not(copied):
    hashes = RobotwinCheckout(copied).hashes("stack_blocks_two")
    base = copied / "envs" / "_base_task.py"
    text = base.read_text()
    base.write_text(text.replace("def play_once(self):", "def play_once(self, times=1):"))
    assert RobotwinCheckout(copied).hashes("stack_blocks_two") == hashes
    base.write_text(text.replace("1 / 250", "1 / 240"))
    assert RobotwinCheckout(copied).hashes("stack_blocks_two")["robotwin_code"] != hashes["robotwin_code"]


def test_commit_of_a_checkout(copied):
    assert RobotwinCheckout(copied).commit == ""
    (copied / ".git" / "refs" / "heads").mkdir(parents=True)
    (copied / ".git" / "HEAD").write_text("ref: refs/heads/main\n")
    (copied / ".git" / "packed-refs").write_text("# pack-refs\n" + "b" * 40 + " refs/heads/main\n")
    assert RobotwinCheckout(copied).commit == "b" * 40
    (copied / ".git" / "refs" / "heads" / "main").write_text("a" * 40 + "\n")
    assert RobotwinCheckout(copied).commit == "a" * 40


@pytest.mark.parametrize("width", [0, 7, 13, 15, 17])
def test_actions_of_another_width(simulator, width):
    refusal(lambda: simulator.step(np.zeros(width)), "14", "16", f"({width},)")


def test_actions_that_are_not_finite(simulator):
    action = np.zeros(14)
    action[3] = np.nan
    refusal(lambda: simulator.step(action), "finite")


def test_end_effector_actions_and_the_scripted_expert_without_curobo(simulator):
    if pytest.importorskip("lerobot_roborecover.platforms.robotwin.stubs").has_curobo():
        pytest.skip("curobo is installed: this tests what is said where it is not")
    refusal(lambda: simulator.step(np.zeros(16)), "curobo", "width 14")
    refusal(simulator.robotwin_task.task.play_once, "curobo", "play_once")


def test_before_the_first_reset():
    fresh = make_simulator("robotwin", robotwin_root=ROOT, obs_type="state")
    refusal(lambda: fresh.step(np.zeros(14)), "reset")
    refusal(fresh.bodies, "reset")


def test_options_out_of_range():
    for options, words in (
        ({"render_quality": "best"}, ("render_quality", "rt", "trivial")),
        ({"obs_type": "depth"}, ("obs_type", "state")),
        ({"action_mode": "velocity"}, ("action_mode", "joint")),
    ):
        refusal(lambda o=options: make_simulator("robotwin", robotwin_root=ROOT, **o), *words)


def test_unknown_tasks_and_configurations(simulator):
    refusal(
        lambda: PLATFORM.check_task(replace(TASK, name="stack_blocks_to")),
        "stack_blocks_two",
        error=ScenarioError,
    )
    unknown = replace(TASK, suite="robotwin_hard")
    refusal(lambda: simulator.reset(unknown, Reset(seed=1)), "demo_clean", error=ScenarioError)


def test_a_reset_without_a_seed(simulator):
    refusal(lambda: simulator.reset(TASK, Reset()), "seed")


def test_a_missing_instruction():
    refusal(lambda: replace(TASK, instruction=""), "instruction", error=ScenarioError)


@on_standin
def test_a_configuration_for_another_robot(simulator):
    other = replace(TASK, suite="other_robot")
    refusal(lambda: simulator.reset(other, Reset(seed=1)), "franka-panda", "aloha-agilex")


@on_standin
def test_an_unstable_seed_and_the_next_trial_after_it(simulator):
    refusal(lambda: simulator.reset(TASK, Reset(seed=13)), "seed 13", "rest", "plank")
    simulator.reset(TASK, Reset(seed=3))
    simulator.step(np.zeros(14))


@on_standin
def test_missing_objects_are_named_with_the_tasks_that_need_none():
    simulator = make_simulator("robotwin", robotwin_root=ROOT, obs_type="state")
    bell = replace(TASK, name="click_bell")
    refusal(lambda: simulator.reset(bell, Reset(seed=1)), "050_bell", "objects", "stack_blocks_two")
    simulator.reset(TASK, Reset(seed=1))


@pytest.mark.parametrize(("turned", "arm"), [(0.3, "left"), (3.0, "right")])
def test_open_laptop_knows_its_arm(turned, arm):
    import sapien

    pose = sapien.Pose(q=[np.cos(turned / 2), 0, 0, np.sin(turned / 2)])
    task = SimpleNamespace(laptop=SimpleNamespace(get_pose=lambda: pose))
    mend(task, "open_laptop")
    assert task.arm_tag == arm


@pytest.mark.parametrize(("x", "arm"), [(-0.2, "left"), (0.2, "right")])
def test_place_object_scale_and_put_object_cabinet_know_theirs(x, arm):
    import sapien

    for name in ("place_object_scale", "put_object_cabinet"):
        thing = SimpleNamespace(get_pose=lambda: sapien.Pose([x, 0, 0.8]))
        task = SimpleNamespace(object=thing)
        mend(task, name)
        assert task.arm_tag == arm
    assert task.origin_z == pytest.approx(0.8)


@pytest.mark.nightly
@on_standin
def test_trials_of_bad_scenarios_become_rows_and_the_run_goes_on(tmp_path):
    good = Scenario(
        id="good",
        task=replace(TASK, horizon=3),
        reset=Reset(seed=3),
        prefix=np.tile(np.array([0.01, *[0.0] * 5, 1.0] * 2), (2, 1)),
        stage="Approach",
        deviation="Wrong Pose",
        source="perturbed",
    )
    bad = [
        replace(good, id="unstable", reset=Reset(seed=13)),
        replace(good, id="bell", task=replace(good.task, name="click_bell")),
        replace(good, id="end-effector", prefix=np.zeros((2, 16))),
    ]
    write_scenarios(tmp_path / "set", [*bad, good])
    rows = evaluate(
        tmp_path / "set",
        tmp_path / "log.jsonl",
        trials=1,
        batch=1,
        workers=True,
        platform="robotwin",
        simulator={"robotwin_root": str(STANDIN), "obs_type": "state"},
        policy=lambda observation: observation["agent_pos"],
        strict_versions=False,
    )
    outcomes = {row.scenario_id: row for row in rows}
    assert outcomes["good"].outcome == "horizon"
    assert outcomes["good"].steps == 3
    for name, reason in (
        ("unstable", "seed 13"),
        ("bell", "050_bell"),
        ("end-effector", "planned by curobo, which is not installed"),
    ):
        assert outcomes[name].outcome == "sim_error"
        assert reason in outcomes[name].reason


@on_standin
def test_a_policy_of_another_width_is_a_policy_error(tmp_path):
    prefix = np.tile(np.array([0.01, *[0.0] * 5, 1.0] * 2), (1, 1))
    labels = {"stage": "Approach", "deviation": "Wrong Pose", "source": "natural"}
    scenario = Scenario(id="s", task=replace(TASK, horizon=3), reset=Reset(seed=3), prefix=prefix, **labels)
    write_scenarios(tmp_path / "set", [scenario])
    (row,) = evaluate(
        tmp_path / "set",
        tmp_path / "log.jsonl",
        trials=1,
        batch=1,
        platform="robotwin",
        simulator={"robotwin_root": str(STANDIN), "obs_type": "state"},
        policy=lambda observation: np.zeros((1, 15)),
        strict_versions=False,
    )
    assert (row.outcome, row.steps) == ("policy_error", 0)
    assert "(15,)" in row.reason
    assert "(14,)" in row.reason


def test_another_checkouts_code_is_already_imported(monkeypatch, tmp_path):
    other = ModuleType("envs")
    other.__path__ = [str(tmp_path / "RoboTwin" / "envs")]
    monkeypatch.setitem(sys.modules, "envs", other)
    checkout = RobotwinCheckout(ROOT)
    refusal(lambda: import_task(checkout, "stack_blocks_two"), "already imported", str(tmp_path), "worker")
