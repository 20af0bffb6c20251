"""`roborecover curate validate --states`: hashes for sets that have none; nothing else changes."""

from __future__ import annotations

from dataclasses import replace

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.curation import exactness
from lerobot_roborecover.curation.funnel import Decision, read_decisions, record_decisions
from lerobot_roborecover.curation.split_dataset import SPLIT_FILE
from lerobot_roborecover.datasets import read_scenarios, write_scenarios
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.frames import last_frames
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.scenario import Pose
from tests.support.factories import fake_scenario


def without_hash(scenario, **changes):
    return replace(scenario, fingerprint=replace(scenario.fingerprint, state_sha256="", **changes))


@pytest.fixture
def bare(tmp_path):
    """A divided set with decisions, labels and frames, whose scenarios have no hash, one no fingerprint."""
    found = [without_hash(fake_scenario(i, name="push-left")) for i in range(4)]
    found[1] = replace(found[1], split="train", cluster="c", provenance={"votes": [1, 2]})
    found[3] = replace(found[3], fingerprint=None)
    frames = [last_frames(make_simulator("fake", obs_type="pixels_agent_pos"), s) for s in found[:3]]
    root = tmp_path / "bare"
    write_scenarios(root, found, description="bare", license="MIT", frames=frames)
    record_decisions(root, [Decision(s.id, "screen", "kept") for s in found])
    (root / FOLDER / SPLIT_FILE).write_text('{"seed": 1}\n')
    return root


@pytest.mark.slow
def test_only_the_hash_is_new(bare, tmp_path, capsys):
    assert main(["validate", str(bare), "--states", "--out", str(tmp_path / "out")]) == 0
    assert "4 states, each replayed twice and identical; 4 had no hash" in capsys.readouterr().out
    before, after = read_scenarios(bare), read_scenarios(tmp_path / "out")
    for i, (old, new) in enumerate(zip(before, after, strict=True)):
        exact = fake_scenario(i, name="push-left").fingerprint
        assert new.fingerprint.state_sha256 == exact.state_sha256
        assert new.fingerprint.bodies == exact.bodies
        assert new.sha256() == old.sha256()
        assert new.prefix.tobytes() == old.prefix.tobytes()
        for name in ("id", "task", "reset", "stage", "source", "split", "cluster", "provenance"):
            assert getattr(new, name) == getattr(old, name)
    assert read_decisions(tmp_path / "out") == read_decisions(bare)
    assert (tmp_path / "out" / FOLDER / SPLIT_FILE).read_text() == '{"seed": 1}\n'
    frames = FrameStore(tmp_path / "out")
    assert all(frames.of(s) == FrameStore(bare).of(s) for s in after[:3])


def elsewhere(scenario):
    there = {n: Pose((p.position_m[0] + 0.003, *p.position_m[1:]), p.quat_xyzw)
             for n, p in scenario.fingerprint.bodies.items()}  # fmt: skip
    return without_hash(scenario, bodies=there)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (elsewhere, "3.00 mm from where it was recorded; the limit is 2 mm"),
        (lambda s: replace(s, fingerprint=replace(s.fingerprint, state_sha256="0" * 64)), "not the recorded"),
        (lambda s: replace(s, task=replace(s.task, suite="faults", name="raises")), "cannot be replayed"),
    ],
)
def test_one_that_does_not_fit_writes_nothing(tmp_path, capsys, change, message):
    good, bad = without_hash(fake_scenario(0)), change(fake_scenario(1, name="push-left", steps=30))
    write_scenarios(tmp_path / "set", [good, bad])
    assert main(["validate", str(tmp_path / "set"), "--states", "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "1 of 2 scenarios get no hash, so nothing is written" in said
    assert bad.id in said
    assert message in said
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_two_replays_that_differ_write_nothing(tmp_path, monkeypatch, capsys):
    write_scenarios(tmp_path / "set", [without_hash(fake_scenario(0))])
    real = exactness.replay_logged

    def other_state(*args, **kwargs):
        first, second = real(*args, **kwargs)
        return [first, {**second, "replay": {**second["replay"], "state_sha256": "b" * 64}}]

    monkeypatch.setattr(exactness, "replay_logged", other_state)
    assert main(["validate", str(tmp_path / "set"), "--states", "--out", str(tmp_path / "out")]) == 2
    assert "two replays reach different states" in capsys.readouterr().err


def test_a_validation_needs_its_trials(tmp_path, capsys):
    assert main(["validate", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "--trials-folder is missing" in capsys.readouterr().err
