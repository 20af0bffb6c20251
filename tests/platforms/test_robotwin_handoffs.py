"""Handoffs on RoboTwin: exact for every shipped scenario; from snapshots only on request."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover import load_scenarios
from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.replay.handoff import Handoff, SnapshotCache, hand_off, with_fingerprint
from lerobot_roborecover.scenario import Reset, Scenario, Task
from tests.support.robotwin_checkouts import ROOT, can_render, on_real, on_standin, run_fresh

pytestmark = pytest.mark.robotwin

TASK = Task("robotwin", "demo_clean", "stack_blocks_two", "Stack the green block on the red block.", 800)
SHIPPED = list(load_scenarios("robotwin_starter"))
LIFTED_M = 0.80
"""Height at which a block is held: it lies on the table at 0.765."""
AFTER = 40
"""Actions compared after the handoff."""


@pytest.fixture(scope="module")
def simulator():
    made = make_simulator("robotwin", robotwin_root=ROOT, obs_type="state")
    yield made
    made.close()


@pytest.fixture(scope="module")
def carried(simulator):
    """A scenario whose handoff is in mid-carry, and the actions that follow it."""
    from recipes.robotwin.expert import BlockExpert
    from recipes.robotwin.plans import solve

    simulator.reset(TASK, Reset(seed=3))
    actions, handoff = [], None
    for action in solve(BlockExpert(simulator), "stack_blocks_two"):
        simulator.step(action)
        actions.append(action)
        if handoff is None and simulator.bodies()["block1"].position_m[2] > LIFTED_M:
            handoff = len(actions)
        if handoff is not None and len(actions) == handoff + AFTER:
            break
    labels = {"stage": "Move", "deviation": "Wrong Pose", "source": "natural"}
    prefix = np.array(actions[:handoff])
    scenario = Scenario(id="carried", task=TASK, reset=Reset(seed=3), prefix=prefix, **labels)
    return with_fingerprint(simulator, scenario), np.array(actions[handoff:])


def assert_exact(handoff: Handoff) -> None:
    assert handoff.identical is True, handoff
    assert (handoff.eef_error_mm, handoff.object_error_mm, handoff.problem) == (0.0, 0.0, None)
    assert not handoff.from_snapshot


@pytest.fixture(scope="module")
def drawing():
    """A simulator that renders, with another shader than RoboTwin's own."""
    if not can_render():
        yield None
        return
    made = make_simulator("robotwin", robotwin_root=ROOT, render_quality="minimal")
    yield made
    made.close()


@pytest.mark.nightly
@pytest.mark.slow
@on_real
@pytest.mark.parametrize("scenario", SHIPPED, ids=lambda s: s.id)
def test_a_shipped_scenario_hands_off_exactly(simulator, scenario):
    handoff = hand_off(simulator, scenario)
    print(f"{scenario.id}: {handoff.eef_error_mm} mm, {handoff.object_error_mm} mm")
    assert_exact(handoff)


@pytest.mark.nightly
@pytest.mark.slow
@on_real
@pytest.mark.parametrize("scenario", SHIPPED[::6], ids=lambda s: s.id)
def test_a_shipped_scenario_hands_off_exactly_after_another_and_rendered(simulator, drawing, scenario):
    handoffs = {"first": hand_off(simulator, scenario)}
    other = next(s for s in SHIPPED if s.id != scenario.id)
    hand_off(simulator, replace(other, prefix=other.prefix[:3], fingerprint=None))
    handoffs["second reset, after another scenario"] = hand_off(simulator, scenario)
    if drawing is not None:
        handoffs["another shader"] = hand_off(drawing, scenario)
        assert drawing.render().any()
    for case, handoff in handoffs.items():
        print(f"{scenario.id}, {case}: {handoff.eef_error_mm} mm, {handoff.object_error_mm} mm")
        assert_exact(handoff)


@pytest.mark.slow
@on_real
def test_shipped_scenarios_hand_off_exactly_in_a_fresh_process():
    lines = run_fresh(
        f"""
from lerobot_roborecover import load_scenarios
from lerobot_roborecover.replay.handoff import hand_off
from lerobot_roborecover.platforms import make_simulator
simulator = make_simulator("robotwin", robotwin_root={ROOT!r}, obs_type="state")
for scenario in reversed(list(load_scenarios("robotwin_starter"))):
    handoff = hand_off(simulator, scenario)
    print(scenario.id, handoff.eef_error_mm, handoff.object_error_mm, handoff.identical, handoff.problem)
"""
    ).splitlines()
    print("in a fresh process:", *lines, sep="\n")
    assert sorted(lines) == sorted(f"{s.id} 0.0 0.0 True None" for s in SHIPPED)


def test_the_starter_set_is_large_enough_and_as_its_recipes_say():
    from recipes.robotwin.faults import FAULTS
    from recipes.robotwin.recipes import RECIPES

    assert len(SHIPPED) >= 40
    assert len({s.cell for s in SHIPPED}) >= 6
    assert {s.task.name for s in SHIPPED} == {
        "stack_blocks_two",
        "stack_blocks_three",
        "blocks_ranking_rgb",
        "blocks_ranking_size",
        "handover_block",
    }
    assert len({s.cluster for s in SHIPPED}) >= 35, "scenes"
    assert min(Counter(s.source.value for s in SHIPPED).values()) >= 15, "natural and perturbed ones"
    assert len([s for s in SHIPPED if s.provenance["moved_m"]]) >= 20, (
        "scenarios in which something was moved"
    )
    recipes = {recipe.id: recipe for recipe in RECIPES}
    assert {s.id for s in SHIPPED} == set(recipes)
    for scenario in SHIPPED:
        fault = FAULTS[recipes[scenario.id].fault]
        assert (scenario.stage, scenario.deviation) == (fault.stage, fault.deviation)
        assert scenario.provenance["sees"] == fault.words(scenario.task.name)
        assert scenario.fingerprint.versions["robotwin_code"]
        assert "robot_fk.left.1" in scenario.fingerprint.versions
        assert re.fullmatch("[0-9a-f]{64}", scenario.fingerprint.state_sha256)
        assert scenario.provenance["robotwin_commit"]
        assert scenario.provenance["proof"]["steps"] <= scenario.task.horizon


@pytest.mark.nightly
@on_standin
def test_the_command_that_makes_the_starter_set(tmp_path, capsys):
    from recipes.robotwin.starter import main

    arguments = [
        "--only",
        "two-4-drop",
        "--robotwin-root",
        ROOT,
        "--jobs",
        "1",
        "--work",
        str(tmp_path / "work"),
    ]
    assert main(["--out", str(tmp_path / "set"), *arguments]) == 0
    assert "Approach-Stage Rollback" in capsys.readouterr().out
    (scenario,) = load_scenarios(str(tmp_path / "set"))
    assert scenario.provenance["moved_m"]["block1"] > 0.02
    assert scenario.fingerprint.state_sha256
    # What is finished is not made again: another run needs no checkout for it.
    arguments[3] = str(tmp_path / "nowhere")
    assert main(["--out", str(tmp_path / "again"), *arguments]) == 0
    (again,) = load_scenarios(str(tmp_path / "again"))
    assert again.sha256() == scenario.sha256()
    (tmp_path / "work" / "refused").mkdir()
    (tmp_path / "work" / "made" / scenario.id).rename(tmp_path / "work" / "aside")
    (tmp_path / "work" / "refused" / f"{scenario.id}.txt").write_text("the expert does not recover")
    assert main(["--out", str(tmp_path / "none"), *arguments]) == 1
    assert "the expert does not recover" in capsys.readouterr().err


def test_a_snapshot_is_not_used_unless_asked_for(simulator, carried):
    scenario, _ = carried
    cache = SnapshotCache()
    for _ in range(2):
        assert_exact(hand_off(simulator, scenario, cache=cache))


@pytest.mark.nightly
def test_approximate_snapshots_give_the_handoff_and_drift_alike(simulator, carried, tmp_path):
    """What follows a restored snapshot is not what follows a replay, but the same for all trials."""
    scenario, after = carried

    def go_on() -> list[dict]:
        bodies = []
        for action in after:
            simulator.step(action)
            bodies.append(simulator.bodies())
        return bodies

    hand_off(simulator, scenario)
    seen = simulator.observe()["agent_pos"]
    replayed = go_on()
    cache = SnapshotCache(folder=tmp_path / "snapshots", approximate=True)
    ends = set()
    for _ in range(2):  # the trial that takes the snapshot, and one that finds it
        handoff = hand_off(simulator, scenario, cache=cache)
        assert (handoff.from_snapshot, handoff.identical, handoff.problem) == (True, True, None)
        assert max(handoff.eef_error_mm, handoff.object_error_mm) < 1e-3
        assert (simulator.observe()["agent_pos"] == seen).all()
        restored = go_on()
        ends.add(simulator.state_sha256())
    drift = [
        [1e3 * a[n].distance_m(b[n]) for n in sorted(a)] for a, b in zip(replayed, restored, strict=True)
    ]
    names, worst = sorted(replayed[0]), np.max(drift, axis=0)
    print("drift, mm:", {name: round(mm, 4) for name, mm in zip(names, worst, strict=True)})
    assert 0 < worst.max() < 2

    write_scenarios(tmp_path / "set", [scenario])
    np.save(tmp_path / "after.npy", after)
    ends.add(
        run_fresh(
            f"""
import numpy as np
from pathlib import Path
from lerobot_roborecover import load_scenarios
from lerobot_roborecover.replay.handoff import hand_off
from lerobot_roborecover.replay.handoff import SnapshotCache
from lerobot_roborecover.platforms import make_simulator
scenario = load_scenarios({str(tmp_path / "set")!r})[0]
simulator = make_simulator("robotwin", robotwin_root={ROOT!r}, obs_type="state")
cache = SnapshotCache(folder=Path({str(tmp_path / "snapshots")!r}), approximate=True)
assert hand_off(simulator, scenario, cache=cache).from_snapshot
for action in np.load({str(tmp_path / "after.npy")!r}): simulator.step(action)
print(simulator.state_sha256())
"""
        ).split()[-1]
    )
    assert len(ends) == 1, "a trial depends on which came first, or where it ran"


def test_a_snapshot_that_restores_another_state_is_an_error(simulator, carried):
    from lerobot_roborecover.platforms import SimulatorError

    scenario, _ = carried
    cache = SnapshotCache(approximate=True)
    hand_off(simulator, scenario, cache=cache)
    ((key, (snapshot, _)),) = cache._entries.items()
    cache.put(key, snapshot, "0" * 64)
    with pytest.raises(SimulatorError, match="approximate_snapshots"):
        hand_off(simulator, scenario, cache=cache)
    assert hand_off(simulator, scenario).from_snapshot is False
