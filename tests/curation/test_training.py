"""Training data says of every frame what the logs say, and lerobot-train takes it as it is."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.analysis.stats.fork_gain import ForkNote
from lerobot_roborecover.curation.training.export import (
    ADVANTAGE,
    DONE,
    INTERVENTION,
    PROGRESS,
    PROGRESS_FILE,
    RETURN,
    REWARD,
    SUCCESS,
    VALUE,
    export_training,
)
from lerobot_roborecover.curation.training.lines import (
    TrainingLine,
    line_of_trial,
    lines_of_dataset,
    lines_of_log,
    trainable,
)
from lerobot_roborecover.curation.training.returns import returns_to_go, values
from lerobot_roborecover.datasets.lerobot_folder import local_repo_id
from lerobot_roborecover.datasets.trajectories import read_exact, read_trajectories
from lerobot_roborecover.datasets.trajectory_write import Trajectory, write_trajectories
from lerobot_roborecover.logs.row import ACTIONS_FOLDER, actions_digest, actions_path
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.scenario import ScenarioError
from tests.support.factories import fake_scenario
from tests.support.loop import push_policy
from tests.support.trial_rows import trial_row, write_log


def scenarios():
    return [replace(fake_scenario(i, horizon=60 if i else 12), split="train") for i in range(4)]


def driven(scenario, prefix: int | None = None, limit: int = 60) -> tuple[np.ndarray, bool]:
    """The test policy's (n, 2) float32 actions from a handoff, and whether they solve the task."""
    simulator = make_simulator("fake")
    simulator.reset(scenario.task, scenario.reset)
    for action in scenario.prefix[:prefix]:
        simulator.step(action)
    actions = []
    while not simulator.succeeded() and len(actions) < limit:
        actions.append(push_policy({"environment_state": simulator.observe()["environment_state"][None]})[0])
        simulator.step(actions[-1])
    return np.array(actions), simulator.succeeded()


def row_of(scenario, actions, success, trial=0, **changes):
    values = {
        "scenario_sha256": scenario.sha256(), "platform": "fake", "steps": len(actions),
        "horizon": scenario.task.horizon,
        "actions_sha256": actions_digest(actions), "handoff_step": len(scenario.prefix),
        "suite": scenario.task.suite, "task": scenario.task.name,
    }  # fmt: skip
    return trial_row(scenario.id, trial, success, **values | changes)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Four trials: plain ones, one with a takeover in its middle, one that ends by its horizon."""
    folder = tmp_path_factory.mktemp("trials")
    rows = []
    for number, scenario in enumerate(scenarios()):
        actions, success = driven(scenario, limit=scenario.task.horizon)
        took = {"kind": "takeover", "step": 3, "by": "schedule", "steps": 4}
        rows.append(row_of(scenario, actions, success, interventions=[took] if number == 1 else []))
        (folder / ACTIONS_FOLDER).mkdir(exist_ok=True)
        np.save(actions_path(folder / ACTIONS_FOLDER, rows[-1]), actions)
    return write_log(folder / "trials.jsonl", [*rows, trial_row("other", 0)]), rows


def test_a_rollback_is_taken_out_of_the_line():
    """Its line is replayed to the states that the trial was in; into the prefix as well."""
    scenario = scenarios()[0]
    actions = np.arange(20, dtype=np.float32).reshape(10, 2)
    back = {"kind": "rollback", "step": 6, "by": "monitor", "asked": 4, "distance": 4, "undone": 4}
    line = line_of_trial(scenario, row_of(scenario, actions, False, interventions=[back]), actions)
    assert line.actions[:, 0].tolist() == [0, 2, 12, 14, 16, 18]
    assert (line.replayed, line.first) == (10, 0)
    far = back | {"distance": 9, "undone": 6}
    line = line_of_trial(scenario, row_of(scenario, actions, False, interventions=[far]), actions)
    assert line.actions[:, 0].tolist() == [12, 14, 16, 18]
    assert line.replayed == 7 and len(line.start.prefix) == 7  # noqa: PT018
    # A fork begins where it was forked; what its rollback undid is not replayed.
    note = ForkNote("h", "a" * 64, 6, "rollback:4", 0, "matched").as_json()
    row = row_of(scenario, actions, False, interventions=[back | {"by": "fork"}], options={"fork": note})
    line = line_of_trial(scenario, row, actions)
    assert (line.first, line.steps, line.actions[line.first :, 0].tolist()) == (2, 4, [12, 14, 16, 18])
    # From the fork on, the actions are another policy's.
    note = note | {"arm": "policy:p"}
    line = line_of_trial(scenario, row_of(scenario, actions, False, options={"fork": note}), actions)
    assert line.intervention.tolist() == [False] * 6 + [True] * 4


def line(scenario, steps, success, trial=0, progress=None):
    return TrainingLine(
        scenario, 0, np.zeros((steps, 2)), 0, np.zeros(steps, bool), success, "p", trial, progress
    )  # fmt: skip


def test_returns_values_and_advantages_by_hand():
    a, b, c, _ = (replace(s, task=replace(s.task, name="push-left", horizon=10)) for s in scenarios())
    lines = [
        line(a, 2, True, progress=np.array([0.0, 0.55])),
        line(b, 3, False, progress=np.array([0.05, 0.5, 0.95])),
        line(c, 1, True, progress=np.array([0.09])),
        line(c, 1, True, 1, progress=np.array([0.2])),
    ]
    assert [returns_to_go(x).tolist() for x in lines] == [[-0.2, -0.1], [-1, -1, -1], [-0.1], [-0.1]]
    found = values(lines)
    assert found[0] == pytest.approx([(-1 - 0.1) / 2, -1])  # alike: b's first and c's; b's second
    assert found[1] == pytest.approx([(-0.2 - 0.1) / 2, -0.1, -0.5 / 4])  # its last: all others of the task
    assert found[2] == pytest.approx([(-0.2 - 1) / 2])
    assert values([lines[0]])[0] == pytest.approx(
        [-0.2, -0.1]
    )  # no other trial to compare with: no advantage


@pytest.mark.lerobot
@pytest.mark.slow
def test_every_frame_says_what_the_log_says(log, tmp_path):
    import pyarrow.parquet as pq
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.rewards.sarm.rabc import RABCWeights

    path, rows = log
    dropped: Counter = Counter()
    lines = lines_of_log(path, {s.id: s for s in scenarios()}, dropped)
    spoilt = replace(lines[2], success=not lines[2].success, trial=9)
    made = export_training(
        tmp_path / "set", [*lines, spoilt], simulator={"obs_type": "state"}, workers=1, dropped=dropped
    )
    assert dropped == {"of no scenario of the set": 1, "whose replay does not end as logged": 1}
    assert (made.episodes, made.interventions, made.progress_known) == (4, 4, True)
    data = read_trajectories(tmp_path / "set")
    assert [(r.success, r.steps, r.driver) for r in data.rows] == [
        (r.success, r.steps, r.policy) for r in rows
    ]
    exact = [actions for actions, _ in read_exact(tmp_path / "set")]
    assert all(np.array_equal(a, x.actions) for a, x in zip(exact, lines, strict=True))
    table = pq.read_table(next((tmp_path / "set" / "data").rglob("*.parquet"))).to_pydict()
    names = (SUCCESS, DONE, INTERVENTION, REWARD, PROGRESS, RETURN, VALUE, ADVANTAGE)
    columns = {k: np.array(table[k]) for k in names}
    at = 0
    for number, row in enumerate(rows):
        own = {k: v[at : at + row.steps] for k, v in columns.items()}
        at += row.steps
        assert own[SUCCESS].tolist() == [False] * (row.steps - 1) + [row.success]
        assert own[DONE].tolist() == [False] * (row.steps - 1) + [True]
        assert own[INTERVENTION].tolist() == [number == 1 and 3 <= k < 7 for k in range(row.steps)]
        assert own[REWARD].sum() == pytest.approx(own[RETURN][0], abs=1e-5)
        np.testing.assert_allclose(own[ADVANTAGE], own[RETURN] - own[VALUE], atol=1e-6)
        assert own[PROGRESS].max() < 1.0
    weights = RABCWeights(tmp_path / "set" / PROGRESS_FILE, chunk_size=4)
    assert [weights.progress_lookup[k] for k in range(at)] == pytest.approx(columns[PROGRESS].tolist())
    assert {weights.episode_lookup[k] for k in range(at)} == {0, 1, 2, 3}
    read = LeRobotDataset("local/training", root=tmp_path / "set")
    assert len(read) == at == made.frames
    assert read[rows[0].steps - 1][DONE].item() is True


@pytest.mark.parametrize("split", ["test", "unscreened"])
def test_scenarios_to_measure_on_train_nothing(split):
    test = replace(fake_scenario(0), split=split)
    dropped: Counter = Counter()
    assert trainable([line(test, 3, True)], dropped) == []
    assert dropped == {f"of the {split} split, which must not train anything": 1}
    with pytest.raises(ScenarioError, match="no episode is left"):
        export_training("out", [], simulator={}, workers=1, dropped=dropped)


@pytest.mark.lerobot
@pytest.mark.slow
def test_donors_are_sources_too(tmp_path):
    solved = ((s, *driven(s)) for s in scenarios())
    scenario, actions, _ = next(found for found in solved if found[2])
    frames = [{"observation.state": np.zeros(4, np.float32)}] * len(actions)
    donor = Trajectory(
        scenario.task, "good", actions.astype(np.float64), frames, True, scenario, len(scenario.prefix), 2,
        provenance={"actions_dtype": "float32"},
    )  # fmt: skip
    root = write_trajectories(tmp_path / "donors", "donors", [donor], fps=20)
    (found,) = lines_of_dataset(read_trajectories(root), {scenario.id: scenario}, Counter())
    assert found.actions.dtype == np.float32 and np.array_equal(found.actions, actions)  # noqa: PT018
    assert found.intervention.all() and found.success and found.driver == "good"  # noqa: PT018


@pytest.mark.lerobot
@pytest.mark.nightly
def test_lerobot_trains_on_it(log, tmp_path, monkeypatch, capsys):
    """SmolVLA, small and random, which takes weights of frames: without and with RA-BC, by option."""
    from huggingface_hub import constants
    from lerobot.rewards.sarm import rabc

    from lerobot_roborecover.cli.main import main
    from lerobot_roborecover.datasets import write_scenarios
    from tests.support.small_families import save_family
    from tests.support.small_hub import make_hub
    from tests.support.training import lerobot_train

    path, _ = log
    sets, out = write_scenarios(tmp_path / "scenarios", scenarios()), tmp_path / "set"
    argv = ["export-training", str(path), "--scenarios", str(sets), "--out", str(out)]
    assert main([*argv, "--env", "obs_type=pixels_agent_pos"]) == 0
    assert "--sample_weighting.type=rabc" in capsys.readouterr().out
    cache = make_hub(tmp_path / "hub")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(cache))
    base = save_family(tmp_path / "smolvla", "smolvla", cache, images=("observation.image",))
    asked = []
    plain = rabc.RABCWeights.compute_batch_weights

    def weighed(self, batch):
        weights, stats = plain(self, batch)
        asked.append((weights.tolist(), self.progress_column))
        return weights, stats

    monkeypatch.setattr(rabc.RABCWeights, "compute_batch_weights", weighed)
    rabc_options = ["--sample_weighting.type=rabc"]
    runs = {
        "plain": [],
        "sparse": rabc_options,
        "dense": [*rabc_options, "--sample_weighting.head_mode=dense"],
    }
    for name, options in runs.items():
        asked.clear()
        lerobot_train(
            f"--policy.path={base}", "--policy.device=cpu", "--policy.push_to_hub=false",
            f"--dataset.repo_id={local_repo_id(out)}", f"--dataset.root={out}",
            f"--output_dir={tmp_path / name}", "--steps=2", "--batch_size=4", "--num_workers=0",
            "--save_freq=2", *options,
        )  # fmt: skip
        assert (
            tmp_path / name / "checkpoints" / "000002" / "pretrained_model" / "model.safetensors"
        ).is_file()
        assert len(asked) == (2 if options else 0)
        assert all(sum(weights) == pytest.approx(4, abs=1e-3) for weights, _ in asked)
        assert {column for _, column in asked} == ({f"progress_{name}"} if options else set())
