"""Validation by replay: what is drawn, what is caught, and that order, resume and kills change nothing."""

from __future__ import annotations

import json
import multiprocessing
import re
import shutil
import signal
import time
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.curation.funnel import Decision, count_stages, read_decisions, record_decisions
from lerobot_roborecover.curation.validate.dataset import validate_dataset
from lerobot_roborecover.curation.validate.frames import Encoder, encoded, ssim, window
from lerobot_roborecover.curation.validate.request import ValidationRequest
from lerobot_roborecover.curation.validate.validation import (
    Replays,
    RunReplay,
    ValidationRule,
    draw_runs,
    format_validation,
    judge,
    replays_from,
)
from lerobot_roborecover.datasets import read_scenarios, write_scenarios
from lerobot_roborecover.datasets.frames import LastFrames, encode_png, last_frames
from lerobot_roborecover.logs.row import ACTIONS_FOLDER, actions_digest, actions_path
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.replay.handoff import hand_off
from lerobot_roborecover.scenario import Pose, ScenarioError
from tests.support.factories import fake_scenario
from tests.support.loop import push_policy
from tests.support.processes import PATIENCE_S
from tests.support.trial_rows import trial_row

NAMES = ("a", "b")


def screening_run(scenario, name: str, trial: int) -> tuple[np.ndarray, bool]:
    """(n, 2) float32 actions of the test policy with the trial's own noise, and whether it succeeded."""
    simulator = make_simulator("fake")
    hand_off(simulator, scenario, check=False)
    rng, actions = np.random.default_rng([trial, len(name)]), []
    while len(actions) < scenario.task.horizon and not simulator.succeeded():
        state = simulator.observe()["environment_state"][None]
        noise = rng.normal(0, 0.3, 2).astype("f4")
        actions.append(push_policy({"environment_state": state})[0] + noise)
        if scenario.task.suite != "faults":
            simulator.step(actions[-1])
        elif len(actions) == 15:
            break
    return np.array(actions, np.float32), simulator.succeeded()


def keep_trials(folder, scenarios, count: int = 3, names=NAMES) -> None:
    """Trials as `roborecover curate screen` leaves them."""
    for name in names:
        (folder / name / ACTIONS_FOLDER).mkdir(parents=True)
        lines = []
        for scenario in scenarios:
            for k in range(count):
                actions, success = screening_run(scenario, name, k)
                row = trial_row(
                    scenario.id, k, success, policy=f"{name}@1", platform="fake", steps=len(actions),
                    scenario_sha256=scenario.sha256(), actions_sha256=actions_digest(actions),
                    horizon=len(actions) if scenario.task.suite == "faults" else scenario.task.horizon,
                )  # fmt: skip
                np.save(actions_path(folder / name / ACTIONS_FOLDER, row), actions)
                lines.append(json.dumps(asdict(row)) + "\n")
        (folder / name / "trials.jsonl").write_text("".join(lines))


def moved(scenario, body: str, metres: float):
    """The scenario with one recorded body elsewhere."""
    pose = scenario.fingerprint.bodies[body]
    there = Pose((pose.position_m[0] + metres, *pose.position_m[1:]), pose.quat_xyzw)
    bodies = {**scenario.fingerprint.bodies, body: there}
    return replace(scenario, fingerprint=replace(scenario.fingerprint, bodies=bodies))


def test_the_draw_depends_on_scenario_and_seed_alone():
    runs = [(name, k) for name in "abcd" for k in range(5)]
    rule = ValidationRule()
    drawn = {f"s{i}": draw_runs(f"s{i}", runs, rule) for i in range(200)}
    assert all(len(set(d)) == 3 for d in drawn.values())
    assert drawn["s7"] == draw_runs("s7", runs, rule)
    assert drawn["s7"] != draw_runs("s7", runs, ValidationRule(seed=43))
    counts = np.bincount([runs.index(r) for d in drawn.values() for r in d], minlength=20)
    assert counts.min() > 10, "every run is drawn as often as the others"
    assert draw_runs("s", runs[:2], rule) == runs[:2]
    # Fixed: a later version must draw the same.
    assert draw_runs("fake-000", runs, rule) == draw_runs("fake-000", list(runs), ValidationRule(seed=42))


def replays(eef=0.0, objects=0.0, similar=(1.0,) * 5, ended=("success", 9), **changes) -> Replays:
    one = RunReplay("a", 0, eef, objects, "puck at step 9", False, "0" * 64, ("success", 9), ended)
    return replace(Replays((one,) * 3, None, {"top": similar}, "lossless"), **changes)


def unlike(found: Replays) -> Replays:
    """The last of the replays in a state of its own."""
    return replace(found, runs=(*found.runs[:-1], replace(found.runs[-1], state_sha256="1" * 64)))


@pytest.mark.parametrize(
    ("found", "reason"),
    [
        (replays(), ""),
        (replays(eef=1.999, objects=2.0), ""),
        (replays(eef=2.01), "end effector elsewhere"),
        (replays(objects=2.01), "objects elsewhere"),
        (replays(objects=float("nan")), "objects elsewhere"),
        (replays(similar=(1, 1, 1, 1, 0.96)), ""),
        (replays(similar=(0.99,) * 5), "frames differ"),
        (replays(ssim={"top": (1.0,) * 5, "wrist": (0.98,) * 5}), "frames differ"),
        (replays(ssim={}), "frames differ"),
        (replays(ended=("success", 8)), "screening run ends otherwise"),
        (replays(ended=("horizon", 9)), "screening run ends otherwise"),
        (replays(after_mm=2.5), "rollout goes on otherwise"),
        (replays(runs=replays().runs[:2]), "too few screening runs"),
        (unlike(replays()), "replays reach different states"),
        (Replays(error="it broke", error_kind="simulator crash"), "simulator crash"),
        (Replays(error="bad", error_kind="invalid action"), "invalid action"),
    ],
)
def test_limits(found, reason):
    decision = judge("s", found, ValidationRule())
    assert (decision.reason, decision.verdict) == (reason, "dropped" if reason else "kept")
    assert decision.stage == "validate"
    text = json.dumps(asdict(found))
    assert json.dumps(asdict(replays_from(json.loads(text)))) == text, "NaN is NaN in JSON, too"


def test_one_reason_counts_and_all_are_said():
    decision = judge("s", replays(eef=3, objects=4, similar=(0.5,) * 5), ValidationRule())
    assert decision.reason == "end effector elsewhere"
    assert "also: objects elsewhere, frames differ" in decision.detail
    alone = ValidationRule(frames=False, outcomes=False)
    assert judge("s", replays(similar=(0.5,) * 5, ended=("horizon", 1)), alone).verdict == "kept"


def test_the_table():
    found = {f"s{i}": replays(objects=i / 10) for i in range(11)}
    decisions = [judge(i, r, ValidationRule()) for i, r in found.items()]
    decisions.append(Decision("s3", "validate", "dropped", "rejected on inspection"))
    text = format_validation(found, decisions, ValidationRule())
    assert text.startswith("10 of 11 pass: 90.91 % [62.3, 98.4] (paper: 97.32 %)")
    assert re.search(r"objects, mm +0.50000 +0.95000 +1.00000 +2", text)
    assert "mean SSIM" in text
    assert "not compared" in format_validation(found, decisions, ValidationRule(frames=False))


@given(step=st.integers(0, 400), more=st.integers(1, 60), g=st.integers(1, 12))
@settings(max_examples=60, deadline=None)
def test_the_window_begins_on_a_keyframe(step, more, g):
    clip = window(step, step + more, Encoder("h264", "yuv420p", {}, 20, g))
    assert clip.start % g == 0
    assert clip.start <= max(step - 4, 0)
    assert step < clip.stop <= step + more


@pytest.mark.slow
def test_a_window_comes_out_as_it_does_in_the_whole_episode():
    """LeRobot's defaults; a lossless frame against a decoded one would not pass, the same frame must."""
    rng = np.random.default_rng(0)
    base = np.kron(rng.integers(0, 255, (16, 16, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    frames = [np.roll(base, (i, 2 * i), (0, 1)) for i in range(60)]
    options = {"g": "2", "crf": "30", "preset": "12", "svtav1-params": "fast-decode=0"}
    encoder = Encoder("libsvtav1", "yuv420p", options, 20, 2)
    whole = encoded(frames, encoder)
    for step in (4, 17, 30, 57):
        clip = window(step, 60, encoder)
        part = encoded([frames[i] for i in clip], encoder)
        wanted = range(step - 4, step + 1)
        original = np.stack([whole[i] for i in wanted])
        assert min(ssim(original, np.stack([part[i - clip.start] for i in wanted]))) > 0.999
        assert np.mean(ssim(original, np.stack([frames[i] for i in wanted]))) < 0.99


@pytest.fixture(scope="module")
def validated(tmp_path_factory):
    """Scenarios of which some were tampered with, validated once."""
    root = tmp_path_factory.mktemp("validate")
    good = [fake_scenario(i) for i in range(3)]
    # As `agree` makes them of candidates: poses are known, the state's hash is not.
    good[0] = replace(good[0], fingerprint=replace(good[0].fingerprint, state_sha256="", versions={}))
    good[1] = replace(good[1], fingerprint=None)
    whole = [fake_scenario(i) for i in range(3, 8)]
    changed = whole[2].prefix.copy()
    changed[4] += 0.5
    tampered = {
        whole[0].id: moved(whole[0], "puck", 0.003),
        whole[1].id: moved(whole[1], "eef", 0.003),
        whole[2].id: replace(whole[2], prefix=changed),
        whole[3].id: moved(whole[3], "puck", 0.001),
    }
    fault = fake_scenario(8, name="exits", suite="faults")
    scenarios = [*good, *tampered.values(), whole[4], fault]
    simulator = make_simulator("fake", obs_type="pixels_agent_pos")
    frames = [last_frames(simulator, s) for s in scenarios]
    picture = frames[7].arrays()["observation.image"][2].copy()
    picture[4:12, 4:12] = 0
    png = frames[7].png["observation.image"]
    altered = {"observation.image": (*png[:2], encode_png(picture), *png[3:])}
    frames[7] = LastFrames(frames[7].scenario_id, frames[7].sha256, frames[7].step, altered)
    write_scenarios(root / "set", scenarios, license="MIT", frames=frames)
    record_decisions(root / "set", [Decision(s.id, "screen", "kept") for s in scenarios])
    keep_trials(root / "trials", scenarios)
    # The log of one policy says the opposite of how its runs on one scenario ended.
    log = root / "trials" / "a" / "trials.jsonl"
    rows = [json.loads(line) for line in log.read_text().splitlines()]
    for row in rows:
        if row["scenario_id"] == good[2].id:
            success = not row["success"]
            row |= {"success": success, "outcome": "success" if success else "horizon"}
            row["steps"] = row["steps"] if success else row["horizon"]
    log.write_text("".join(json.dumps(row) + "\n" for row in rows))
    argv = ["validate", str(root / "set"), "--trials-folder", str(root / "trials"), "--workers", "2"]
    argv += ["--runs", "5"]
    assert main([*argv, "--out", str(root / "out")]) == 0
    return root, argv


def verdicts(out) -> dict[str, tuple]:
    return {
        d.candidate: (d.verdict, d.reason, d.detail) for d in read_decisions(out) if d.stage == "validate"
    }


@pytest.mark.lerobot
def test_what_was_tampered_with_is_caught(validated):
    root, _ = validated
    ids = [s.id for s in read_scenarios(root / "set")]
    found = verdicts(root / "out")
    assert [found[i][1] for i in ids] == [
        "", "", "screening run ends otherwise", "objects elsewhere", "end effector elsewhere",
        found[ids[5]][1], "", "frames differ", "simulator crash",
    ]  # fmt: skip
    assert found[ids[5]][1] in ("end effector elsewhere", "objects elsewhere")
    assert "3.000 mm (puck at step 10)" in found[ids[3]][2]
    assert "the worker died (exit status 3)" in found[ids[8]][2]
    kept = read_scenarios(root / "out")
    assert [s.id for s in kept] == [ids[0], ids[1], ids[6]]
    note = kept[0].provenance["validation"]
    assert note["frames"] == "lossless, of the scenario dataset"
    assert (note["mean_ssim"], note["eef_mm"], note["seed"], len(note["runs"])) == (1.0, 0.0, 42, 5)
    assert kept[2].provenance["validation"]["object_mm"] == pytest.approx(1.0)
    # The states that the replays reached are written; recorded poses stay what handoffs are held to.
    for scenario, index in zip(kept, (0, 1, 6), strict=True):
        exact = fake_scenario(index).fingerprint
        assert scenario.fingerprint.state_sha256 == exact.state_sha256
        assert scenario.fingerprint.versions == exact.versions
        assert scenario.fingerprint.step == exact.step
    assert kept[0].fingerprint.bodies == fake_scenario(0).fingerprint.bodies
    assert kept[1].fingerprint.bodies == fake_scenario(1).fingerprint.bodies
    assert kept[2].fingerprint.bodies == moved(fake_scenario(6), "puck", 0.001).fingerprint.bodies
    assert all(hand_off(make_simulator("fake"), s).identical for s in kept)
    assert count_stages(read_decisions(root / "out"))[-1].kept == 3
    page = (root / "out.replays" / "index.html").read_text()
    assert "base-uri 'none'; form-action 'none'" in page
    order = re.findall(r'<article id="([^"]+)"', page)
    assert len(order) == 9
    assert set(order[-3:]) == {s.id for s in kept}, "the worst first"
    assert len(list((root / "out.replays" / "sheets").glob("*.png"))) == 8


@pytest.mark.lerobot
def test_a_rerun_replays_nothing_and_people_decide(validated, tmp_path, monkeypatch, capsys):
    root, argv = validated
    shutil.copytree(root / "out", tmp_path / "out")
    shutil.copytree(root / "out.replays", tmp_path / "out.replays")
    argv = [*argv, "--out", str(tmp_path / "out")]
    # Starting a process fails.
    monkeypatch.setattr("lerobot_roborecover.workers.slots.WorkerSlot.__init__", None)
    first = read_scenarios(root / "out")[0].id
    assert main([*argv, "--reject", first, "--reason", "the puck is off the table", "--by", "ann"]) == 0
    assert first not in {s.id for s in read_scenarios(tmp_path / "out")}
    last = [d for d in read_decisions(tmp_path / "out") if d.candidate == first and d.stage == "validate"]
    assert [(d.verdict, d.reason, d.by) for d in last][1:] == [("dropped", "rejected on inspection", "ann")]
    assert last[-1].detail == "the puck is off the table"
    assert "rejected on inspection" in capsys.readouterr().out
    # It stands without being said again, and can be taken back.
    assert main(argv) == 0
    assert first not in {s.id for s in read_scenarios(tmp_path / "out")}
    assert main([*argv, "--accept", first]) == 0
    assert verdicts(tmp_path / "out") == verdicts(root / "out")
    (tmp_path / "rejects.txt").write_text(f"# looked at on Monday\n{first} not upright\n")
    assert main([*argv, "--rejects", str(tmp_path / "rejects.txt")]) == 0
    assert first not in {s.id for s in read_scenarios(tmp_path / "out")}


@pytest.mark.lerobot
def test_order_and_kills_change_nothing(validated, tmp_path):
    root, argv = validated
    scenarios = read_scenarios(root / "set")[:5][::-1]
    simulator = make_simulator("fake", obs_type="pixels_agent_pos")
    frames = [last_frames(simulator, s) for s in scenarios]
    write_scenarios(tmp_path / "set", scenarios, frames=frames)
    shutil.copytree(root / "trials", tmp_path / "trials")
    for name in NAMES:
        log = tmp_path / "trials" / name / "trials.jsonl"
        log.write_text("".join(log.read_text().splitlines(keepends=True)[::-1]))
    argv = ["validate", str(tmp_path / "set"), "--trials-folder", str(tmp_path / "trials"), *argv[4:]]
    argv += ["--out", str(tmp_path / "out")]
    journal = tmp_path / "out.replays" / "replays.jsonl"
    process = multiprocessing.get_context("fork").Process(target=main, args=(argv,))
    process.start()
    deadline = time.monotonic() + PATIENCE_S
    while process.is_alive() and (not journal.exists() or journal.read_bytes().count(b"\n") < 2):
        assert time.monotonic() < deadline
        time.sleep(0.002)
    process.kill()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert not (tmp_path / "out").exists()
    done = journal.read_bytes()[: journal.read_bytes().rfind(b"\n") + 1]
    assert main(argv) == 0
    assert journal.read_bytes().startswith(done)
    assert journal.read_bytes().count(b"\n") == 5, "nothing is replayed twice"
    expected = verdicts(root / "out")
    assert verdicts(tmp_path / "out") == {s.id: expected[s.id] for s in scenarios}


@pytest.mark.lerobot
def test_what_is_refused(validated, tmp_path, capsys):
    root, argv = validated

    def refused(*more, given=None) -> str:
        assert main([str(a) for a in [*(given or argv), *more]]) == 2
        return capsys.readouterr().err

    out = ("--out", tmp_path / "out")
    assert "not an empty folder" in refused("--out", root / "set")
    assert "no scenario of" in refused(*out, "--reject", "nobody", "--reason", "x")
    first = read_scenarios(root / "set")[0].id
    (tmp_path / "rejects.txt").write_text(first + "\n")
    assert "line 1" in refused(*out, "--rejects", tmp_path / "rejects.txt")
    assert "at least one run" in refused(*out, "--runs", "0")
    assert "holds no trials" in refused(*out, given=[*argv[:3], tmp_path, *argv[4:]])
    bare = write_scenarios(tmp_path / "bare", read_scenarios(root / "set")[:1])
    given = ["validate", bare, *argv[2:]]
    assert "no original frames" in refused(*out, given=given)
    other = write_scenarios(tmp_path / "other", [fake_scenario(30)])
    assert "holds no trial of the scenarios" in refused(*out, given=["validate", other, *argv[2:]])
    # Without frames only where that is said, and then it is on record.
    request = ValidationRequest(
        dataset=bare,
        trials_folder=root / "trials",
        out=tmp_path / "states",
        rule=ValidationRule(frames=False, runs=1),
    )
    assert validate_dataset(request).decisions[0].verdict == "kept"
    note = read_scenarios(tmp_path / "states")[0].provenance["validation"]
    assert "no-frames" in note["frames"]
    assert "mean_ssim" not in note
    # What was divided is not replaced.
    record_decisions(tmp_path / "states", [Decision(first, "split", "kept")])
    with pytest.raises(ScenarioError, match="then divided"):
        validate_dataset(request)
