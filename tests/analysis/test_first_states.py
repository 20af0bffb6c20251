"""Scenarios that branch off from one first state have one initial-state trial: it counts once, everywhere."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.compare import compare
from lerobot_roborecover.analysis.gain_tables import inversions
from lerobot_roborecover.analysis.leaderboard import make_leaderboard
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.policy_tables import initial_estimates, overall
from lerobot_roborecover.analysis.stats.detection import ScoredTrial, detection_report
from lerobot_roborecover.analysis.stats.gains import gains_by_group, groups_by_controller
from lerobot_roborecover.analysis.stats.ranking import pairs_from_both_starts
from lerobot_roborecover.analysis.stats.soundness import barred_arms
from lerobot_roborecover.analysis.stats.units import ResamplingUnit
from lerobot_roborecover.analysis.summary import format_table, summarise
from lerobot_roborecover.cli.main import main
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.evaluation.progress import RunProgress
from lerobot_roborecover.scenario import Start
from tests.support.trial_rows import trial_row, write_log

STATES = 40
QUICK = Options(draws=200)


def outcomes(rate: float, seed: int, count: int = STATES) -> list[bool]:
    return (np.random.default_rng(seed).random(count) < rate).tolist()


def rows_of(policy: str, initial: float, recovery: float, seed: int, copies: int) -> list:
    """A deterministic policy on scenarios, every fourth first state being that of several."""
    rows = []
    for state, success in enumerate(outcomes(initial, seed)):
        for copy in range(copies if state % 4 == 0 else 1):
            common = {
                "policy": policy,
                "first_state": f"{state:064x}",
                "task": f"task-{state % 5}",
                "suite": "one",
            }
            name = 100 * copy + state
            rows.append(trial_row(name, success=success, start="initial", **common))
            solved = outcomes(recovery, 1000 * seed + copy)[state]
            rows.append(trial_row(name, success=solved, **common))
    return rows


def study_of(folder, copies: int):
    logs = [
        write_log(folder / f"{name}.jsonl", rows_of(name, initial, recovery, seed, copies))
        for seed, (name, initial, recovery) in enumerate([("a", 0.9, 0.2), ("b", 0.4, 0.7)], start=1)
    ]
    return read_study([str(log) for log in logs])


def test_more_scenarios_of_a_first_state_say_nothing_more_from_initial_states(tmp_path):
    one, many = (analyse(study_of(tmp_path / str(n), n), QUICK) for n in (1, 6))
    assert len(many.recovery.scenarios) == 2.25 * len(one.recovery.scenarios)
    assert initial_estimates(one) == initial_estimates(many)
    assert (many.initial.successes <= many.initial.trials).all()
    (c,), (d,) = one.initial_contrasts, many.initial_contrasts
    assert (c.difference, c.p, c.units, c.differing) == (d.difference, d.p, d.units, d.differing)
    assert (d.units, d.unit) == (STATES, "first states")
    assert compare(many.study, options=QUICK).initial.p == c.p
    for pair in zip(*(pairs_from_both_starts(*r.both_starts) for r in (one, many)), strict=True):
        assert pair[0].initial.p_holm == pair[1].initial.p_holm


def test_every_table_has_the_initial_rate_of_first_states(tmp_path):
    study = study_of(tmp_path, 6)
    results = analyse(study, QUICK)
    rate = initial_estimates(results)[results.recovery.arms.index("a")]
    rows = [asdict(r) for arm in study.arms for r in arm.rows if arm.policy == "a"]
    mean = np.mean(outcomes(0.9, 1))
    assert rate.value == pytest.approx(mean)
    assert summarise(rows).starts[Start.INITIAL].rsr == rate
    assert "90 scenarios branch off from 40 first states" in format_table(summarise(rows))
    (board,) = make_leaderboard(tmp_path).boards
    assert {e.policy: e.initial for e in board.entries}["a"] == rate
    counts = RunProgress("initial", {r["scenario_id"] for r in rows}, 1)
    counts.add(rows)
    assert (counts.rate, counts.interval) == (rate.value, (rate.low, rate.high))
    shown = {c.title: v for c, v in zip(overall(results).columns, overall(results).rows[0], strict=True)}
    assert shown["Initial state %"] == initial_estimates(results)[0]
    assert "40 first states" in overall(results).notes[0]


def test_retention_is_over_the_same_scenarios_and_its_units_are_first_states(tmp_path):
    results = analyse(study_of(tmp_path, 6), QUICK)
    policy = results.recovery.arms.index("a")
    both = results.recovery.rates[policy].mean() / results.initial_rates[policy].mean()
    assert results.retention[policy].value == pytest.approx(both)
    narrow = results.draws.ratios(results.recovery.rates.T, results.initial_rates.T)[policy]
    assert results.retention[policy].high - results.retention[policy].low > narrow.high - narrow.low


def test_tasks_hold_first_states(tmp_path):
    results = analyse(study_of(tmp_path, 6), Options(draws=200, cluster=ResamplingUnit.TASK))
    (c,) = results.initial_contrasts
    assert (c.units, c.unit) == (5, "tasks")


@pytest.mark.slow
def test_an_old_log_has_its_first_states_from_the_shipped_set(tmp_path):
    scenarios = list(load_scenarios("metaworld_study", split="test"))
    rows = [
        trial_row(s.id, start=start, scenario_sha256=s.sha256(), platform="metaworld", dataset="of before")
        for s in scenarios
        for start in ("initial", "recovery")
    ]
    study = read_study([str(write_old_log(tmp_path / "old.jsonl", rows))])
    assert len(analyse(study, QUICK).initial.scenarios) == 57
    assert not [remark for remark in study.remarks if "first state" in remark]


@pytest.mark.slow
def test_an_old_log_of_an_unknown_set_says_so(tmp_path):
    rows = [trial_row(n, start=start) for n in range(12) for start in ("initial", "recovery")]
    study = read_study([str(write_old_log(tmp_path / "old.jsonl", rows))])
    assert len(analyse(study, QUICK).initial.scenarios) == 12
    (remark,) = (r for r in study.remarks if "first state" in r)
    assert "12 scenarios" in remark
    new = write_log(tmp_path / "new.jsonl", [replace(r, policy="b", first_state="a" * 64) for r in rows])
    both = read_study([str(tmp_path / "old.jsonl"), str(new)])
    assert len(analyse(both, QUICK).initial.scenarios) == 1, "the other log says the first states"


def write_old_log(path, rows):
    """A log of schema 2, which did not say first states."""
    since = ("first_state", "policy_settings", "run_scenarios", "run_trials", "shard")
    old = [{k: v for k, v in asdict(r).items() if k not in since} | {"schema": 2} for r in rows]
    path.write_text("".join(json.dumps(row) + "\n" for row in old))
    return path


def test_inversions_say_what_is_shown_and_over_what(tmp_path):
    results = analyse(study_of(tmp_path, 2), QUICK)
    (row,) = inversions(results).rows
    shown = dict(zip([c.title for c in inversions(results).columns], row, strict=True))
    assert (shown["A, ahead initially"], shown["B, ahead at recovery"]) == ("a", "b")
    assert shown["Shown"] == "yes"
    assert shown["Shown, tasks like these"] == "no", "five tasks cannot show it"


def test_gains_name_the_group_that_carries_them(tmp_path):
    """All of the gain is on one driver's scenarios."""
    rows = []
    for n in range(60):
        common = {"source_policy": "expert" if n < 30 else "other", "source": "perturbed"}
        rows.append(trial_row(n, success=n % 2 == 0, policy="base", **common))
        solved = True if n < 30 else n % 2 == 0
        acted = [{"kind": "rollback", "step": 0}]
        rows.append(trial_row(n, success=solved, policy="helped", interventions=acted, **common))
    study = read_study([str(write_log(tmp_path / "log.jsonl", rows))])
    results = analyse(study, replace(QUICK, baseline="base"))
    panel = results.interventions
    groups, draws = groups_by_controller(panel), results.resample(panel)
    found = gains_by_group(panel, results.intervention_pairs, groups, draws)
    on = {gain.group: gain for gain in found}
    assert on["perturbed, expert"].inside.difference.value == 0.5
    assert on["perturbed, expert"].outside.difference.value == 0.0
    assert on["perturbed, expert"].outside.p_holm == 1.0
    assert on["perturbed, other"].outside.difference.value == 0.5


def test_clean_rollouts_of_one_first_state_make_one_threshold():
    """A conformal threshold counts a first state once, and puts all of it into one half."""

    def trials(copies: int) -> list[ScoredTrial]:
        scores = np.random.default_rng(0).random(60)
        return [
            ScoredTrial(f"s{n}-{c}", f"state{n}", "initial", 0, True, 20.0, 0, scores[[n]], np.zeros(1, bool))
            for n in range(60)
            for c in range(copies if n % 3 == 0 else 1)
        ]

    one, many = (detection_report(trials(n), alpha=0.1, probabilities=False, decides=False) for n in (1, 5))
    assert (one.threshold, one.conformal.threshold) == (many.threshold, many.conformal.threshold)
    assert one.conformal.clean == many.conformal.clean == 60
    assert one.conformal.clean_alarmed.value == pytest.approx(many.conformal.clean_alarmed.value)
    assert one.conformal.alarms_per_minute.value == pytest.approx(many.conformal.alarms_per_minute.value)


def test_a_plan_says_how_many_first_states_a_set_has(capsys):
    assert main(["plan", "--rate", "50", "--scenarios", "metaworld_study", "--split", "test"]) == 0
    assert "57 first states" in capsys.readouterr().err


def test_scenarios_that_share_a_hard_first_state_are_no_trials_until_success(tmp_path):
    """More scenarios at first states that are not solved: no trial was retried."""
    rows = []
    for state in range(40):
        for copy in range(1 if state % 2 else 4):
            common = {"policy": "a", "first_state": f"{state:064x}"}
            for start, success in (("initial", state % 2 == 1), ("recovery", copy % 2 == 0)):
                rows.append(trial_row(100 * copy + state, success=success, start=start, **common))
    found = analyse(read_study([str(write_log(tmp_path / "log.jsonl", rows))]), QUICK)
    assert barred_arms(found.initial) == {}
