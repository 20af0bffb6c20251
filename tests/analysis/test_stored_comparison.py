"""A comparison of detectors comes out of its stored scores as it went in; a damaged record is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lerobot_roborecover.analysis.detection_scores import MAX_SCORES, read_scores
from lerobot_roborecover.analysis.pages.detection import MeasuredDetector, write_detection_report
from lerobot_roborecover.analysis.stats.detection import ScoredTrial, detection_report
from lerobot_roborecover.analysis.stats.detection_pairs import detector_contrasts
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.stored_comparison import read_comparison
from lerobot_roborecover.cli.main import main
from tests.support.shipped_policies import CHECKPOINT


def scored(seed: int, gap: float, units: int = 30) -> list[ScoredTrial]:
    rng, trials = np.random.default_rng(seed), []
    for unit in range(units):
        for start in ("recovery", "initial"):
            fails = start == "recovery" and unit % 3 == 0
            scores = rng.normal(gap * fails, 1.0, 5 + unit % 4)
            scores[:1] = np.nan
            decided = scores > 0.5
            trials.append(
                ScoredTrial(f"s{unit}", f"u{unit // 2}", start, 0, not fails, 20.0, 1, scores, decided)
            )
    return trials


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """The folder of a comparison of three detectors, of which one reads the outcome and is not tested."""
    out = tmp_path_factory.mktemp("detectors") / "first"
    trials = {"good": scored(0, 2.0), "own threshold": scored(1, 0.5), "oracle": scored(2, 9.0)}
    decides = {"own threshold"}
    measured = [
        MeasuredDetector(
            name, f"{name} as written", "state", "", False,
            detection_report(of, alpha=0.2, probabilities=False, decides=name in decides, seed=3, level=0.9),
            1.5,
        )
        for name, of in trials.items()
    ]  # fmt: skip
    pairs = detector_contrasts({m.name: m.report for m in measured[:2]}, against=["good"], level=0.9)
    write_detection_report(
        out, measured, trials, (), alpha=0.2, level=0.9, seed=3, about={"policy": "made up"}, pairs=pairs,
        against=["good"],
    )  # fmt: skip
    return out


@pytest.mark.nightly
@pytest.mark.slow
def test_the_report_of_stored_scores_says_the_same(first, tmp_path, capsys):
    again = tmp_path / "again"
    assert main(["detect", "evaluate", "--scores", str(first), "--out", str(again)]) == 0
    assert "own threshold" in capsys.readouterr().out
    for name in ("detectors.md", "detectors.json", "tables/detectors.csv"):
        assert (again / name).read_bytes() == (first / name).read_bytes(), name
    for name in ("good", "own threshold", "oracle"):
        one, other = (read_scores(folder / "scores" / f"{name}.npz") for folder in (first, again))
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a.scores, b.scores)
            assert (a.unit, a.start, a.success, a.handoff) == (b.unit, b.start, b.success, b.handoff)


def test_scores_go_with_nothing_that_would_run(first, tmp_path, capsys):
    for name in (["eval-monitor"], ["detect", "evaluate"]):
        asked = [*name, "--scores", str(first), "--policy", CHECKPOINT, "--out", str(tmp_path / "o")]
        assert main(asked) == 2
        assert "--policy does not belong to --scores" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda n: n | {"schema_version": 99}, "schema_version 99"),
        (lambda n: {k: v for k, v in n.items() if k != "alpha"}, "no field 'alpha'"),
        (lambda n: n | {"detectors": 3}, "not the record of a comparison"),
        (lambda n: n | {"detectors": {"../../elsewhere": {}}}, "elsewhere.npz"),
    ],
    ids=["version", "field", "kind", "path"],
)
def test_a_damaged_record_is_refused(first, tmp_path, change, match):
    numbers = json.loads((first / "detectors.json").read_text())
    (tmp_path / "detectors.json").write_text(json.dumps(change(numbers)))
    with pytest.raises(RowsError, match=match):
        read_comparison(tmp_path)


def test_damaged_scores_are_refused(first, tmp_path):
    good = dict(np.load(first / "scores" / "good.npz"))
    cases = {
        "cut": {"score": good["score"][:-1]},
        "'length' is not": {"length": good["length"] * 1.0},
        f"limit is {MAX_SCORES}": {"length": np.full_like(good["length"], 10**9)},
    }
    for match, change in cases.items():
        np.savez(tmp_path / "bad.npz", **(good | change))
        with pytest.raises(RowsError, match="shape" if match == "cut" else match):
            read_scores(tmp_path / "bad.npz")
    np.savez(tmp_path / "bad.npz", **{k: v for k, v in good.items() if k != "decision"})
    with pytest.raises(RowsError, match="no 'decision'"):
        read_scores(tmp_path / "bad.npz")
    (tmp_path / "bad.npz").write_bytes(b"PK no zip")
    with pytest.raises(RowsError, match="cannot read the scores"):
        read_scores(tmp_path / "bad.npz")
