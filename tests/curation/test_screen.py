"""Screening: who stays, what is written, and that order, shards, resume and kills change nothing."""

from __future__ import annotations

import json
import multiprocessing
import re
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.curation.funnel import Decision, count_stages, read_decisions, record_decisions
from lerobot_roborecover.curation.screen.runs import forget_trials, parse_policies, take_trials
from lerobot_roborecover.curation.screen.screening import ScreenRule, count_outcomes, provenance_of, screen
from lerobot_roborecover.curation.screen.tables import (
    format_histogram,
    format_policies,
    format_settled,
    histogram,
)
from lerobot_roborecover.datasets import read_scenarios, write_scenarios
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.frames import last_frames
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.scenario import ScenarioError
from tests.support.factories import fake_scenario
from tests.support.processes import PATIENCE_S
from tests.support.trial_rows import trial_row

NAMES = ("a", "b", "c", "d")


def rows_with(scenario, wins: dict[str, int], trials: int = 5, **changes) -> dict[str, list]:
    """Trials of every policy, the first `wins` of them successes."""
    values = {"scenario_sha256": scenario.sha256(), "platform": "fake", **changes}
    return {
        name: [trial_row(scenario.id, k, k < wins[name], policy=f"{name}@1", **values) for k in range(trials)]
        for name in NAMES
    }


def merged(*each: dict[str, list]) -> dict[str, list]:
    return {name: [row for rows in each for row in rows[name]] for name in NAMES}


def test_two_to_eighteen_of_twenty_stay():
    scenarios = [fake_scenario(i) for i in range(7)]
    wins = [
        dict.fromkeys(NAMES, 0),
        {"a": 1, "b": 0, "c": 0, "d": 0},
        {"a": 1, "b": 1, "c": 0, "d": 0},
        {"a": 5, "b": 5, "c": 5, "d": 3},
        {"a": 5, "b": 5, "c": 5, "d": 4},
        dict.fromkeys(NAMES, 5),
        dict.fromkeys(NAMES, 2),
    ]
    rows = merged(*(rows_with(s, w) for s, w in zip(scenarios, wins, strict=True)))
    rows["b"][-1] = replace(rows["b"][-1], outcome="sim_error", success=False)
    # What is from another start, of another scenario, of an intervention, or beyond the five does not count.
    rows["a"] += [trial_row(scenarios[0].id, k, True, scenario_sha256=scenarios[0].sha256(), **other)
                  for k in range(9) for other in ({"start": "initial"}, {"interventions": [1]})]  # fmt: skip
    rows["a"] += [trial_row(scenarios[0].id, 5, True, scenario_sha256=scenarios[0].sha256())]
    rows["a"] += [trial_row(scenarios[0].id, 0, True, scenario_sha256="0" * 64)]
    found = screen(scenarios, rows, ScreenRule())
    assert [s.decision.reason for s in found] == [
        "too hard", "too hard", "", "", "too easy", "too easy", "invalid trials: sim_error",
    ]  # fmt: skip
    assert [s.decision.verdict for s in found].count("kept") == 2
    assert found[3].decision.detail == "18 of 20 successes (a 5/5, b 5/5, c 5/5, d 3/5); 2 to 18 stay"
    assert found[6].decision.detail.endswith("invalid: 1 sim_error")
    # An invalid trial that is allowed counts as a failure.
    lenient = screen(scenarios, rows, ScreenRule(max_invalid=1))
    assert (lenient[6].decision.reason, lenient[6].successes, lenient[6].trials) == ("", 8, 20)
    bars = histogram(found)
    assert (len(bars), sum(bars), bars[0], bars[18], bars[20]) == (21, 7, 1, 1, 1)
    drawn = format_histogram(found, ScreenRule()).splitlines()
    assert drawn[1].split() == ["0", "1", "#"]
    assert drawn[19].split() == ["18", "1", "|", "#"]
    table = format_policies(found)
    assert re.search(r"^a +54.3 \[.*\] +60.0 \[.*\] +35 +0$", table, re.M), table


@pytest.mark.parametrize(
    ("keep", "policies", "trials", "bounds"),
    [
        (("0.1", "0.9"), 4, 5, (2, 18)), (("0.1", "0.9"), 3, 5, (2, 13)), (("0.1", "0.9"), 2, 5, (1, 9)),
        (("0.1", "0.9"), 1, 10, (1, 9)), (("2", "18"), 4, 5, (2, 18)), (("0", "99"), 2, 2, (0, 4)),
        (("0.3", "0.7"), 10, 1, (3, 7)),
    ],
)  # fmt: skip
def test_bounds_scale_with_policies_and_trials(keep, policies, trials, bounds):
    assert ScreenRule(trials, keep).check(policies) == bounds


@pytest.mark.parametrize(
    ("keep", "words"),
    [
        (("2", "0.9"), "neither two counts"), (("9", "2"), "neither two counts"),
        (("0.5", "1.5"), "neither two counts"), (("-1", "2"), "neither"), (("x", "2"), "neither"),
        (("21", "30"), "no scenario can stay"), (("0.51", "0.54"), "no scenario can stay"),
        (("1/2", "3"), "whole numbers"),
    ],
)  # fmt: skip
def test_bounds_that_make_no_sense(keep, words):
    with pytest.raises(ScenarioError, match=words):
        ScreenRule(5, keep).check(4)


def test_a_missing_trial_is_an_error():
    scenario = fake_scenario(0)
    rows = rows_with(scenario, dict.fromkeys(NAMES, 1))
    del rows["c"][2]
    with pytest.raises(ScenarioError, match="4 of 5 trials by c"):
        screen([scenario], rows, ScreenRule())


@settings(max_examples=30, deadline=None)
@given(same=st.fixed_dictionaries({name: st.sampled_from([0, 5]) for name in "abc"}), noisy=st.integers(0, 5))
def test_one_trial_of_a_deterministic_policy_stands_for_all(same, noisy):
    scenario = fake_scenario(0)
    rows = rows_with(scenario, {**same, "d": noisy})
    (whole,) = screen([scenario], rows, ScreenRule())
    first = {name: [r for r in given if name == "d" or r.trial == 0] for name, given in rows.items()}
    (found,) = screen([scenario], first, ScreenRule(), deterministic="abc")
    kept = (found.successes, found.trials, found.decision.verdict, found.decision.reason)
    assert kept == (whole.successes, whole.trials, whole.decision.verdict, whole.decision.reason)
    assert found.counts["a"].trials == 1


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_curtailing_keeps_the_same_scenarios(data):
    """Whatever the trials' outcomes and order, as soon as a verdict is settled it is that of all trials."""
    scenario, rule = fake_scenario(0), ScreenRule(curtail=True)
    certain = data.draw(st.sets(st.sampled_from("abc")))
    wins = {n: data.draw(st.sampled_from([0, 5]) if n in certain else st.integers(0, 5)) for n in NAMES}
    rows = rows_with(scenario, wins)
    (whole,) = screen([scenario], rows, ScreenRule(), certain)
    order = data.draw(st.permutations([r for n in NAMES for r in rows[n][: 1 if n in certain else 5]]))
    seen, settled, soonest = {name: [] for name in NAMES}, False, 0
    for run, row in enumerate(order, start=1):
        (before,) = count_outcomes([scenario], seen, rule, certain)
        soonest = max(soonest, run - 1 + before.soonest) if not certain else soonest
        seen[row.policy[0]].append(row)
        (found,) = count_outcomes([scenario], seen, rule, certain)
        if found.settled:
            assert run >= 3
            assert run >= soonest
            assert screen([scenario], seen, rule, certain)[0].decision.reason == whole.decision.reason
            settled = True
        else:
            assert not settled, "a settled verdict stays settled"
            with pytest.raises(ScenarioError, match="run the command again"):
                screen([scenario], seen, rule, certain)
    assert found.complete
    assert provenance_of(found, 0) == provenance_of(whole, 0)


def test_where_a_curtailed_screening_stops():
    scenario, rule = fake_scenario(0), ScreenRule(curtail=True)
    rows = {name: [] for name in NAMES}
    (none,) = count_outcomes([scenario], rows, rule, "abc")
    assert (none.settled, none.soonest) == (False, 4)
    # One success and one failure of those that count five times each settle it, once there are three.
    mixed = rows_with(scenario, {"a": 5, "b": 0, "c": 0, "d": 0}, trials=1) | {"d": []}
    (found,) = screen([scenario], mixed, rule, "abc")
    assert (found.settled, found.soonest, found.complete) == (True, 0, False)
    assert (
        found.decision.detail
        == "5 of 15 successes (a 1/1 (x 5), b 0/1 (x 5), c 0/1 (x 5), d 0/0); 2 to 18 of 20 stay"
    )
    assert provenance_of(found, 0)["planned"] == 20
    # Three that never recover leave it to the fourth: two successes keep it, four failures drop it.
    never = rows_with(scenario, dict.fromkeys(NAMES, 0), trials=1) | {"d": []}
    (found,) = count_outcomes([scenario], never, rule, "abc")
    assert (found.settled, found.soonest) == (False, 2)
    lost = never | {"d": rows_with(scenario, dict.fromkeys(NAMES, 0), trials=4)["d"]}
    (found,) = screen([scenario], lost, rule, "abc")
    assert found.decision.reason == "too hard"
    both = [*screen([scenario], mixed, rule, "abc"), found]
    assert [line.split() for line in format_settled(both).splitlines()] == [
        ["trials", "stays", "too", "hard"], ["3", "1", "0"], ["7", "0", "1"],
    ]  # fmt: skip
    table = format_policies(both)
    assert re.search(r"^d +n/a \(curtailed\)", table, re.M), table


def test_a_policy_that_is_not_deterministic_is_found_out_where_it_has_more_trials():
    scenario = fake_scenario(0)
    rows = rows_with(scenario, {**dict.fromkeys(NAMES, 5), "c": 3})
    with pytest.raises(ScenarioError, match="c is said to be deterministic, but trials 0 and 3 of"):
        screen([scenario], rows, ScreenRule(), deterministic=["c"])


@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_order_does_not_matter(data):
    scenarios = [replace(fake_scenario(0), id=f"s{i}") for i in range(4)]
    wins = st.fixed_dictionaries({name: st.integers(0, 5) for name in NAMES})
    rows = merged(*(rows_with(s, data.draw(wins)) for s in scenarios))
    expected = {s.scenario.id: s for s in screen(scenarios, rows, ScreenRule())}
    shuffled = {n: data.draw(st.permutations(rows[n])) for n in data.draw(st.permutations(NAMES))}
    found = screen(data.draw(st.permutations(scenarios)), shuffled, ScreenRule())
    assert {s.scenario.id: s for s in found} == expected


def test_policies_as_they_are_written():
    specs, env = parse_policies(
        ["org/pi05", "fast=org/pi05", "b=/some/where"],
        ["fast:n_action_steps=5", "use_amp=false"],
        ["obs_type=state", "b:mosaic=true"],
        ['b:{"observation.image": "observation.images.top"}'],
    )
    assert [s.name for s in specs] == ["org--pi05", "fast", "b"]
    assert specs[1].options == ("use_amp=false", "n_action_steps=5")
    assert (specs[2].env, env) == (("mosaic=true",), ["obs_type=state"])
    assert specs[2].rename_map == {"observation.image": "observation.images.top"}
    for bad, words in (
        ({"options": ["nobody:x=1"]}, "no policy is named 'nobody'"),
        ({"env": ["obs_type"]}, "write KEY=VALUE"),
        ({"rename_maps": ["{"]}, "not JSON"),
    ):
        with pytest.raises(OptionError, match=words):
            parse_policies(["a=org/x"], **bad)


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
