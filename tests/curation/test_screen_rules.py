"""Which scenarios screening keeps: the paper's bounds, deterministic policies, early stops."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.curation.screen import dataset
from lerobot_roborecover.curation.screen.repeat import draw_repeated, run_again
from lerobot_roborecover.curation.screen.runs import parse_policies
from lerobot_roborecover.curation.screen.screening import ScreenRule, count_outcomes, provenance_of, screen
from lerobot_roborecover.curation.screen.tables import (
    format_histogram,
    format_policies,
    format_settled,
    histogram,
)
from lerobot_roborecover.curation.split import draw_unscreened
from lerobot_roborecover.datasets import read_scenarios, write_scenarios
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.logs.row import LoggedTrial
from lerobot_roborecover.scenario import ScenarioError
from tests.support.factories import fake_scenario
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
    # Of the unscreened sample, it has as many as it is validated with.
    (drawn,) = screen([scenario], never, rule, "abc", {scenario.id})
    assert (drawn.settled, drawn.soonest, drawn.unscreened) == (True, 0, True)
    (fewer,) = count_outcomes([scenario], never | {"c": []}, rule, "abc", {scenario.id})
    assert (fewer.settled, fewer.soonest) == (False, 1)
    lost = never | {"d": rows_with(scenario, dict.fromkeys(NAMES, 0), trials=4)["d"]}
    (found,) = screen([scenario], lost, rule, "abc")
    assert found.decision.reason == "too hard"
    both = [*screen([scenario], mixed, rule, "abc"), found]
    assert [line.split() for line in format_settled(both).splitlines()] == [
        ["trials", "stays", "too", "hard"], ["3", "1", "0"], ["7", "0", "1"],
    ]  # fmt: skip
    table = format_policies(both)
    assert re.search(r"^d +n/a \(curtailed\)", table, re.M), table


def test_what_no_trial_recovers_is_given_up():
    scenario, rule = fake_scenario(0), ScreenRule(curtail=True, give_up=12)
    never, ever = (dict.fromkeys(NAMES, wins) for wins in (0, 5))

    def counted(trials: int, wins: int):
        rows = rows_with(scenario, never, trials=1)
        rows |= {"c": rows_with(scenario, never | {"c": wins}, trials=trials)["c"], "d": []}
        return count_outcomes([scenario], rows, rule, "ab")[0]

    assert [(counted(n, 0).settled, counted(n, 0).soonest) for n in range(4)] == [
        (False, 2), (False, 1), (True, 0), (True, 0),
    ]  # fmt: skip
    assert counted(2, 0).decision.reason == "too hard"
    assert not counted(2, 1).settled, "one success: it is tried on"
    assert counted(2, 2).decision.verdict == "kept"
    easy = rows_with(scenario, ever) | {"d": []}
    assert not count_outcomes([scenario], easy, rule)[0].settled, "it is tried on for failures"
    hard = rows_with(scenario, never) | {"d": []}
    at_most_two = ScreenRule(keep=("0", "2"), curtail=True, give_up=12)
    assert not count_outcomes([scenario], hard, at_most_two)[0].settled, "it stays unless it is too easy"
    for bad in ({"give_up": 12}, {"give_up": -1, "curtail": True}):
        with pytest.raises(ScenarioError, match=f"give up after {bad['give_up']} trials"):
            ScreenRule(**bad)


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


def test_trials_that_end_otherwise_the_second_time_are_listed():
    scenarios = [fake_scenario(i) for i in range(40)]
    # As early stops leave them: two trials of some scenarios, five of the others.
    first = merged(*(rows_with(s, dict.fromkeys(NAMES, 1), 2 + 3 * (k % 2)) for k, s in enumerate(scenarios)))
    ids = draw_repeated([s.id for s in scenarios], 0.05, 1000)
    assert len(ids) == 2
    assert ids == draw_repeated([s.id for s in reversed(scenarios)], 0.05, 1000)
    asked = []

    def again(name: str, trials: int, only: set[str]) -> list:
        asked.append((name, trials, len(only)))
        return [r for r in first[name] if r.scenario_id in only]

    same = run_again(first, ids, again)
    assert same.discordant == ()
    assert same.trials == sum(trials * scenarios for _, trials, scenarios in asked)
    changed = min(ids)

    def unsteady(name: str, trials: int, only: set[str]) -> list:
        return [
            replace(r, success=not r.success, outcome="horizon" if r.success else "success")
            if (name, r.scenario_id, r.trial) == ("a", changed, 1)
            else r
            for r in again(name, trials, only)
        ]

    found = run_again(first, ids, unsteady)
    ends = "horizon after 300 steps, then success after 300 steps"
    assert found.discordant == (f"a, {changed}, trial 1: {ends}",)
    assert "1 differ" in str(found)


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


@pytest.mark.parametrize(("curtail", "unscreened"), [(False, 0), (True, 0), (True, 2)])
def test_hard_scenarios_go_to_the_first_policy_and_easy_ones_to_the_last(
    tmp_path, monkeypatch, curtail, unscreened
):
    """Of four the first two do the same every time: both fail in one scenario, both succeed in another."""
    hard, easy, between = scenarios = [fake_scenario(i) for i in range(3)]
    wins = {
        hard.id: {"a": 0, "b": 0, "c": 4, "d": 1},
        easy.id: {"a": 5, "b": 5, "c": 4, "d": 1},
        between.id: {"a": 5, "b": 0, "c": 4, "d": 1},
    }
    tried: list[tuple[str, str, int]] = []

    def run_policy(policy, *_, trials, only, **__):
        rows = []
        for scenario in scenarios:
            if only is None or scenario.id in only:
                all_five = rows_with(scenario, wins[scenario.id])[policy.name]
                rows += [LoggedTrial(row, np.zeros((row.steps, 7))) for row in all_five[:trials]]
                tried.append((scenario.id, policy.name, trials))
        return rows

    monkeypatch.setattr(dataset, "run_policy", run_policy)
    write_scenarios(tmp_path / "set", scenarios)
    dataset.screen_dataset(
        dataset.ScreenRequest(
            dataset=str(tmp_path / "set"), out=tmp_path / "out", rule=ScreenRule(curtail=curtail),
            policies=parse_policies([f"{name}=x/{name}" for name in NAMES])[0], deterministic=["a", "b"],
            unscreened=unscreened,
        )
    )  # fmt: skip
    assert len(read_scenarios(tmp_path / "out")) == 3
    certain = {(s.id, name, 1) for s in scenarios for name in "ab"}
    if unscreened:
        assert draw_unscreened(scenarios, 2, 0) == {hard.id, easy.id}
        assert set(tried) == certain | {(hard.id, "c", 1), (easy.id, "d", 1), (between.id, "d", 1)}
    elif curtail:
        assert set(tried) == certain | {
            (hard.id, "c", 2), (easy.id, "d", 1), (easy.id, "d", 3), (between.id, "d", 1)
        }  # fmt: skip
    else:
        assert set(tried) == {(s.id, n, 1 if n in "ab" else 5) for s in scenarios for n in NAMES}


def test_handoffs_are_kept_until_the_trials_are_whole(tmp_path, monkeypatch):
    scenario = fake_scenario(0)
    write_scenarios(tmp_path / "set", [scenario])
    request = dataset.ScreenRequest(
        dataset=str(tmp_path / "set"), out=tmp_path / "out", policies=parse_policies(["a=x/a"])[0]
    )
    kept: list[Path] = []

    def run_policy(policy, *_, snapshots, **__):
        snapshots.mkdir(parents=True, exist_ok=True)
        kept[:] = snapshots.iterdir()
        if not kept:
            (snapshots / "1.snapshot").write_bytes(b"")
            raise KeyboardInterrupt
        rows = rows_with(scenario, dict.fromkeys(NAMES, 3))["a"]
        return [LoggedTrial(row, np.zeros((row.steps, 7))) for row in rows]

    monkeypatch.setattr(dataset, "run_policy", run_policy)
    with pytest.raises(KeyboardInterrupt):
        dataset.screen_dataset(request)
    dataset.screen_dataset(request)
    assert [path.name for path in kept] == ["1.snapshot"]
    assert not kept[0].parent.exists()
