"""Evidence that may be looked at at any time: the test's size and its interval, the order, the run that
stops, and what a report makes of its log."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.compare import compare, to_screen
from lerobot_roborecover.analysis.leaderboard import make_leaderboard
from lerobot_roborecover.analysis.logs import Study, read_study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.sequential_pairs import watched_pair
from lerobot_roborecover.analysis.sequential_plan import SequentialPlan
from lerobot_roborecover.analysis.stats.arms import Arm
from lerobot_roborecover.analysis.stats.panel import make_panel
from lerobot_roborecover.analysis.stats.sequential import sequence
from lerobot_roborecover.analysis.stats.verdicts import LEAST_DIFFERING, ComparisonVerdict
from lerobot_roborecover.cli.main import main
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.launch import EngineConfig, run_work_items
from lerobot_roborecover.evaluation.options import RecoveryOptions
from lerobot_roborecover.evaluation.sequential import ALONE, open_watch
from lerobot_roborecover.evaluation.session import SimulatorSpec, create_session
from lerobot_roborecover.evaluation.work_items import OrderedQueue, units_of
from lerobot_roborecover.logs.sequential_record import read_record, record_path
from lerobot_roborecover.logs.trial_log import TrialLogError, read_trial_log
from lerobot_roborecover.policies.metadata import PolicyMetadata
from lerobot_roborecover.scenario import Start
from lerobot_roborecover.workers.messages import SlotConfig
from tests.evaluation.test_local_engine import PushHost
from tests.support.factories import fake_dataset
from tests.support.trial_rows import policy_rows, write_log

TRIALS, COUNT = 2, 12


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", COUNT)


class LazyHost(PushHost):
    """Never moves: solves nothing."""

    def act(self, observations, instructions, histories):
        return [0 * chunk for chunk in super().act(observations, instructions, histories)]


def evaluate(dataset, log, policy, host, against=""):
    """A run as `roborecover eval` makes it, without LeRobot."""
    scenarios, run = create_session(
        RecoveryOptions(scenarios=str(dataset), trial_log=str(log)),
        SimulatorSpec(SlotConfig("fake"), {}, None), workers=True,
        facts=PolicyMetadata(policy=policy, n_episodes=TRIALS),
    )  # fmt: skip
    run.pool.acquire()
    try:
        watch = open_watch(against, scenarios, run.protocol, TRIALS, log=run.log.path, shard="0/1")
        units = units_of(list(scenarios) if watch is None else watch.order, TRIALS)
        options = {"queue_of": OrderedQueue, "on_row": lambda r: watch.add([asdict(r)])} if watch else {}
        if watch is not None:
            watch.add([asdict(r) for r in run.log.rows])
        stop = (lambda: watch.decided) if watch else (lambda: False)
        # One slot: of several, one that starts late would let the others run ahead.
        run_work_items(run, units, lambda: host, EngineConfig(slots=1), stop=stop, **options)
        if watch is not None:
            watch.record(run.log.path)
    finally:
        run.pool.release()
    return watch, read_trial_log(log)


@pytest.fixture(scope="module")
def stopped(dataset, tmp_path_factory):
    """A policy that solves everything, a log of one that solves nothing, and a run of the former against
    it."""
    root = tmp_path_factory.mktemp("runs")
    _, rows = evaluate(dataset, root / "lazy" / "trials.jsonl", "lazy@1", LazyHost())
    assert not any(r.success for r in rows)
    watch, rows = evaluate(dataset, root / "push" / "trials.jsonl", "push@1", PushHost(), str(root / "lazy"))
    return root, watch, rows


@pytest.mark.slow
def test_a_run_stops_when_its_comparison_is_decided(stopped):
    root, watch, rows = stopped
    assert watch.decided
    assert len(rows) < COUNT * TRIALS
    assert f"of {COUNT} scenarios: better than lazy@1" in watch.words
    record = read_record(root / "push" / "trials.jsonl")
    assert (record.decided, record.policy, record.against) == (True, "push@1", "lazy@1")
    assert record.after_scenarios < len(record.scenarios) == COUNT
    assert record.p < 0.05
    first = list(dict.fromkeys(r.scenario_id for r in rows))
    assert set(record.scenarios[: record.after_scenarios]) <= set(first)
    assert set(first) <= set(record.scenarios[: record.after_scenarios + 2]), "slots run ahead by little"


@pytest.mark.slow
def test_a_rerun_of_a_decided_comparison_runs_nothing(stopped, dataset):
    root, _, rows = stopped
    watch, again = evaluate(dataset, root / "push" / "trials.jsonl", "push@1", PushHost(), str(root / "lazy"))
    assert watch.decided
    assert again == rows


@pytest.mark.slow
def test_the_line_shows_what_holds_at_any_time(stopped, dataset, tmp_path):
    watch, rows = evaluate(dataset, tmp_path / "trials.jsonl", "push@1", PushHost(), ALONE)
    assert len(rows) == COUNT * TRIALS
    assert watch.note == f"on {COUNT} of {COUNT} scenarios"
    assert watch.interval[0] < watch.rate
    assert not record_path(tmp_path / "trials.jsonl").exists()
    assert "difference +" in stopped[1].note


def test_a_scenario_counts_when_its_turn_has_come(dataset):
    """Whatever ends early would otherwise count first, and successes end early."""
    scenarios, run = create_session(
        RecoveryOptions(scenarios=str(dataset), trial_log=str(dataset.parent / "turn.jsonl")),
        SimulatorSpec(SlotConfig("fake"), {}, None), workers=True,
        facts=PolicyMetadata(policy="a", n_episodes=1),
    )  # fmt: skip
    watch = open_watch(ALONE, scenarios, run.protocol, 1, log=run.log.path, shard="")
    run.log.close()

    def row(scenario):
        found = {"scenario_id": scenario.id, "trial": 0, "start": "recovery"}
        return {**found, "success": True, "outcome": "success"}

    watch.add([row(s) for s in watch.order[1:5]])
    assert watch.rate is None
    watch.add([row(watch.order[0])])
    assert watch.note == f"on 5 of {COUNT} scenarios"


def test_what_cannot_be_compared_is_refused(stopped, dataset, tmp_path):
    root, _, _ = stopped
    with pytest.raises(OptionError, match=r"lacks \d+ of the run's 12 scenarios"):
        evaluate(dataset, tmp_path / "a.jsonl", "b@1", LazyHost(), str(root / "push"))
    with pytest.raises(TrialLogError, match="cannot read trial log"):
        evaluate(dataset, tmp_path / "b.jsonl", "b@1", LazyHost(), str(tmp_path / "none.jsonl"))
    log = root / "lazy" / "trials.jsonl"
    with pytest.raises(OptionError, match="the run's own log"):
        evaluate(dataset, log, "lazy@1", LazyHost(), str(log))
    rows = [r for p in ("a", "b") for r in policy_rows(p, 3, 1, 0.5, 0)]
    with pytest.raises(OptionError, match="2 settings from recovery starts"):
        evaluate(dataset, tmp_path / "c.jsonl", "b@1", LazyHost(), str(write_log(tmp_path / "two", rows)))


@pytest.mark.slow
def test_a_report_knows_a_run_that_stopped(stopped, dataset, tmp_path):
    root, _, _ = stopped
    evaluate(dataset, tmp_path / "third" / "trials.jsonl", "third@1", PushHost())
    logs = [str(root / "push"), str(root / "lazy"), str(tmp_path / "third")]
    for options in (Options(), Options(common=True), Options(scheduled=TRIALS)):
        results = analyse(read_study(logs), options)
        assert results.left_out == ("push@1",)
        own = results.contrast("push@1", "lazy@1")
        assert (own.verdict, own.sequential) == (ComparisonVerdict.A_BETTER, True)
        assert own.scenarios == read_record(root / "push" / "trials.jsonl").after_scenarios
        assert own.family == 2
        assert own.p <= own.p_holm
        assert results.contrast("push@1", "third@1").verdict is ComparisonVerdict.INCOMPLETE
        p = results.recovery.arm("push@1")
        assert (results.recovery.trials[p] > 0).sum() < COUNT, "what was not reached is no failure"
        assert any("its run was watched, and decided after" in r for r in results.remarks)
    pair = compare(read_study(logs[:2]))
    assert pair.verdict == f"push@1 is better, by {100 * pair.contrast.difference.value:.1f} points."
    assert "holds at every look (sequential)" in to_screen(pair)
    assert analyse(read_study(logs[:1])).ranked.arms == ("push@1",)
    folder = tmp_path / "board"
    for log in logs:
        shutil.copytree(log, folder / Path(log).name)
    (board,) = make_leaderboard(folder).boards
    entry = next(e for e in board.entries if e.policy == "push@1")
    assert (entry.stopped, entry.place) == (True, None)


def growing(policy, count, rate, seed, trials=2, **changes):
    return policy_rows(policy, count, trials, rate, seed, run_scenarios=count, run_trials=trials, **changes)


def test_compare_sequential_counts_scenarios_in_their_turn(tmp_path, capsys):
    rows = {p: growing(p, 30, rate, 0) for p, rate in (("a", 0.95), ("b", 0.05))}
    names = sequence(f"scenario:{r.scenario_id}" for r in rows["a"])
    order = [name.removeprefix("scenario:") for name in names]
    first = [r for r in rows["a"] if r.scenario_id in order[:12]]
    later = [r for r in rows["a"] if r.scenario_id in order[15:20]]
    logs = [str(write_log(tmp_path / "a.jsonl", first + later))]
    logs.append(str(write_log(tmp_path / "b.jsonl", rows["b"])))
    found = compare(read_study(logs), options=Options(sequential=True)).contrast
    assert found.sequential
    assert found.scenarios <= 12
    assert found.verdict is ComparisonVerdict.A_BETTER
    assert main(["compare", *logs, "--sequential"]) == 0
    write_log(tmp_path / "a.jsonl", later)
    assert main(["compare", *logs, "--sequential"]) == 2
    assert "no scenario's turn has come" in capsys.readouterr().err


LOOKS, PLANNED = 10, 40


def first_looks(rows):
    """Ten looks at two logs that grow in the order of the set: rows of both so far."""
    for look in range(1, LOOKS + 1):
        there = {f"s{n:03d}" for n in range(look * PLANNED // LOOKS)}
        yield [[r for r in own if r.scenario_id in there] for own in rows]


@pytest.mark.nightly
def test_ten_looks_at_two_growing_logs_err_within_the_level():
    """A plan made of the scenarios that were there erred in 19 % [13, 27] of such comparisons."""
    planned = {f"s{n:03d}": f"scenario:s{n:03d}" for n in range(PLANNED)}
    options, count = Options(draws=100, sequential=True, planned=planned), 60
    wrong = unplanned = 0
    for seed in range(count):
        rng = np.random.default_rng(seed)
        rows = [growing(p, PLANNED, 0.5, rng.integers(2**31), trials=1) for p in "ab"]
        found, grown = [], []
        for now in first_looks(rows):
            arms = tuple(Arm(r[0].policy, Start.RECOVERY, (0,), tuple(r)) for r in now)
            found.append(analyse(Study("libero", arms, (), ()), options).contrast("a", "b"))
            panel = make_panel(arms)
            there = dict(zip([s.id for s in panel.scenarios], panel.units().tolist(), strict=True))
            grown.append(watched_pair(panel, (0, 1), 0.95, SequentialPlan(there, (1, 1))))
        wrong += any(c.verdict.separated for c in found)
        unplanned += any(c.p < 0.05 and c.differing >= LEAST_DIFFERING for c in grown)
    bound = 0.05 + 2 * math.sqrt(0.05 * 0.95 / count)
    assert wrong / count <= bound < unplanned / count


def test_looks_without_the_planned_set_are_refused(tmp_path, capsys):
    rows = {p: growing(p, 30, 0.5, n) for n, p in enumerate("ab")}
    part = {p: [r for r in own if int(r.scenario_id[1:]) < 20] for p, own in rows.items()}
    old = {p: [replace(r, run_scenarios=None, run_trials=None) for r in own] for p, own in rows.items()}

    def refused(groups, *options):
        logs = [str(write_log(tmp_path / f"{p}.jsonl", own)) for p, own in groups.items()]
        assert main(["compare", *logs, "--sequential", *options]) == 2
        return capsys.readouterr().err

    told = refused(part)
    assert (
        "the runs were to evaluate 30, and the logs name 20 so far. Name the set: --scenarios made-up" in told
    )
    assert "the logs, of an earlier version, do not say how many" in refused(old)
    no_trials = {p: [replace(r, run_trials=None) for r in own] for p, own in rows.items()}
    assert "the rows of b do not say them. Say them: --trials K" in refused({**rows, "b": no_trials["b"]})
    two_plans = {**rows, "b": [replace(r, run_scenarios=25) for r in rows["b"]]}
    assert "the runs were to evaluate 25 and 30 scenarios" in refused(two_plans)
    more = {**rows, "a": [*rows["a"], replace(rows["a"][0], trial=2)]}
    assert "a has 3 trials of s000, and 2 were planned" in refused(more)
    assert not record_path(tmp_path / "a.jsonl").exists(), "no look has been taken"


def test_the_plan_of_the_first_look_holds_for_the_next(tmp_path, capsys):
    """The set is named at the first look; the next one takes it from the record, and no other."""
    folder = fake_dataset(tmp_path / "set", 12)
    chosen = load_scenarios(str(folder))
    rows = {
        p: [
            replace(
                r, scenario_id=s.id, scenario_sha256=s.sha256(), platform="fake", cluster="",
                split=s.labels.split, run_scenarios=12, run_trials=2,
            )
            for n, s in enumerate(chosen)
            for r in policy_rows(p, 1, 2, rate, n)
        ]
        for p, rate in (("a", 0.9), ("b", 0.1))
    }  # fmt: skip
    half = {p: own[:12] for p, own in rows.items()}
    logs = [str(write_log(tmp_path / f"{p}.jsonl", own)) for p, own in half.items()]
    assert main(["compare", *logs, "--sequential"]) == 2
    assert "logs name 6 so far" in capsys.readouterr().err
    assert main(["compare", *logs, "--sequential", "--scenarios", str(folder)]) in (0, 2)
    record = read_record(tmp_path / "a.jsonl")
    assert set(record.scenarios) == set(chosen.ids)
    assert (record.trials, record.against_trials) == (2, 2)
    for p, own in rows.items():
        write_log(tmp_path / f"{p}.jsonl", own)
    assert main(["compare", *logs, "--sequential"]) == 0
    later = read_record(tmp_path / "a.jsonl")
    assert later.scenarios == record.scenarios
    assert later.after_scenarios > record.after_scenarios
    assert analyse(read_study(logs)).contrast("a", "b").sequential, "a report knows that it was looked at"
    capsys.readouterr()
    other = fake_dataset(tmp_path / "other", 14)
    assert main(["compare", *logs, "--sequential", "--scenarios", str(other)]) == 2
    assert "plan is fixed at the first look" in capsys.readouterr().err


def test_a_run_keeps_the_plan_that_it_began_with(stopped, dataset, tmp_path):
    """The same log with more scenarios or trials would be another plan, and its looks would add up."""
    root, _, _ = stopped
    shutil.copytree(root / "push", tmp_path / "push")
    log = tmp_path / "push" / "trials.jsonl"
    record = json.loads(record_path(log).read_text())
    record_path(log).write_text(json.dumps({**record, "scenarios": record["scenarios"][:5], "units": []}))
    with pytest.raises(OptionError, match="on 5 scenarios with 2 trials each, and not on 12 with 2"):
        evaluate(dataset, log, "push@1", PushHost(), str(root / "lazy"))
    record_path(log).write_text(json.dumps({**record, "against_outcomes": "0" * 64}))
    with pytest.raises(OptionError, match="whose outcomes have changed since"):
        evaluate(dataset, log, "push@1", PushHost(), str(root / "lazy"))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("level", 7),
        ("scenarios", ["a", "a"]),
        ("scenarios", [1]),
        ("trials", True),
        ("p", "x"),
        ("schema", 9),
    ],
)
def test_a_damaged_record_is_refused_in_one_line(stopped, tmp_path, field, value):
    text = json.loads(record_path(stopped[0] / "push" / "trials.jsonl").read_text())
    record_path(tmp_path / "t.jsonl").write_text(json.dumps({**text, field: value}))
    with pytest.raises(TrialLogError, match=rf"t.sequential.json: field '{field}'.*bring back"):
        read_record(tmp_path / "t.jsonl")
    record_path(tmp_path / "t.jsonl").write_text("[" * 100_000)
    with pytest.raises(TrialLogError, match="bring back"):
        read_record(tmp_path / "t.jsonl")
