"""Start errors in reports: beside the rates, against the verdicts, and a policy compared with itself."""

from __future__ import annotations

import numpy as np
import pytest
import statsmodels.api as sm

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.make import report
from lerobot_roborecover.analysis.robot_tables import robot_tables, slopes
from lerobot_roborecover.analysis.stats.start_error import logistic_slope, summary, verdict_slope
from lerobot_roborecover.cli.main import main
from lerobot_roborecover.logs.robot import CameraError, RobotTrial, StartError
from tests.support.trial_rows import trial_row, write_log


def robot_row(scenario: int, trial: int, success: bool, object_px: float, **changes):
    error = StartError({"pan.pos": -0.2}, {"top": CameraError(0.3, object_px, 0.9)})
    robot = RobotTrial("so101_follower", "", "success" if success else "failure", "kim", "A", error, 90.0, 1)
    values = {"platform": "robot", "suite": "so101_follower", "steps": 90, "robot": robot.as_json()}
    return trial_row(scenario, trial, success, **(values | changes))


def rows_of(policy: str, base: float, slope: float, seed: int = 0, scenarios: int = 20, **changes):
    rng = np.random.default_rng(seed)
    found = []
    for scenario in range(scenarios):
        for trial in range(3):
            error = rng.uniform(0, 3)
            chance = 1 / (1 + np.exp(-(base + slope * error)))
            found.append(robot_row(scenario, trial, rng.uniform() < chance, error, policy=policy, **changes))
    return found


def test_the_slope_is_that_of_statsmodels():
    rng = np.random.default_rng(4)
    error = rng.uniform(0, 3, 200)
    groups = rng.integers(0, 2, 200)
    success = (rng.uniform(size=200) < 1 / (1 + np.exp(-(1 + groups - error)))).astype(float)
    design = np.stack([groups == 0, groups == 1, error], 1).astype(float)
    found, theirs = logistic_slope(design, success), sm.Logit(success, design).fit(disp=0)
    assert found.value == pytest.approx(theirs.params[-1], rel=1e-6)
    np.testing.assert_allclose((found.low, found.high), theirs.conf_int()[-1], rtol=1e-5)


def test_separated_or_constant_data_have_no_slope():
    error = np.linspace(0, 3, 20)
    design = np.stack([np.ones(20), error], 1)
    assert np.isnan(logistic_slope(design, (error < 1.5).astype(float)).value)
    same = [robot_row(i, 0, i % 2 == 0, 1.0) for i in range(10)]
    apart = [robot_row(i, 0, i < 5, 0.1 * i) for i in range(10)]
    alike = [robot_row(i, 0, True, 0.1 * i) for i in range(10)]
    unmeasured = [robot_row(i, 0, i % 2 == 0, None) for i in range(10)]
    for rows, reason in (
        (same, "all starts were alike"),
        (apart, "successes and failures do not overlap"),
        (alike, "each policy's verdicts are all alike"),
        (unmeasured, "it was not measured"),
        (apart[3:6], "fewer than 4 trials"),
    ):
        found = verdict_slope(rows, "object_px")
        assert np.isnan(found.estimate.value)
        assert found.reason == reason


def test_a_policy_whose_verdicts_are_all_alike_does_not_hide_the_others_slope():
    mixed = rows_of("act@1", 2.0, -1.5)
    always = [robot_row(i, 0, True, 0.1 * i, policy="pi@2") for i in range(20)]
    assert verdict_slope(mixed + always, "object_px") == verdict_slope(mixed, "object_px")


@pytest.mark.slow
def test_a_report_of_robots_shows_how_far_off_the_starts_were(tmp_path):
    rows = rows_of("act@1", 2.0, -1.5) + rows_of("pi@2", 3.0, -1.5, seed=1)
    refused = robot_row(0, 9, False, 8.0, policy="act@1", outcome="state_mismatch", reason="objects are off")
    log = write_log(tmp_path / "trials.jsonl", [*rows, refused])
    results = analyse(read_study([str(log)]))
    assert not any("lerobot-eval" in remark for remark in results.remarks)
    starts, slope = robot_tables(results)
    act = next(row for row in starts.rows if row[0].startswith("act"))
    assert act[1:4:2] == (61, 1)
    found = next(row[2] for row in slopes(results).rows if row[0] == "objects, px")
    assert found.high < 0 < found.value + 4
    assert slope.name == "robot_slopes"
    said = report([str(log)], tmp_path / "report").text()
    assert "Start errors, medians" in said
    assert "Macro" not in said, "the paper's nine cells are none of a robot's"
    assert "How far off the starts were" in (tmp_path / "report" / "report.html").read_text("utf-8")
    assert (tmp_path / "report" / "tables" / "robot_starts.csv").is_file()
    assert summary(rows).reset_s == 90.0


def test_simulated_trials_have_no_such_tables(tmp_path):
    log = write_log(tmp_path / "trials.jsonl", [trial_row(i, t) for i in range(8) for t in range(2)])
    assert robot_tables(analyse(read_study([str(log)]))) == []


def test_a_policy_compared_with_itself_stays_two_arms(tmp_path):
    one = rows_of("act@1", 1.0, 0.0, policy_settings={"name": "a"}, config_hash="a")
    other = rows_of("act@1", 1.0, 0.0, seed=1, policy_settings={"name": "b"}, config_hash="b")
    results = analyse(read_study([str(write_log(tmp_path / "trials.jsonl", one + other))]))
    assert len(results.recovery.arms) == 2


def test_a_plan_says_the_hours_at_the_robot(capsys):
    words = ["plan", "--rate", "50", "--difference", "30", "--trials", "2", "--robot-minutes", "3"]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "Hours at the robot, both policies" in said
    assert main(["plan", "--rate", "50", "--robot-minutes", "0"]) == 2
    assert "--robot-minutes=0 is not from 0 to 1440 minutes" in capsys.readouterr().err
