"""A monitor's numbers: hand-worked tables, the paper's, and brute force beside them."""

from __future__ import annotations

import csv
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.analysis.pages.monitor import Measured, summary_text, to_json, write_monitor_report
from lerobot_roborecover.analysis.published import table as published_table
from lerobot_roborecover.analysis.stats.intervals import jackknife, rate_interval
from lerobot_roborecover.analysis.stats.monitor import METRICS, MonitorFrames, metric_columns
from lerobot_roborecover.analysis.stats.monitor_curves import choose_threshold
from lerobot_roborecover.analysis.stats.monitor_report import monitor_report


def frames(rows, threshold=0.5) -> MonitorFrames:
    """From (scenario, episode, step, label, score) rows; the recovery step is the first one of label 1."""
    scenario, episode, step, label, score = (np.array(column) for column in zip(*rows, strict=True))
    starts = {e: min((s for _, f, s, y, _ in rows if f == e and y), default=10**6) for e in set(episode)}
    score = score.astype(float)
    return MonitorFrames(
        scenario, episode, step, label, score, np.where(np.isnan(score), False, score > threshold),
        np.array([starts[e] for e in episode]),
    )  # fmt: skip


BY_HAND = [
    # scenario a, trajectory 0: recovery point at step 2, triggers one step late
    ("a", 0, 0, 0, 0.1), ("a", 0, 1, 0, 0.2), ("a", 0, 2, 1, 0.4), ("a", 0, 3, 1, 0.9), ("a", 0, 4, 1, 0.8),
    # scenario a, trajectory 1: flags a frame before the recovery point, then triggers at it
    ("a", 1, 0, 0, 0.7), ("a", 1, 1, 1, 0.6), ("a", 1, 2, 1, 0.3),
    # scenario b: never triggers, and two answers cannot be read
    ("b", 2, 0, 0, 0.0), ("b", 2, 1, 0, math.nan), ("b", 2, 2, 1, math.nan), ("b", 2, 3, 1, 0.45),
]  # fmt: skip


def test_hand_worked_table():
    report = monitor_report(frames(BY_HAND))
    assert (report.scenarios, report.frames, report.unparsed) == (2, 12, 2)
    assert report.confusion == (4, 1, 4, 3)  # TN, FP, FN, TP
    expected = {
        "accuracy": 7 / 12,
        "precision": 3 / 4,
        "recall": 3 / 7,
        "f1": 6 / 11,
        "macro_f1": (6 / 11 + 8 / 13) / 2,
        "false_positive_rate": 1 / 5,
    }
    assert {k: v.value for k, v in report.metrics.items()} == pytest.approx(expected)
    e = report.episodes
    assert e.trajectories == 3
    assert e.every_step
    assert e.delays == pytest.approx([1, 0, np.nan], nan_ok=True)
    assert (e.trigger_rate.value, e.early_rate.value, e.delay_mean.value) == pytest.approx(
        (2 / 3, 1 / 3, 0.5)
    )


def test_intervals_take_scenarios_as_independent():
    report = monitor_report(frames(BY_HAND))
    # Two scenarios pin nothing down, however many frames they have.
    recall = report.metrics["recall"]
    assert recall.low < 0.05
    assert recall.high > 0.95
    # By hand: recall is 3 of 5 in a, 0 of 2 in b; with one of them left out, 0 and 3/5.
    spread = jackknife(3 / 7, np.array([0, 3 / 5]), np.array([5, 2]))
    assert spread.variance == pytest.approx((2 * 0.3**2) / 2)
    assert spread.effective == pytest.approx(7**2 / (5**2 + 2**2))
    assert (recall.low, recall.high) == rate_interval(spread)
    alone = monitor_report(frames([r for r in BY_HAND if r[0] == "a"]))
    assert math.isnan(alone.metrics["recall"].low)


def test_missing_steps_are_noticed():
    kept = [r for r in BY_HAND if not (r[1] == 0 and r[2] == 3)]
    assert not monitor_report(frames(kept)).episodes.every_step


@pytest.mark.parametrize("row", published_table("monitor_validation"), ids=lambda r: r["validation"])
def test_the_paper_s_table_from_its_counts(row):
    """Through the same arrays as measured frames; the paper prints two decimals of per cents."""
    counts = [int(row[k]) for k in ("tn", "fp", "fn", "tp")]
    label = np.repeat([0, 0, 1, 1], counts)
    decision = np.repeat([False, True, False, True], counts)
    n = len(label)
    built = MonitorFrames(
        np.repeat("s", n),
        np.zeros(n, int),
        np.arange(n),
        label,
        decision.astype(float),
        decision,
        np.full(n, n),
    )
    report = monitor_report(built)
    assert list(report.confusion) == counts
    names = ("accuracy", "precision", "recall", "f1", "macro_f1", "fpr")
    got = [100 * report.metrics[m].value for m in METRICS]
    assert got == pytest.approx([float(row[k]) for k in names], abs=0.0051)


@pytest.fixture(scope="module")
def noisy() -> MonitorFrames:
    rng = np.random.default_rng(0)
    rows = []
    for episode in range(30):
        start = int(rng.integers(3, 12))
        for step in range(20):
            label = int(step >= start)
            score = np.clip(rng.normal(0.35 + 0.3 * label, 0.2), 0, 1).round(2)  # rounding makes ties
            rows.append((f"s{episode % 12}", episode, step, label, score))
    return frames(rows)


def test_areas_are_what_brute_force_gives(noisy):
    report = monitor_report(noisy)
    score, label = noisy.score, noisy.label
    pairs = (score[label == 1][:, None] > score[label == 0]) + 0.5 * (
        score[label == 1][:, None] == score[label == 0]
    )
    assert report.roc.area.value == pytest.approx(pairs.mean())
    total, recall_before = 0.0, 0.0
    for threshold in sorted(set(score), reverse=True):
        flagged = score >= threshold
        recall = label[flagged].sum() / label.sum()
        total += (recall - recall_before) * label[flagged].mean()
        recall_before = recall
    assert report.precision_recall.area.value == pytest.approx(total)
    assert report.roc.area.low < report.roc.area.value < report.roc.area.high


@pytest.mark.parametrize("rule", ["macro_f1", "f1", "accuracy", "youden", "fpr=0.1"])
def test_a_chosen_threshold_is_the_best_of_all(noisy, rule):
    chosen = choose_threshold(noisy, rule)

    def value(threshold):
        counts = monitor_counts(noisy.at(threshold))
        tn, fp, fn, tp = counts
        if rule.startswith("fpr"):
            return tp / (tp + fn) if fp / (fp + tn) <= 0.1 else -1
        if rule == "youden":
            return tp / (tp + fn) - fp / (fp + tn)
        return metric_columns(np.array([counts], float))[0, METRICS.index(rule)]

    best = max(value(t) for t in np.linspace(-0.001, 1.0, 1002))
    assert value(chosen) == pytest.approx(best)


def monitor_counts(f: MonitorFrames) -> tuple[int, int, int, int]:
    y, d = f.label == 1, f.decision
    return int((~y & ~d).sum()), int((~y & d).sum()), int((y & ~d).sum()), int((y & d).sum())


def test_without_an_answer_that_can_be_read_there_is_no_area(noisy):
    unread = replace(noisy, score=np.full(len(noisy.score), np.nan))
    report = to_json(monitor_report(unread))
    assert report["unparsed"] == len(noisy.label)
    assert report["auroc"] == {"value": None, "low": None, "high": None}


@pytest.mark.parametrize("rule", ["best", "fpr", "fpr=2", "f1=0.5"])
def test_unknown_threshold_rules_are_refused(noisy, rule):
    with pytest.raises(ValueError, match="not one of"):
        choose_threshold(noisy, rule)


@pytest.mark.slow
def test_the_report_holds_the_numbers_in_every_form(noisy, tmp_path):
    measured = [Measured("natural", noisy, monitor_report(noisy))]
    measured.append(Measured("by_hand", frames(BY_HAND), monitor_report(frames(BY_HAND))))
    page = write_monitor_report(tmp_path, measured, level=0.95, about={"monitor": "<b>x</b>"})
    text = page.read_text()
    assert "&lt;b&gt;x&lt;/b&gt;" in text
    assert len(re.findall(r'<img src="data:image/svg', text)) == 4
    assert "http://" not in text
    assert "https://" not in text
    numbers = json.loads((tmp_path / "metrics.json").read_text())["datasets"]["by_hand"]
    assert numbers["confusion"] == {"tn": 4, "fp": 1, "fn": 4, "tp": 3}
    assert numbers["unparsed"] == 2
    assert numbers["episodes"]["delays"] == [1, 0, None]
    with open(tmp_path / "frames" / "by_hand.csv") as file:
        rows = list(csv.DictReader(file))
    assert [r["score"] for r in rows if r["scenario"] == "b"] == ["0", "", "", "0.45"]
    assert (tmp_path / "curves" / "natural_roc.csv").is_file()
    assert "58.3" in summary_text(measured, 0.95)
    assert {p.name for p in (tmp_path / "tables").iterdir()} >= {
        "metrics.csv",
        "confusion.tex",
        "episodes.csv",
    }
