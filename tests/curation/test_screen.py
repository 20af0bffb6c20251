"""Screening: who stays, what is written, and that order, shards, resume and kills change nothing."""

from __future__ import annotations

import json
import multiprocessing
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.curation.funnel import Decision, count_stages, read_decisions, record_decisions
from lerobot_roborecover.curation.screen.runs import forget_trials, take_trials
from lerobot_roborecover.datasets import read_scenarios, write_scenarios
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.frames import last_frames
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.platforms import make_simulator
from tests.support.factories import fake_scenario
from tests.support.processes import PATIENCE_S


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    from tests.support.push_checkpoints import push_checkpoints

    return push_checkpoints(tmp_path_factory.mktemp("policies"))


@pytest.fixture(scope="module")
def scenario_set(tmp_path_factory):
    """Eight scenarios with frames and history; the fourth cannot be rebuilt, one is past saving."""
    root = tmp_path_factory.mktemp("screen") / "set"
    made = [fake_scenario(i, horizon=45 if i != 6 else 2) for i in range(8)]
    moved = made[3].fingerprint.bodies | {"puck": made[2].fingerprint.bodies["eef"]}
    made[3] = replace(made[3], fingerprint=replace(made[3].fingerprint, bodies=moved))
    simulator = make_simulator("fake", obs_type="pixels_agent_pos")
    write_scenarios(root, made, license="MIT", frames=[last_frames(simulator, s) for s in made])
    record_decisions(root, [Decision(s.id, "annotate", "kept") for s in made])
    return root


def command(root, checkpoints, out, *more) -> list[str]:
    named = [x for p in checkpoints for x in ("--policy", str(p))]
    return ["screen", str(root), *named, "--out", str(out), "--trials", "2", "--slots", "1", *more]


def what_it_says(out: Path) -> tuple:
    """What must not depend on how the trials were run."""
    record = json.loads((out / "meta/roborecover/screening.json").read_text())
    decisions = {(d.candidate, d.verdict, d.reason, d.detail) for d in read_decisions(out)}
    return [(s.id, s.provenance) for s in read_scenarios(out)], decisions, record["scenarios_by_successes"]


@pytest.fixture(scope="module")
def screened(scenario_set, checkpoints, tmp_path_factory):
    from tests.support.push_checkpoints import load_push_host

    out = tmp_path_factory.mktemp("screened") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lerobot_roborecover.evaluation.loading.load_host", load_push_host)
        assert main(command(scenario_set, checkpoints, out)) == 0
    return out


@pytest.mark.lerobot
def test_written_with_provenance_and_history(screened, scenario_set, checkpoints):
    before, kept = read_scenarios(scenario_set), read_scenarios(screened)
    assert 1 <= len(kept) < 8
    ids = {s.id for s in kept}
    last = {d.candidate: d for d in read_decisions(screened) if d.stage == "screen"}
    assert {c for c, d in last.items() if d.verdict == "kept"} == ids
    assert last[before[3].id].reason == "invalid trials: state_mismatch"
    assert last[before[6].id].reason == "too hard"
    rows = count_stages(read_decisions(screened))
    assert [(r.stage, r.entered, r.kept) for r in rows] == [("annotate", 8, 8), ("screen", 8, len(kept))]
    for scenario in kept:
        note = scenario.provenance["screening"]
        assert note["keep"] == [1, 5]
        assert set(note["policies"]) == {p.name for p in checkpoints}
        assert 1 <= note["successes"] == sum(c["successes"] for c in note["policies"].values()) <= 5
        assert note["policies"]["still"]["policy"].startswith("still@")
        assert scenario.sha256() in {s.sha256() for s in before}
    assert set(FrameStore(screened)) == ids
    record = json.loads((screened / "meta/roborecover/screening.json").read_text())
    assert sum(record["scenarios_by_successes"]) == 8
    assert json.loads((screened / "meta/roborecover/manifest.json").read_text())["license"] == "MIT"
    trials = screened.with_name("out.trials")
    for number, policy in enumerate(checkpoints):
        rows = read_trial_log(trials / policy.name / "trials.jsonl")
        assert len(rows) == 16
        # A prefix is replayed once, for the first trial of the first policy.
        replayed = {(r.scenario_id, r.trial) for r in rows if r.handoff_from_snapshot is False}
        assert replayed - {(before[3].id, 0)} == (
            {(s.id, 0) for s in before if s is not before[3]} if number == 0 else set()
        )
        assert all((trials / policy.name / "actions" / f"{r.actions_sha256}.npy").exists()
                   for r in rows if r.steps)  # fmt: skip


@pytest.mark.lerobot
def test_shards_and_resume_change_nothing(screened, scenario_set, checkpoints, tmp_path, monkeypatch, capsys):
    from tests.support.push_checkpoints import load_push_host

    monkeypatch.setattr("lerobot_roborecover.evaluation.loading.load_host", load_push_host)
    parts = []
    for k in range(2):
        part = tmp_path / f"part-{k}"
        more = ("--shard", f"{k}/2", "--trials-folder", str(part))
        assert main(command(scenario_set, checkpoints, tmp_path / "never", *more)) == 0
        parts += ["--trials-from", str(part)]
    assert not (tmp_path / "never").exists()
    # The other order of policies, and half of one machine's work lost.
    log = tmp_path / "part-1" / "calm" / "trials.jsonl"
    log.write_text("".join(log.read_text().splitlines(keepends=True)[:3]) + '{"cut')
    loads = []
    monkeypatch.setattr(
        "lerobot_roborecover.evaluation.loading.load_host", lambda c: loads.append(c) or load_push_host(c)
    )
    assert main(command(scenario_set, checkpoints[::-1], tmp_path / "out", *parts)) == 0
    assert len(loads) == 1, "only the policy whose trials were lost runs again"
    assert what_it_says(tmp_path / "out") == what_it_says(screened)
    assert "0.0" in capsys.readouterr().out
    assert take_trials(tmp_path / "part-0" / "calm", tmp_path / "out.trials" / "calm") == 0


@pytest.mark.lerobot
def test_an_unscreened_sample_stays_whatever_its_trials_say(
    screened, scenario_set, checkpoints, tmp_path, capsys
):
    out, trials = tmp_path / "out", str(screened.with_name("out.trials"))
    more = ("--unscreened", "5", "--trials-folder", trials)
    assert main(command(scenario_set, checkpoints, out, *more)) == 0
    assert "beside them 5 scenarios drawn at random, unscreened" in capsys.readouterr().out
    record = json.loads((out / "meta/roborecover/screening.json").read_text())
    sample = {s.id for s in read_scenarios(out) if s.split == "unscreened"}
    assert sorted(sample) == record["unscreened"]
    assert len(sample) == 5
    kept = {s.id for s in read_scenarios(screened)}
    assert sample - kept, "some that screening would drop"
    assert {s.id for s in read_scenarios(out)} == kept | sample
    last = {d.candidate: d for d in read_decisions(out) if d.stage == "screen"}
    assert {last[i].by for i in sample} == {"drawn at random before screening"}
    assert {last[i].verdict for i in sample} == {"kept"}


@pytest.mark.lerobot
def test_trials_are_run_again_and_compared(
    screened, scenario_set, checkpoints, tmp_path, monkeypatch, capsys
):
    from tests.support.push_checkpoints import load_push_host

    monkeypatch.setattr("lerobot_roborecover.evaluation.loading.load_host", load_push_host)
    trials = shutil.copytree(screened.with_name("out.trials"), tmp_path / "trials")
    more = ("--repeat", "0.3", "--trials-folder", str(trials))
    assert main(command(scenario_set, checkpoints, tmp_path / "out", *more)) == 0
    assert "trials of 3 scenarios run again: each with the same actions" in capsys.readouterr().out
    record = json.loads((tmp_path / "out/meta/roborecover/screening.json").read_text())["repeated"]
    assert record == {"trials": 3 * 2 * len(checkpoints), "scenarios": 3, "discordant": []}
    for policy in checkpoints:
        again = read_trial_log(tmp_path / "trials.again" / policy.name / "trials.jsonl")
        assert len(again) == 6
        replayed = {r.scenario_id for r in again if not r.handoff_from_snapshot}
        assert len(replayed) == 3, "every policy replays the prefixes"


@pytest.mark.nightly
@pytest.mark.lerobot
def test_curtailed(screened, scenario_set, checkpoints, tmp_path, monkeypatch, capsys):
    from tests.support.push_checkpoints import load_push_host

    monkeypatch.setattr("lerobot_roborecover.evaluation.loading.load_host", load_push_host)
    assert main(command(scenario_set, checkpoints, tmp_path / "out", "--curtail")) == 0
    assert "stays" in capsys.readouterr().out
    ids = {s.id for s in read_scenarios(screened)}
    assert {s.id for s in read_scenarios(tmp_path / "out")} == ids

    def run(folder: Path) -> int:
        return sum(len(read_trial_log(folder / p.name / "trials.jsonl")) for p in checkpoints)

    all_trials = run(screened.with_name("out.trials"))
    assert 3 * 8 <= run(tmp_path / "out.trials") < all_trials
    # Shards, the other order of policies, and trials that are there already keep the same ones.
    parts = []
    for k in range(2):
        part = tmp_path / f"part-{k}"
        more = ("--curtail", "--shard", f"{k}/2", "--trials-folder", str(part))
        assert main(command(scenario_set, checkpoints[::-1], tmp_path / "never", *more)) == 0
        parts += ["--trials-from", str(part)]
    assert main(command(scenario_set, checkpoints, tmp_path / "joined", "--curtail", *parts)) == 0
    assert {s.id for s in read_scenarios(tmp_path / "joined")} == ids


@pytest.mark.nightly
@pytest.mark.lerobot
def test_kills_lose_nothing(screened, scenario_set, checkpoints, tmp_path, monkeypatch):
    from tests.support.push_checkpoints import load_push_host

    monkeypatch.setattr("lerobot_roborecover.evaluation.loading.load_host", load_push_host)
    argv = command(scenario_set, checkpoints, tmp_path / "out")
    logs = [tmp_path / "out.trials" / p.name / "trials.jsonl" for p in checkpoints]
    complete = {}
    for want in (3, 20):
        # Forked: LeRobot is imported already.
        process = multiprocessing.get_context("fork").Process(target=main, args=(argv,))
        process.start()
        deadline = time.monotonic() + PATIENCE_S
        while process.is_alive() and sum(map(_lines, logs)) < want:
            assert time.monotonic() < deadline
            time.sleep(0.002)
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL, "it was to be killed before its end"
        assert not (tmp_path / "out").exists()
        for log, before in complete.items():
            assert log.read_bytes().startswith(before), "a finished trial was lost or rewritten"
        complete = {
            log: log.read_bytes()[: log.read_bytes().rfind(b"\n") + 1] for log in logs if log.exists()
        }
    assert len(complete) >= 2, "the second kill came after the first policy's end"
    assert main(argv) == 0
    for log, before in complete.items():
        assert log.read_bytes().startswith(before)
    assert what_it_says(tmp_path / "out") == what_it_says(screened)


def _lines(log: Path) -> int:
    return log.read_bytes().count(b"\n") if log.exists() else 0


@pytest.mark.lerobot
def test_what_is_refused(screened, scenario_set, checkpoints, tmp_path, capsys, monkeypatch):
    def refused(*argv) -> str:
        assert main([str(a) for a in argv]) == 2
        return capsys.readouterr().err

    out = tmp_path / "out"
    assert "not an empty folder" in refused(*command(scenario_set, checkpoints, screened))
    assert "no policy" in refused("screen", scenario_set, "--out", out)
    assert "the same checkpoint" in refused(*command(scenario_set, [checkpoints[0]] * 2, out)).replace(
        "have the name", "the same checkpoint"
    )
    twice = ["x=" + str(checkpoints[0]), "y=" + str(checkpoints[0])]
    assert "same checkpoint and options" in refused(*command(scenario_set, twice, out))
    assert "use --shard" in refused(*command(scenario_set, checkpoints, out, "--env", "shard=0/2"))
    assert "--shard=2/2: must be k/n" in refused(*command(scenario_set, checkpoints, out, "--shard", "2/2"))
    assert "from 0 to 1" in refused(*command(scenario_set, checkpoints, out, "--repeat", "5"))
    assert "settles this itself" in refused(
        *command(scenario_set, checkpoints, out, "--env", "start=initial")
    )
    assert "no scenario can stay" in refused(*command(scenario_set, checkpoints, out, "--keep", "9", "20"))
    trials = shutil.copytree(screened.with_name("out.trials"), tmp_path / "trials")
    argv = command(scenario_set, checkpoints, out, "--trials-folder", trials)
    assert "holds trials with options" in refused(*argv, "--policy-option", "still:n_action_steps=1")
    assert "never run again" in refused(*argv, "--retry", "horizon")
    # Too strict: nothing is written, the trials stay, and the message is the funnel.
    message = refused(*argv, "--keep", "6", "6")
    assert "no scenario stays" in message
    assert "too hard" in message
    assert not out.exists()
    # Invalid trials run again when asked to, and the old rows are kept aside.
    assert forget_trials(trials / "still", ["state_mismatch"]) == 2
    assert len(read_trial_log(trials / "still" / "trials.jsonl")) == 14
    assert len(read_trial_log(trials / "still" / "retried.jsonl")) == 2
    (trials / "still" / "actions").rename(trials / "still" / "elsewhere")
    assert "keep" in refused(*argv)
