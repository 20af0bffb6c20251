"""Stored trial logs are read as what they were, and written alike each time."""

from __future__ import annotations

from pathlib import Path

import pytest

from lerobot_roborecover.analysis.stats.detection import WILL_FAIL
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.stored_comparison import read_comparison
from lerobot_roborecover.logs.trial_log import TrialLogError, read_trial_log
from recipes.intervention_timing import ARMS, stored_folder
from recipes.metaworld.recovery_data import STORED as RECOVERY_DATA
from recipes.outcomes import OUTCOMES, store_logs, stored_logs
from recipes.robot_lab.__main__ import FILES, STORED, tables
from tests.support.doc_blocks import section
from tests.support.trial_rows import policy_rows, write_log

DOCS = Path(__file__).parents[2] / "docs"


def test_stored_logs_come_back(tmp_path):
    logs = {
        name: write_log(tmp_path / f"{name}.jsonl", policy_rows(name, 5, 2, 0.5, seed))
        for seed, name in enumerate(("direct", "gain"))
    }
    store_logs(logs, tmp_path / "stored")
    found = stored_logs(tmp_path / "stored")
    assert list(found) == ["direct", "gain"]
    assert all(read_trial_log(found[name]) == read_trial_log(log) for name, log in logs.items())
    before = {name: path.read_bytes() for name, path in found.items()}
    store_logs(logs, tmp_path / "stored")
    assert {name: path.read_bytes() for name, path in found.items()} == before


def test_what_is_not_there_or_damaged_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no stored outcomes"):
        stored_logs(tmp_path)
    (tmp_path / "bad.jsonl").write_text("{}\n")
    with pytest.raises(TrialLogError):
        store_logs({"bad": tmp_path / "bad.jsonl"}, tmp_path / "stored")
    assert not (tmp_path / "stored").exists()


def test_what_the_repository_keeps_is_whole():
    """Each arm has one trial of every test scenario, under the protocol of the others."""
    assert OUTCOMES.is_dir()
    logs = stored_logs(stored_folder("metaworld"))
    assert set(ARMS) < set(logs)
    rows = {name: read_trial_log(logs[name]) for name in ARMS}
    ids = {row.scenario_id for row in rows[ARMS[0]]}
    assert len(ids) == 359
    for of in rows.values():
        assert {row.scenario_id for row in of} == ids
        assert len(of) == len(ids)


def rate_of(success: dict[str, bool]) -> str:
    return f"{100 * sum(success.values()) / len(success):.1f}"


def test_the_page_on_intervention_timing_says_what_is_stored():
    page = (DOCS / "studies" / "intervention_timing.md").read_text(encoding="utf-8")
    logs = stored_logs(stored_folder("metaworld"))
    success = {name: {r.scenario_id: r.success for r in read_trial_log(logs[name])} for name in ARMS}
    direct = success[ARMS[0]]
    assert f"| `direct` | {rate_of(direct)} [" in page
    for name in ARMS[1:]:
        rescued = sum(success[name][i] and not direct[i] for i in direct)
        harmed = sum(direct[i] and not success[name][i] for i in direct)
        row = next(
            line for line in page.splitlines() if line.startswith(f"| `{name}` | {rate_of(success[name])}")
        )
        assert f"| {100 * (rescued - harmed) / 359:+.1f} [" in row
        assert f"| {rescued} / {harmed} |" in row


@pytest.mark.slow
@pytest.mark.parametrize("name", ["detectors", pytest.param("detectors_recovery", marks=pytest.mark.nightly)])
def test_the_page_on_detectors_says_what_is_stored(name):
    page = (DOCS / "log" / "detectors.md").read_text(encoding="utf-8")
    found = read_comparison(OUTCOMES / name)
    assert len(found.measured) == 9
    for detector in found.measured:
        area = detector.report.rankings[WILL_FAIL].roc.area
        alarmed = detector.report.conformal.clean_alarmed
        for value in (area, alarmed):
            shown = f"{100 * value.value:.1f} [{100 * value.low:.1f}, {100 * value.high:.1f}]"
            assert f"| `{detector.name}` | {shown} |" in page


TRAININGS = [
    # page, its section, stored outcomes, trials of a run from recovery points
    ("recovery_data", "## Results", RECOVERY_DATA, 359),
    ("recovery_per_hour", "### Meta-World, ", OUTCOMES / "recovery_per_hour_metaworld", 161),
    ("recovery_per_hour", "### LIBERO, ", OUTCOMES / "recovery_per_hour_libero", 86),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "heading", "stored", "scenarios"), TRAININGS, ids=[stored.name for *_, stored, _ in TRAININGS]
)
def test_the_pages_on_correction_data_say_what_is_stored(name, heading, stored, scenarios):
    page = section((DOCS / "studies" / f"{name}.md").read_text(encoding="utf-8"), heading)
    rates: dict[str, list[str]] = {}
    trials = 0
    for run, log in stored_logs(stored).items():
        rows = read_trial_log(log)
        trials += len(rows)
        success = {r.scenario_id: r.success for r in rows if r.start == "recovery"}
        assert len(success) == scenarios
        rates.setdefault(run.rpartition("_")[0], []).append(rate_of(success))
    assert f"{trials:,} trials" in page
    for method, runs in rates.items():
        row = next(line for line in page.splitlines() if line.startswith(f"| `{method}` | ") and "[" in line)
        assert f"| {', '.join(runs)} |" in row


def test_the_page_on_the_simulated_lab_says_what_is_stored():
    page = (DOCS / "studies" / "robot_lab.md").read_text(encoding="utf-8").replace("+", "")
    files = {name: STORED / f"{name}.jsonl.gz" for name in FILES}
    (placed,), (restored, starts), (alarms,), (borne,) = (tables(part, files) for part in "abcd")
    for _, placings, _, bias, deviation, ninety, *_ in placed.rows:
        if bias == bias:  # tags gave no number
            assert f"| {placings} | {bias:.1f} | {deviation:.1f} | {ninety:.1f} |" in page
    for row in restored.rows:
        assert all(in_points(cell) in page for cell in (*row[2:5], row[6]))
    assert f"per pixel, by the camera that stands still, are {starts.rows[-1][1]}" in page
    for _, points, repeats, studies, called, _, significant, largest in alarms.rows:
        row = f"| {points} | {repeats} | {studies} | {called} | {significant} | {100 * largest:.1f} |"
        assert row in page
    for policies, offset_mm, rate, difference, *_ in borne.rows:
        if policies == "both":
            cells = [f"{offset_mm:.0f}", in_points(rate), *([in_points(difference)] if difference else [])]
            assert f"| {' | '.join(cells)} |" in page


def in_points(found: Estimate) -> str:
    """As a page shows it."""
    return f"{100 * found.value:.1f} [{100 * found.low:.1f}, {100 * found.high:.1f}]"
