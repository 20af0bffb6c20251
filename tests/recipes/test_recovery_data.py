"""Mixtures of demonstrations and recoveries: equally many frames, the wanted shares, drawn the same way."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recipes.metaworld.dataset import STUDY_TASKS, Episode, create_dataset, save_episode
from recipes.metaworld.recovery_data import (
    MIXTURES,
    Mixture,
    draw,
    draw_curve,
    frames_of,
    mixtures,
    read_episodes,
)


def episode(length: int, mark: float = 0.0) -> Episode:
    return Episode(np.full((length, 39), mark), np.full((length, 4), mark), np.arange(length) >= length - 1)


def some(lengths, mark: float, tasks: str = "ab"):
    return [(tasks[i % len(tasks)], episode(n, mark)) for i, n in enumerate(lengths)]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(1, 40), min_size=3, max_size=30), st.integers(0, 3), st.data())
def test_exactly_so_many_frames_are_drawn(lengths, seed, data):
    episodes = some(lengths, 1.0)
    wanted = data.draw(st.integers(0, sum(lengths)))
    drawn = list(draw(episodes, wanted, seed))
    assert frames_of(drawn) == wanted
    again = list(draw(episodes, wanted, seed))
    assert [(t, len(e.actions)) for t, e in drawn] == [(t, len(e.actions)) for t, e in again]
    with pytest.raises(ValueError, match="lacking"):
        list(draw(episodes, sum(lengths) + 1, seed))


def test_mixtures_are_of_one_size_and_of_their_shares():
    made = mixtures(some([30] * 20, 1.0), some([25] * 20, 2.0), some([10] * 12, 3.0), MIXTURES)
    # 120 frames of recoveries are half of the largest mixture that all of them can have.
    assert {frames_of(m) for m in made.values()} == {240}
    for name, mixture in MIXTURES.items():
        marks = np.concatenate([e.actions[:, 0] for _, e in made[name]])
        assert np.mean(marks == 3.0) == pytest.approx(mixture.recoveries, abs=0.01)
        assert set(marks) == ({2.0} if mixture.perturbed else {1.0, 3.0} if mixture.recoveries else {1.0})
        assert {task for task, _ in made[name]} == {"a", "b"}
    alone = mixtures(some([30] * 20, 1.0), some([25] * 20, 2.0), [], {"clean": Mixture(0.0)})
    assert frames_of(alone["clean"]) == 500


@pytest.mark.lerobot
def test_episodes_come_back_from_a_dataset(tmp_path):
    from lerobot_roborecover.platforms.metaworld import PLATFORM

    tasks = [PLATFORM.task(name) for name in STUDY_TASKS[:2]]
    dataset = create_dataset(tmp_path / "d")
    for task, length in ((tasks[0], 4), (tasks[1], 6), (tasks[0], 3)):
        save_episode(dataset, task, episode(length, float(length)))
    dataset.finalize()
    found = read_episodes(tmp_path / "d")
    assert [(t, len(e.actions)) for t, e in found] == [
        (tasks[0].instruction, 4), (tasks[1].instruction, 6), (tasks[0].instruction, 3),
    ]  # fmt: skip
    assert found[1][1].observations.shape == (6, 39)
    assert found[2][1].actions[0, 0] == 3.0
    assert found[2][1].solved.tolist() == [False, False, True]


def test_the_curve_shows_each_mixture_at_its_share(tmp_path):
    def percent(value: float) -> dict:
        return {"value": value, "low": value - 0.1, "high": value + 0.1}

    rates = {"clean": 0.3, "recoveries_25": 0.5, "shaken": 0.4}
    tables = {
        "methods": {
            "columns": [{"title": t} for t in ("Method", "Runs", "RSR %, runs like these")],
            "rows": [[name, 2, percent(rate)] for name, rate in rates.items()],
        },
        "overall": {
            "columns": [{"title": t} for t in ("Policy", "Initial state %")],
            "rows": [[name, percent(0.8)] for name in rates],
        },
        "runs": {"rows": [[name, f"{name}_{i}", percent(r)] for name, r in rates.items() for i in (0, 1)]},
    }
    (tmp_path / "results.json").write_text(json.dumps({"tables": tables}))
    drawn = draw_curve(tmp_path).read_text()
    assert all(
        f"<!-- {label} -->" in drawn for label in ("0%", "25%", "shaken", "recovery", "initial states")
    )
    assert "<!-- 10% -->" not in drawn
    assert "<!-- 50% -->" not in drawn
