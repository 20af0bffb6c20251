"""What a page holds of single trials: rows without names and folders, curves, all of bounded size."""

from __future__ import annotations

import base64
import json
import zlib
from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.analysis.pages.trial_details import (
    LEVELS,
    MOST_POINTS,
    ShownTrial,
    action_folders,
    packed,
    packed_within,
)
from lerobot_roborecover.logs.row import actions_digest, put_actions
from tests.support.trial_rows import trial_row


def unpacked(text):
    return json.loads(zlib.decompress(base64.b64decode(text)))


def test_rows_come_back_without_raters_and_folders():
    row = trial_row(
        3, 1, False, policy="/home/kim/outputs/act/last", reason="cannot open /home/kim/secret/log.txt",
        trial_seed=2**62 + 1,
        options={"driver": "/home/kim/models/act"}, robot={"rater": "kim", "verdict": "failure"},
    )  # fmt: skip
    text = packed([ShownTrial("act", "recovery", k, replace(row, trial=k)) for k in range(3)])
    found = unpacked(text)
    rows = [{**found["shared"], **trial["row"]} for trial in found["trials"]]
    assert [r["trial"] for r in rows] == [0, 1, 2]
    assert rows[1]["scenario_id"] == "s003"
    assert "scenario_id" in found["shared"], "once for all trials"
    assert rows[1]["robot"] == {"verdict": "failure"}
    for hidden in ("kim", "home"):
        assert hidden not in json.dumps(found)
    assert rows[1]["trial_seed"] == str(2**62 + 1), "a browser would round it"
    assert rows[1]["reason"] == "cannot open secret/log.txt"


def test_curves_keep_ends_and_shape_in_few_points(tmp_path):
    n = 250
    actions = np.stack([np.linspace(-1, 3, n), np.full(n, 0.5), np.sin(np.arange(n) / 9)], 1)
    row = trial_row(0, steps=n, progress=list(np.linspace(0, 100, n + 1).astype(int).tolist()))
    row = replace(row, actions_sha256=actions_digest(actions), platform="no such platform")
    log = tmp_path / "trials.jsonl"
    put_actions(tmp_path / "actions", actions, row)
    (trial,) = unpacked(packed([ShownTrial("a", "recovery", 0, row)], action_folders([log])))["trials"]
    assert len(trial["progress"]) == MOST_POINTS
    assert (trial["progress"][0], trial["progress"][-1]) == (0, 100)
    curves = trial["actions"]
    assert curves["names"] == ["action 1", "action 2", "action 3"]
    assert (curves["low"], curves["high"]) == (
        pytest.approx([-1, 0.5, -1], abs=0.01),
        pytest.approx([3, 0.5, 1], abs=0.01),
    )
    places = np.linspace(0, n - 1, MOST_POINTS).round().astype(int)
    for k, levels in enumerate(curves["levels"]):
        values = curves["low"][k] + np.array(levels) / LEVELS * (curves["high"][k] - curves["low"][k])
        assert np.abs(values - actions[places, k]).max() < 0.03
    (bare,) = unpacked(packed([ShownTrial("a", "recovery", 0, row)]))["trials"]
    assert "actions" not in bare, "not recorded"


def test_the_whole_is_bounded_and_the_first_cards_keep_theirs():
    cards = [[ShownTrial("a", "recovery", 0, trial_row(n))] for n in range(5)]
    every = packed_within(cards)
    assert all(every)
    sizes = [len(text) for text in every]
    kept = packed_within(cards, limit_bytes=sum(sizes[:3]))
    assert kept == [*every[:3], "", ""]
    assert packed_within(cards, limit_bytes=sizes[0] - 1) == [""] * 5
    assert packed_within([[]]) == [""]
