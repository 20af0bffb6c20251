"""Validation against a rollout's video, on the real Meta-World: the lossy frames of an exact replay pass, and
those of another state do not."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.curation.candidates import Candidate, read_candidates
from lerobot_roborecover.curation.candidates_write import Recording, write_candidates
from lerobot_roborecover.curation.rollout import record
from lerobot_roborecover.datasets import load_scenarios, read_scenarios, write_scenarios
from lerobot_roborecover.datasets.trajectory_write import Trajectory
from lerobot_roborecover.logs.row import ACTIONS_FOLDER, actions_digest, actions_path
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.platforms.simulator import iter_steps
from tests.support.trial_rows import trial_row

SIDE, STEPS, POINT = 96, 40, 25
RENDERING = {
    "obs_type": "pixels_agent_pos",
    "observation_height": SIDE,
    "observation_width": SIDE,
    "render_quality": "fast",
}


def recording(simulator, index: int, every: int, spoilt: bool) -> Recording:
    """A rollout of noise; a spoilt one shows a patch at its recovery point that was not there."""
    from lerobot_roborecover.datasets.episodes import to_frame

    known = load_scenarios("metaworld_starter")[0]
    rng = np.random.default_rng(index)
    actions = rng.uniform(-1, 1, (STEPS, 4))
    made = record(
        simulator, known.task, replace(known.reset, settle_steps=0), lambda t: actions[t], steps=STEPS,
        stop_when_solved=False,
    )  # fmt: skip
    frames = []
    for t in iter_steps(simulator, made.rollout, STEPS - 1):
        frames.append(to_frame("metaworld", simulator.observe()) if t % every == 0 else frames[-1])
    if spoilt:
        frames[POINT] = {
            k: np.where(np.indices(v.shape)[0] < 20, 255 - v, v) if v.ndim == 3 else v
            for k, v in frames[POINT].items()
        }
    return Recording(
        Candidate(f"c{index}", "natural"),
        Trajectory(
            known.task, "noise", made.rollout.actions, frames, False, reset=made.rollout.reset,
            provenance={"collect": {"film": {"every": every, "options": RENDERING}}},
        ),
        made.steps,
    )  # fmt: skip


@pytest.mark.metaworld
@pytest.mark.render
@pytest.mark.lerobot
@pytest.mark.nightly
def test_frames_of_the_video(tmp_path):
    simulator = make_simulator("metaworld", **RENDERING)
    recordings = (recording(simulator, i, 1 + i % 2, spoilt=i == 2) for i in range(3))
    write_candidates(tmp_path / "rollouts", recordings, fps=80, versions=simulator.fingerprint())
    candidates = read_candidates(tmp_path / "rollouts")
    scenarios = [candidates.scenario(f"c{i}", POINT, "Place", "Wrong Pose", {}) for i in range(3)]
    write_scenarios(tmp_path / "set", scenarios)
    folder = tmp_path / "trials" / "noise"
    (folder / ACTIONS_FOLDER).mkdir(parents=True)
    rows = []
    for scenario in scenarios:
        actions = np.random.default_rng(9).uniform(-1, 1, (6, 4)).astype(np.float32)
        row = trial_row(scenario.id, 0, False, platform="metaworld", scenario_sha256=scenario.sha256(),
                        steps=6, horizon=6, actions_sha256=actions_digest(actions))  # fmt: skip
        np.save(actions_path(folder / ACTIONS_FOLDER, row), actions)
        rows.append(json.dumps(asdict(row)) + "\n")
    (folder / "trials.jsonl").write_text("".join(rows))
    argv = ["validate", str(tmp_path / "set"), "--trials-folder", str(tmp_path / "trials"), "--runs", "1"]
    assert main([*argv, "--candidates", str(tmp_path / "rollouts"), "--out", str(tmp_path / "out")]) == 0
    kept = read_scenarios(tmp_path / "out")
    assert [s.id for s in kept] == ["c0", "c1"]
    for scenario in kept:
        note = scenario.provenance["validation"]
        assert note["mean_ssim"] > 0.999
        assert note["frames"].startswith("the rollout's video, the replay encoded likewise (libsvtav1 crf=30")
        assert max(note["eef_mm"], note["object_mm"]) == 0.0
    entries = [json.loads(x) for x in (tmp_path / "out.replays" / "replays.jsonl").read_text().splitlines()]
    found = {e["id"]: e["replays"] for e in entries}
    assert all(r["after_mm"] == 0.0 for r in found.values())
    assert np.mean(found["c2"]["ssim"]["observation.image"]) < 0.99
    assert (tmp_path / "out.replays" / "sheets" / "c2.png").exists()
