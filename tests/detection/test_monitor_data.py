"""The monitor's data: labels, splits, what is rendered, and what is refused."""

from __future__ import annotations

import json
import shutil
import sys
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.curation.continuations import Continuation, from_rollouts
from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.datasets.trajectories import LABEL, ScenarioLink, read_trajectories
from lerobot_roborecover.detection.data.choice import (
    BALANCED,
    NATURAL,
    TRAIN,
    DataOptions,
    choose,
    split_scenarios,
)
from lerobot_roborecover.detection.data.data import STEP, check_disjoint, write_monitor_data
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.scenario import ScenarioError
from tests.support.factories import fake_scenario, save_policy

PIXELS = {"obs_type": "pixels_agent_pos", "observation_size": 64}


def continuation(index: int, trial: int = 0, steps: int = 8, *, prefix: int = 6) -> Continuation:
    """Noise for some steps from a fake scenario's recovery point, in float32 as a policy would give it."""
    scenario = replace(fake_scenario(index, steps=prefix), split="train", cluster=f"c{index // 2}")
    actions = np.random.default_rng([index, trial]).uniform(-1, 1, (steps, 2)).astype(np.float32)
    simulator = make_simulator("fake")
    simulator.reset(scenario.task, scenario.reset)
    for action in [*scenario.prefix, *actions]:
        simulator.step(action)
    return Continuation(scenario, f"noise{trial}", actions, simulator.succeeded(), trial)


@pytest.fixture(scope="module")
def continuations():
    return [continuation(i, trial) for i in range(8) for trial in range(2)]


@given(
    prefixes=st.lists(st.integers(5, 30), min_size=3, max_size=12), every=st.integers(1, 5),
    seed=st.integers(0, 9), balanced=st.booleans(),
)  # fmt: skip
@settings(max_examples=40, deadline=None)
def test_labels_and_splits_as_properties(prefixes, every, seed, balanced):
    scenario = replace(fake_scenario(0), fingerprint=None)
    made = [
        Continuation(
            replace(scenario, id=f"s{i}", prefix=np.zeros((n, 2))), "d", np.zeros((n % 7 + 2, 2)), False
        )
        for i, n in enumerate(prefixes)
    ]
    options = DataOptions(validation=0.34, every=every, seed=seed, train_balanced=balanced)
    parts = choose(made, options)
    for part, chosen in parts.items():
        labels = Counter(label for c in chosen for label in c.labels)
        if part == BALANCED or (part == TRAIN and balanced):
            assert labels[0] == labels[1]
        for c in chosen:
            t = c.continuation.recovery_step
            assert len(set(c.steps)) == len(c.steps)
            assert list(c.steps) == sorted(c.steps)
            assert c.labels == [int(s >= t) for s in c.steps]
            assert all((s - t) % every == 0 and 0 <= s < t + len(c.continuation.actions) for s in c.steps)
    used = {part: {c.continuation.scenario.id for c in chosen} for part, chosen in parts.items()}
    assert not used[TRAIN] & (used[BALANCED] | used[NATURAL])
    # The natural view holds the recovery point's frame of every held-out trajectory.
    assert all(c.continuation.recovery_step in c.steps for c in parts[NATURAL])


def test_clusters_can_stay_together(continuations):
    scenarios = [c.scenario for c in continuations]
    split = split_scenarios(scenarios, DataOptions(validation=0.5, split_by="cluster"))
    for scenario in scenarios:
        mates = {split[s.id] for s in scenarios if s.cluster == scenario.cluster}
        assert len(mates) == 1
    assert set(split.values()) == {"train", "validation"}


def test_a_test_split_can_be_held_out_as_a_whole(continuations):
    parts = choose(continuations, DataOptions(validation=1))
    assert TRAIN not in parts
    assert {c.continuation.scenario.id for c in parts[NATURAL]} == {c.scenario.id for c in continuations}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"validation": 20}, ["20 of 8", "none for training"]),
        ({"train_frames": 10_000}, ["train", "10000 frames", "allow"]),
        ({"natural_frames": 10_000}, ["validation_natural", "allow"]),
        ({"every": 0}, ["every=0"]),
        ({"split_by": "frame"}, ["'frame'", "scenario or cluster"]),
        ({"train_frames": 1}, ["train_frames=1", "at least 2"]),
    ],
)
def test_what_cannot_be_chosen_is_refused(continuations, options, words):
    with pytest.raises(ScenarioError) as caught:
        choose(continuations, DataOptions(**options))
    assert all(w in str(caught.value) for w in words), str(caught.value)


def test_a_scenario_in_both_parts_is_refused(continuations, tmp_path):
    parts = choose(continuations, DataOptions(validation=2))
    parts[NATURAL] = [*parts[NATURAL], parts[TRAIN][0]]
    with pytest.raises(ScenarioError, match="in training and in validation") as caught:
        write_monitor_data(tmp_path / "out", parts, simulator={})
    assert parts[TRAIN][0].continuation.scenario.id in str(caught.value)
    assert not (tmp_path / "out").exists()
    renamed = [ScenarioLink("a", "same", ""), ScenarioLink("b", "same", "")]
    with pytest.raises(ScenarioError, match="1 scenarios"):
        check_disjoint(renamed[:1], renamed[1:], "x")


@pytest.mark.nightly
@pytest.mark.lerobot
def test_frames_are_the_replay_s_own(continuations, tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    options = DataOptions(validation=2, train_frames=40, balanced_frames=20, seed=3)
    parts = choose(continuations, options)
    counts = write_monitor_data(tmp_path / "out", parts, simulator={}, workers=2, note={"why": "test"})
    labelled = {"frames": 40, "label0": 20, "label1": 20}
    assert counts[TRAIN] == {"ids": counts[TRAIN]["ids"], "trajectories": len(parts[TRAIN]), **labelled}
    manifest = json.loads((tmp_path / "out" / "monitor_data.json").read_text())
    assert manifest["counts"] == counts
    assert (manifest["why"], manifest["replays_that_end_otherwise"]) == ("test", [])
    before = (tmp_path / "out" / TRAIN / "meta" / "info.json").stat()
    assert write_monitor_data(tmp_path / "out", parts, simulator={}) == counts  # there already: kept
    assert (tmp_path / "out" / TRAIN / "meta" / "info.json").stat() == before
    other = choose(continuations, replace(options, seed=4))
    with pytest.raises(ScenarioError, match="holds other frames"):
        write_monitor_data(tmp_path / "out", other, simulator={})
    for part in (TRAIN, NATURAL):
        root = tmp_path / "out" / part
        found = read_trajectories(root)
        dataset = LeRobotDataset("lab/x", root=root)
        episodes = {(found.scenarios[r.scenario_index].id, r.driver): n for n, r in enumerate(found.rows)}
        starts = np.array(dataset.meta.episodes["dataset_from_index"])
        for chosen in parts[part][:2]:
            c = chosen.continuation
            simulator = make_simulator("fake")
            simulator.reset(c.scenario.task, c.scenario.reset)
            row = int(starts[episodes[c.scenario.id, c.driver]])
            for step, action in enumerate([*c.scenario.prefix, *c.actions]):
                if step in chosen.steps:
                    item = dataset[row]
                    seen = simulator.observe()
                    assert int(item[STEP]) == step
                    assert float(item[LABEL]) == float(step >= c.recovery_step)
                    wanted = seen["environment_state"].astype(np.float32)
                    assert item["observation.environment_state"].numpy().tobytes() == wanted.tobytes()
                    assert item["task"] == c.scenario.task.instruction
                    row += 1
                simulator.step(action)
        splits = {link.split for link in found.scenarios}
        assert splits == {"train" if part == TRAIN else "validation"}
        assert found.rows[0].provenance["replay_ends_as_recorded"] is True


@pytest.mark.lerobot
def test_recorded_continuations_are_taken_where_they_fit(continuations, tmp_path):
    from lerobot_roborecover.datasets.episodes import to_frame
    from lerobot_roborecover.datasets.trajectory_write import Trajectory, write_trajectories

    a, b, c, d = (continuations[i] for i in (0, 2, 4, 6))

    def recorded(item: Continuation, actions: np.ndarray, **more) -> Trajectory:
        simulator = make_simulator("fake")
        simulator.reset(item.scenario.task, item.scenario.reset)
        frames = [to_frame("fake", simulator.observe())] * len(actions)
        return Trajectory(
            item.scenario.task, "person", actions.astype(np.float64), frames, True, item.scenario, **more
        )

    whole = np.concatenate([b.scenario.prefix, b.actions])
    made = [
        recorded(a, a.actions, first_step=6, trial=1),
        recorded(b, whole),
        recorded(c, c.actions, first_step=3),
        recorded(d, d.actions, first_step=6),
    ]
    root = write_trajectories(tmp_path / "set", "rollouts", made, fps=20)
    dropped: Counter = Counter()
    known = {x.scenario.id: x.scenario for x in (a, b, c)}
    found = from_rollouts(read_trajectories(root), known, dropped)
    assert [(f.scenario.id, f.driver, f.trial) for f in found] == [
        (a.scenario.id, "person", 1), (b.scenario.id, "person", 0),
    ]  # fmt: skip
    assert np.array_equal(found[1].actions, b.actions.astype(np.float64))
    assert dropped == {
        "does not begin at the recovery point, nor repeat the prefix": 1,
        "belongs to no scenario of the set": 1,
    }


@pytest.mark.nightly
@pytest.mark.lerobot
def test_the_command_runs_policies_once_and_goes_on_where_it_stopped(tmp_path, capsys, monkeypatch):
    """Through the local engine; recorded actions are those that the log has the hash of."""
    from lerobot_roborecover.cli.main import main
    from lerobot_roborecover.curation import policy_trials
    from lerobot_roborecover.logs.row import actions_path

    scenarios = [replace(fake_scenario(i, horizon=14), split="train" if i < 5 else "test") for i in range(6)]
    root = write_scenarios(tmp_path / "set", scenarios)
    policies = [save_policy(tmp_path / "act"), save_policy(tmp_path / "act2", "diffusion")]
    argv = ["monitor-data", "--scenarios", str(root), "--out", str(tmp_path / "out"), "--validation", "2"]
    argv += [x for p in policies for x in ("--policy", str(p))]
    monkeypatch.setattr(sys, "argv", ["roborecover", *argv])
    assert main(argv) == 0
    counts = json.loads((tmp_path / "out" / "monitor_data.json").read_text())["counts"]
    assert counts["train"]["ids"] + counts["validation_natural"]["ids"] == 5
    assert counts["validation_natural"]["trajectories"] == 4
    assert "label 0" in capsys.readouterr().out
    # The same from kept trials: of one policy, of both, and of both where some are not there.
    from_kept = [
        x for folder in sorted((tmp_path / "out.trials").glob("?-*")) for x in ("--trials-from", str(folder))
    ]
    short = shutil.copytree(from_kept[1], tmp_path / "short")
    lines = (short / "trials.jsonl").read_text().splitlines(keepends=True)
    (short / "trials.jsonl").write_text("".join(lines[:2]))
    ways = {
        "one": ([*argv[-2:], *from_kept[:2]], 5),
        "both": (from_kept, 0),
        "all": ([*argv[-4:], *from_kept], 0),
        "some": ([*argv[-4:], "--trials-from", str(short), *from_kept[2:]], 3),
    }
    made = json.loads((tmp_path / "out" / "monitor_data.json").read_text())
    for name, (options, ran) in ways.items():
        out = tmp_path / name
        assert main([*argv[:3], "--out", str(out), *argv[5:7], *options]) == 0
        other = json.loads((out / "monitor_data.json").read_text())
        assert (other["counts"], other["drivers"]) == (made["counts"], made["drivers"])
        logs = list((tmp_path / f"{name}.trials").glob("*/trials.jsonl"))
        assert sum(len(log.read_text().splitlines()) for log in logs) == ran
    (short / "trials.jsonl").write_text("")
    assert main([*argv[:7], "--trials-from", str(short)]) == 2
    assert "it has no trial of the 5 scenarios" in capsys.readouterr().err
    # Interrupted after the first policy's first trials: the rest is run, what is there is kept.
    folder = next((tmp_path / "out.trials").glob("0-*"))
    before = policy_trials.read_trials(folder)  # in the order of the log
    assert len(before) == 5
    log = (folder / "trials.jsonl").read_text().splitlines(keepends=True)
    (folder / "trials.jsonl").write_text("".join(log[:2]))
    env = policy_trials.env_config("fake", str(root), ["--split=train"])
    ran = []
    again = policy_trials.run_trials(
        str(policies[0]), env, folder, on_row=lambda row, done, total: ran.append((done, total))
    )
    assert ran == [(3, 5), (4, 5), (5, 5)]
    kept = {t.row.scenario_id: t.actions.tobytes() for t in before[:2]}
    assert {t.row.scenario_id for t in again} == {t.row.scenario_id for t in before}
    assert sum(kept.get(t.row.scenario_id) == t.actions.tobytes() for t in again) == 2
    assert all(t.actions.shape == (t.row.steps, 2) and t.actions.dtype == np.float32 for t in again)
    # A log whose actions are gone, or are others, says so.
    path = actions_path(folder / "actions", again[0].row)
    np.save(path, again[0].actions + 1)
    with pytest.raises(ScenarioError, match="does not hold the actions"):
        policy_trials.read_trials(folder)
    path.unlink()
    with pytest.raises(ScenarioError, match="cannot be read"):
        policy_trials.read_trials(folder)
    assert main(argv[:-4]) == 2
    assert "no policy continues the scenarios" in capsys.readouterr().err
