"""RSR against latency, of rows made up."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from lerobot_roborecover.analysis.figures.latency import latency_figure
from lerobot_roborecover.analysis.latency import latency_rates, latency_table
from lerobot_roborecover.analysis.logs import clock_of, read_study
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.tables import to_text
from tests.support.trial_rows import policy_rows, trial_row, write_log

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "latency.py"


def at(latency, rate, during_inference="hold", policy="a"):
    clock = {"realtime": during_inference, "latency_s": latency} if during_inference else {}
    made = policy_rows(policy, 12, 2, rate, 1)
    options = {**made[0].options, **clock}
    again = {"options": options, "config_hash": f"{policy}{latency}{during_inference}"}
    return [trial_row(r.scenario_id, r.trial, r.success, policy=policy, **again) for r in made]


ROWS = [*at(0.0, 0.7, ""), *at(0.2, 0.4), *at(0.1, 0.6), *at("measured", 0.5), *at(0.1, 0.65, "chunk")]


def test_rates_by_latency():
    rates = latency_rates(ROWS)
    known = [(r.during_inference, r.latency_s) for r in rates]
    assert known[:-1] == [("", 0.0), ("chunk", 0.1), ("hold", 0.1), ("hold", 0.2)]
    assert known[-1][0] == "hold"
    assert known[-1][1] != known[-1][1], "a measured latency is no number"
    for rate, rows in zip(rates, (ROWS[:24], ROWS[96:], ROWS[48:72], ROWS[24:48], ROWS[72:96]), strict=True):
        assert rate.rate.value == pytest.approx(sum(r.success for r in rows) / 24)
        assert rate.rate.low < rate.rate.value < rate.rate.high
        assert (rate.scenarios, rate.trials) == (12, 24)
    text = to_text(latency_table(rates))
    assert all(words in text for words in ("a frozen clock", "0.1 s (chunk)", "measured latency (hold)"))
    figure = latency_figure(rates)
    assert f"a (hold) {100 * rates[0].rate.value:.1f} at 0 ms, " in figure.description
    assert "at 100 ms" in figure.description


def test_other_scenarios_are_no_comparison():
    with pytest.raises(RowsError, match="run all latencies on the same"):
        latency_rates([*at(0.0, 0.7, ""), *at(0.1, 0.6)[:-2]])
    with pytest.raises(RowsError, match="no trials from recovery points"):
        latency_rates([])


def test_the_script(tmp_path, capsys):
    spec = importlib.util.spec_from_file_location("latency_script", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.main([str(write_log(tmp_path / "log.jsonl", ROWS)), "--out", str(tmp_path / "out")])
    assert "0.2 s (hold)" in capsys.readouterr().out
    assert (tmp_path / "out" / "latency.svg").read_bytes().startswith(b"<?xml")
    assert (tmp_path / "out" / "latency.csv").is_file()


def test_reports_say_that_time_did_not_go_on_alike(tmp_path):
    one = write_log(tmp_path / "a.jsonl", at(0.0, 0.7, "", "a"))
    other = write_log(tmp_path / "b.jsonl", at(0.1, 0.6, "chunk", "b"))
    remarks = read_study([str(one), str(other)]).remarks
    assert any("frozen clock (a); real time (0.1 s an inference, chunk) (b)" in r for r in remarks)
    assert clock_of(at("measured", 0.5)[0]) == "real time (inferences as measured, hold)"
