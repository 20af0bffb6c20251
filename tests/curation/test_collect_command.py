"""`curate collect` as a whole: datasets, resumption, policies, refusals; and the real simulators."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.curation.collect.record import read_record
from lerobot_roborecover.curation.funnel import count_stages, read_decisions
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.platforms.libero import catalog
from lerobot_roborecover.replay.recorder import PERTURBED, UNREACHABLE
from lerobot_roborecover.scenario import Reset, Rollout, ScenarioError, Task
from tests.support.factories import save_policy

FAKE = ["collect", "--env.type=roborecover_fake", "--task=toy", "--horizon=25", "--slots=2"]


def arguments(out, *more):
    return [*FAKE, f"--out={out}", *more]


def meaning(root):
    """What a collection holds, times left out."""
    found = read_candidates(root)
    decisions = [(d.candidate, d.verdict, d.reason, d.detail, d.by) for d in read_decisions(root)]
    steps = [found.steps(i) for i in range(len(found))]
    return (
        found.candidates,
        found.trajectories.rows,
        [found.actions(i).tobytes() for i in range(len(found))],
        [[p.tobytes() for p in s.bodies.values()] + [s.perturbation.tobytes()] for s in steps],
        sorted(decisions),
    )


@pytest.mark.nightly
@pytest.mark.lerobot
def test_a_collection_is_the_same_however_often_it_is_stopped(tmp_path, monkeypatch, capsys):
    perturbed = ["--frames=none", "--expert=expert_biased", "--seeds=0-1", "--perturb", "--part-size=2"]
    assert main(arguments(tmp_path / "one", *perturbed)) == 0
    table = capsys.readouterr().out
    found = read_candidates(tmp_path / "one")
    (row,) = count_stages(read_decisions(tmp_path / "one"))
    assert f"{row.kept} candidates in" in table
    assert row.entered == 4  # every rollout is accounted for
    assert not any(found.steps(i).solved.any() for i in range(len(found)))
    assert {c.source for c in found.candidates} == {"perturbed"}
    assert (found.steps(0).perturbation == PERTURBED).sum() > 10

    from lerobot_roborecover.curation.collect import write as collect_write

    original, written = collect_write.write_candidates, []

    def stops(root, *args, **kwargs):
        if written:
            raise KeyboardInterrupt
        written.append(root)
        return original(root, *args, **kwargs)

    monkeypatch.setattr(collect_write, "write_candidates", stops)
    assert main(arguments(tmp_path / "two", *perturbed, "--slots=1")) == 130
    assert not (tmp_path / "two").exists()
    note = lambda root, *a, **k: written.append(root) or original(root, *a, **k)  # noqa: E731
    monkeypatch.setattr(collect_write, "write_candidates", note)
    assert main(arguments(tmp_path / "two", *perturbed, "--slots=1")) == 0
    assert len(set(written)) == len(written)  # a part that was there is not rendered again
    assert meaning(tmp_path / "one") == meaning(tmp_path / "two")

    # It is finished, and another one is refused with what differs.
    assert main(arguments(tmp_path / "one", *perturbed)) == 0
    assert "finished already" in capsys.readouterr().err
    assert main(arguments(tmp_path / "one", *perturbed, "--seed=8")) == 2
    assert "seed 7, now 8" in capsys.readouterr().err
    shared = f"--work={tmp_path / 'one.work'}"
    assert main(arguments(tmp_path / "three", *perturbed, shared, "--seed=8")) == 2
    assert "holds rollouts with other options (seed 7, now 8)" in capsys.readouterr().err
    touched = [*perturbed, shared, "--min-displacement=15", "--frames=32", "--slots=1"]
    assert main(arguments(tmp_path / "touched", *touched)) in (0, 1)
    assert "the disturbance did not touch the scene" in capsys.readouterr().out
    # Only what failed is run again without the disturbance: what succeeded is dropped anyway.
    rows = map(json.loads, (tmp_path / "one.work" / "rollouts.jsonl").read_text().splitlines())
    ended = {row["rollout"]: row["outcome"] for row in rows}
    twins = {n.removesuffix(".twin") for n in ended if n.endswith(".twin")}
    assert twins == {n for n in ended if not n.endswith(".twin") and ended[n] != "success"}
    assert twins


def frames_of(root):
    """All columns of a candidate dataset's episodes, row by row."""
    import pandas

    whole = pandas.concat([pandas.read_parquet(p) for p in sorted(root.glob("data/**/*.parquet"))])
    assert len(whole)
    return {name: np.stack(whole[name]).tobytes() for name in whole.columns}


@pytest.mark.lerobot
@pytest.mark.nightly
@pytest.mark.parametrize("driver", ["expert", "policy"])
def test_without_pictures_nothing_is_replayed_and_the_dataset_is_the_same(tmp_path, monkeypatch, driver):
    from lerobot_roborecover.curation.collect import run, write

    who = ["--expert=expert_biased"]
    if driver == "policy":
        who = [f"--policy.path={save_policy(tmp_path / 'act')}", "--env.obs_type=state"]
    common = [*who, "--seeds=0-1", "--frames=none", "--frame-stride=3", "--part-size=3"]
    with monkeypatch.context() as patch:
        patch.setattr(write, "map_ordered", lambda *_: pytest.fail("a rollout was replayed"))
        assert main(arguments(tmp_path / "recorded", *common)) == 0
    with monkeypatch.context() as patch:
        patch.setattr(run, "_sees_what_is_kept", lambda *_: False)
        assert main(arguments(tmp_path / "replayed", *common)) == 0
    assert meaning(tmp_path / "recorded") == meaning(tmp_path / "replayed")
    assert frames_of(tmp_path / "recorded") == frames_of(tmp_path / "replayed")
    # Records of a run that observed nothing are replayed, in the same folders.
    work = f"--work={tmp_path / 'replayed.work'}"
    assert main(arguments(tmp_path / "again", *common, work)) == 0
    assert frames_of(tmp_path / "again") == frames_of(tmp_path / "replayed")


@pytest.mark.lerobot
@pytest.mark.nightly
def test_a_policy_collects_the_same_whatever_the_slots(tmp_path, capsys):
    policy = save_policy(tmp_path / "act")
    common = [f"--policy.path={policy}", "--seeds=0-1", "--frames=none", "--env.obs_type=state"]
    assert main(arguments(tmp_path / "one", *common, "--slots=1")) == 0
    assert main(arguments(tmp_path / "three", *common, "--slots=3")) == 0
    assert meaning(tmp_path / "one") == meaning(tmp_path / "three")
    found = read_candidates(tmp_path / "one")
    assert {c.source for c in found.candidates} == {"natural"}
    assert found.row(0).driver.startswith("act@")
    # Exact: the simulator that is given the stored actions is where the rollout was.
    simulator = make_simulator("fake")
    simulator.reset(found.row(0).task_record(), found.row(0).reset_record())
    for action in found.actions(0):
        simulator.step(action)
    assert simulator.bodies() == found.steps(0).poses_at(found.row(0).steps)
    wide = save_policy(tmp_path / "wide", action=7)
    capsys.readouterr()
    refused = [f"--policy.path={wide}", "--seeds=0", "--env.obs_type=state"]
    assert main(arguments(tmp_path / "wide-out", *refused)) == 2
    assert "7 values" in capsys.readouterr().err


@pytest.mark.lerobot
@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--seeds=0"], "give either --policy"),
        (["--seeds=0", "--expert=expert", "--policy.path=x"], "not both"),
        (["--expert=exprt", "--seeds=0"], "pushes the puck"),
        (["--expert=expert"], "--seeds 0-29"),
        (["--expert=expert", "--seeds=0", "--draw=2"], "seeds and draw"),
        (["--expert=expert", "--init-states=0"], "no stored init states"),
        (["--expert=expert", "--seeds=0", "--task=push-lefd"], "push-left"),
        (["--expert=expert", "--seeds=0", "--frames=9"], "16 to 2048"),
        (["--expert=expert", "--seeds=0", "--min-displacement=5"], "--perturb"),
        (["--expert=expert", "--seeds=0", "--no-exclude=jerk"], "erratic"),
        (["--expert=expert", "--seeds=0", "--env.control=3"], "control"),
        (["--policy.path=/nowhere", "--seeds=0"], "/nowhere"),
        (["--expert=expert", "--seeds=0", "--env.type=pusht"], "--env.type=pusht"),
    ],
)  # fmt: skip
def test_refusals_come_before_any_simulator(tmp_path, capsys, monkeypatch, more, message):
    from lerobot_roborecover.workers import slots

    monkeypatch.setattr(slots, "WorkerSlot", lambda *_: pytest.fail("a simulator was started"))
    try:
        status = main(arguments(tmp_path / "out", *more))
    except SystemExit as err:
        status = err.code
    assert status == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.lerobot
def test_something_else_in_the_folder_is_left_alone(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    assert main(arguments(tmp_path, "--expert=expert", "--seeds=0")) == 2
    assert "something other than a collection" in capsys.readouterr().err
    assert (tmp_path / "notes.txt").read_text() == "mine"


def dtypes(observation):
    """Of its arrays, by the same keys."""
    return {k: dtypes(v) if isinstance(v, dict) else v.dtype for k, v in observation.items()}


@pytest.mark.metaworld
def test_metaworld_perturbed_and_replayed_exactly(tmp_path):
    from lerobot_roborecover.curation.collect.server import CollectServer, VideoJob
    from lerobot_roborecover.curation.collect.starts import make_units
    from lerobot_roborecover.platforms import platform_named
    from lerobot_roborecover.platforms.catalog import choose_tasks
    from lerobot_roborecover.platforms.starts import Starts
    from lerobot_roborecover.workers.messages import SlotConfig
    from tests.curation.test_collect import ask, drive

    tasks = choose_tasks(platform_named("metaworld").tasks(), ["reach-wall-v3", "push-v3"])
    made = make_units(tasks, Starts(seeds=(0,)), "expert_biased", np.zeros(4), perturbed=True)
    settings = {"seed": 7, "expert": "expert_biased", "observe_every": 1}
    server = CollectServer(SlotConfig("metaworld", {"obs_type": "state"}, settings=settings))
    renderer = CollectServer(SlotConfig("metaworld", {"obs_type": "state"}))
    flags = set()
    for scenario in made:
        ended = drive(server, tmp_path, scenario)
        record = read_record(tmp_path / f"{scenario.id}.npz")
        assert len(record.actions) == ended.steps
        flags |= set(record.steps.perturbation[:150].tolist())
        poses = np.stack(list(record.steps.bodies.values()))
        job = VideoJob(
            Rollout(scenario.task, record.reset, record.actions), tuple(record.steps.bodies), poses
        )
        replayed = ask(renderer, "render", job)
        assert replayed.error_m == 0.0
        assert len(record.observations) == len(replayed.observations) == len(record.actions)
        for ours, theirs in zip(record.observations, replayed.observations, strict=True):
            np.testing.assert_equal(ours, theirs)
            assert dtypes(ours) == dtypes(theirs)
        box = record.workspace
        inside = record.actions[record.steps.perturbation == PERTURBED]
        assert len(inside)
        assert box.low_m[0] == -0.5
    assert flags == {PERTURBED, UNREACHABLE}


@pytest.mark.metaworld
def test_metaworld_reach_is_where_the_hand_is_stopped():
    simulator = make_simulator("metaworld", obs_type="state")
    task = Task("metaworld", "easy", "reach-v3", "reach", 500)
    simulator.reset(task, Reset(seed=0))
    up, before = np.array([0.0, 0.0, 1.0, 0.0]), simulator.state_sha256()
    assert simulator.reachable(up)
    assert simulator.reachable(5 * up)  # clipped: the input's range is no limit of reach
    assert simulator.state_sha256() == before
    for _ in range(60):
        simulator.step(up)
    assert not simulator.reachable(up)
    assert simulator.reachable(-up)


@pytest.mark.nightly
@pytest.mark.libero
def test_libero_reach_ends_with_the_arm_and_changes_nothing():
    simulator = make_simulator("libero", obs_type="state")
    task = Task("libero", "libero_goal", "put_the_bowl_on_the_plate", "put the bowl on the plate", 300)
    simulator.reset(task, Reset(seed=7, init_state_index=0))
    before = simulator.state_sha256()
    rng = np.random.default_rng(0)
    assert all(simulator.reachable(np.array([*rng.uniform(-1, 1, 3), 0, 0, 0, -1])) for _ in range(20))
    assert simulator.joint_margin_rad() > 0.3
    assert simulator.state_sha256() == before
    away = np.array([1.0, 1.0, -0.3, 0, 0, 0, -1])
    for _ in range(40):
        simulator.step(away)
    assert not simulator.reachable(away)
    assert simulator.reachable(-away)
    box = simulator.workspace()
    assert box.low_m[:2] == (-0.5, -0.6)  # LIBERO's kitchen table
    assert box.support_m == 0.9


@pytest.mark.nightly
@pytest.mark.libero
def test_libero_s_rollouts_record_what_their_replays_see(tmp_path):
    from lerobot_roborecover.curation.collect.server import CollectServer, VideoJob
    from lerobot_roborecover.curation.collect.starts import make_units
    from lerobot_roborecover.platforms.libero import PLATFORM
    from lerobot_roborecover.platforms.starts import Starts
    from lerobot_roborecover.workers.messages import SlotConfig
    from tests.curation.test_collect import ask, drive

    task = Task("libero", "libero_goal", "put_the_bowl_on_the_plate", "put the bowl on the plate", 40)
    (made,) = make_units([task], Starts(init_states=(3,)), "scripted", PLATFORM.no_op(), perturbed=True)
    settings = {"seed": 7, "expert": "scripted", "observe_every": 1}
    server = CollectServer(SlotConfig("libero", {"obs_type": "state"}, settings=settings))
    drive(server, tmp_path, made)
    record = read_record(tmp_path / f"{made.id}.npz")
    poses = np.stack(list(record.steps.bodies.values()))
    job = VideoJob(Rollout(task, record.reset, record.actions), tuple(record.steps.bodies), poses)
    replayed = ask(CollectServer(SlotConfig("libero", {"obs_type": "state"})), "render", job)
    assert replayed.error_m == 0.0
    for ours, theirs in zip(record.observations, replayed.observations, strict=True):
        np.testing.assert_equal(ours, theirs)
        assert dtypes(ours) == dtypes(theirs)


@pytest.mark.lerobot
def test_a_dry_run_lists_the_rollouts(tmp_path, capsys):
    assert main([*FAKE, f"--out={tmp_path / 'x'}", "--expert=expert", "--draw=2", "--dry-run"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "4 rollouts; dry run: nothing was run"
    assert not (tmp_path / "x.work").exists()


@pytest.mark.libero
def test_tasks_that_a_scripted_controller_cannot_do_are_left_out_by_name(tmp_path, capsys, monkeypatch):
    monkeypatch.delitem(catalog.PREDICATES, "turnon")
    command = ["collect", "--env.type=roborecover_libero", "--expert=scripted", "--init-states=0"]
    command += ["--dry-run", f"--out={tmp_path / 'out'}"]
    assert main([*command, "--task=libero_goal"]) == 0
    said = capsys.readouterr()
    assert "9 rollouts" in said.out
    assert "libero_goal/turn_on_the_stove (no scripted controller knows turnon flat_stove_1)" in said.err
    assert main([*command, "--task=libero_goal/turn_on*"]) == 2
    said = capsys.readouterr().err
    assert "can do none of these tasks" in said
    assert "--policy.path=CHECKPOINT" in said


def test_rollouts_whose_policy_was_away_are_told_and_left_for_another_run(tmp_path, monkeypatch):
    """As where a cluster's machine with the policy is lost for good."""
    from lerobot_roborecover.curation.collect.rollouts import run_policy

    class Away:
        reruns = 0
        unrun: ClassVar = {("toy-p-s0", 0): "nobody answers"}

        def run(self, units, stop):
            assert [u.scenario.seed for u in units] == [0]
            return 0

    monkeypatch.setattr("lerobot_roborecover.evaluation.launch.open_engine", lambda *_, **__: Away())
    planned = SimpleNamespace(seed=0, trial=0)
    with pytest.raises(ScenarioError, match=r"1 trial could not be run.*nobody answers.*command again"):
        run_policy(
            [[planned], []], None, None, None, driver="p", seed=7, most=1, on_end=lambda ended, record: None
        )
