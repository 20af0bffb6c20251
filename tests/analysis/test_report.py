"""From trial logs to a report: what it shows, what it refuses, and that it never shows NaN without a word."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.pages.gallery import make_cards
from lerobot_roborecover.analysis.pages.report import headline, write_report
from lerobot_roborecover.analysis.report_tables import all_tables
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.tables import to_csv, to_latex, to_markdown
from lerobot_roborecover.cli.main import main
from tests.support.factories import fake_dataset
from tests.support.loop import evaluate
from tests.support.trial_rows import policy_rows, three_policies, trial_row, write_log

QUICK = Options(draws=200)
_ENCODED = re.compile(r"[\w+/=]{100,}")
"""Pictures and details of trials in a page, whose letters may spell anything."""


def log(tmp_path, rows, name="trials"):
    return str(write_log(tmp_path / f"{name}.jsonl", rows))


def results_of(tmp_path, rows, options=QUICK):
    return analyse(read_study([log(tmp_path, rows)]), options)


def table(results, name):
    return next(t for t in all_tables(results) if t.name == name)


def by_policy(table):
    titles = [c.title for c in table.columns]
    return {row[0]: dict(zip(titles, row, strict=True)) for row in table.rows}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    root = tmp_path_factory.mktemp("report")
    logs = three_policies(root, count=44)
    results = analyse(read_study(logs), Options(draws=500, seed=7))
    return results, write_report(results, root / "out"), root / "out"


@pytest.mark.slow
def test_everything_is_written(written):
    _, files, out = written
    names = {t.name for t in files.tables}
    assert {
        "overall",
        "contrasts",
        "cells",
        "source_matrix",
        "oracle",
        "budgets",
        "retries",
        "retry_budgets",
        "trial_metrics",
        "variance",
        "published",
    } <= names
    for name in names:
        assert (out / "tables" / f"{name}.csv").stat().st_size
        assert (out / "tables" / f"{name}.tex").stat().st_size
    figures = {path.name for path in (out / "figures").iterdir()}
    stems = {
        "forest",
        "slope",
        "cells",
        "source_matrix",
        "paired_differences",
        "time_to_recover",
        "retries",
        "oracle",
    }
    kinds = (".svg", ".png", "_narrow.svg")
    assert {f"{stem}{kind}" for stem in (*stems, "outcomes") for kind in kinds} == figures
    assert not list(out.rglob("*.tmp"))


@pytest.mark.slow
def test_the_page_needs_nothing_but_itself(written):
    page = written[1].html.read_text()
    assert not re.search(r"""(?:src|href)=["'](?!data:|#)""", page)
    assert not re.search(r"https?://(?!www\.w3\.org)", page)
    for image in re.findall(r"<img [^>]*>", page):
        assert re.search(r'alt="[^"]{10,}"', image)


@pytest.mark.nightly
@pytest.mark.slow
def test_the_same_logs_give_the_same_files(written, tmp_path):
    results, _, out = written
    again = write_report(results, tmp_path / "again")
    assert again.html.read_text() == (out / "report.html").read_text()
    for path in (out / "figures").iterdir():
        assert path.read_bytes() == (tmp_path / "again" / "figures" / path.name).read_bytes()


@pytest.mark.slow
def test_seed_and_draws_are_in_every_output(written):
    _, files, out = written
    bootstrap = json.loads(files.results.read_text())["provenance"]["bootstrap"]
    assert (bootstrap["seed"], bootstrap["draws"], bootstrap["unit"], bootstrap["units"]) == (
        7,
        500,
        "scenarios",
        44,
    )
    for text in (
        files.html.read_text(),
        files.markdown.read_text(),
        (out / "tables" / "overall.tex").read_text(),
    ):
        assert "500 draws, seed 7" in text


@pytest.mark.slow
def test_numbers_in_json_are_those_of_the_rows(written):
    results, files, _ = written
    overall = json.loads(files.results.read_text())["tables"]["overall"]
    rsr = {row[0]: row[2]["value"] for row in overall["rows"]}
    for p, policy in enumerate(results.recovery.arms):
        rows = [
            r for arm in results.study.arms for r in arm.rows if (r.policy, r.start) == (policy, "recovery")
        ]
        rates = [
            np.mean([r.success for r in rows if r.scenario_id == s]) for s in {r.scenario_id for r in rows}
        ]
        assert rsr[policy] == pytest.approx(np.mean(rates)), p


@pytest.mark.slow
def test_the_headline_says_how_sure_both_rates_are(written):
    results, files, _ = written
    best = results.ranked.arms[results.best_first[0]]
    row = by_policy(next(t for t in files.tables if t.name == "overall"))[best]
    first, recovery = row["Initial state %"], row["RSR %"]
    bounds = f"{100 * first.low:.1f} to {100 * first.high:.1f}"
    assert headline(results).startswith(
        f"Success of {best.partition('@')[0]}: {100 * first.value:.1f} % ({bounds}) from initial states, "
        f"{100 * recovery.value:.1f} % from recovery points (95 % interval "
    )


@pytest.mark.slow
def test_a_policy_without_an_initial_arm_is_told_so(written):
    results, files, _ = written
    assert any(r.startswith("gamma@3: no trials from initial states") for r in results.remarks)
    assert "gamma@3: no trials from initial states" in files.markdown.read_text()
    assert re.search(r"<h3>gamma@3</h3>\s*<ul><li>no trials from initial", files.html.read_text())
    assert np.isnan(by_policy(table(results, "overall"))["gamma@3"]["Initial state %"].value)
    assert "ranks" not in {t.name for t in files.tables}, "two policies have both: one pair is no ranking"


@pytest.mark.slow
def test_undefined_numbers_are_explained_in_every_table(written):
    for t in written[1].tables:
        for text in (to_markdown(t), to_csv(t), to_latex(t)):
            assert not re.search(r"\bnan\b|\binf\b", text, re.I), t.name
        if "n/a" in to_csv(t):
            assert any(note.startswith("n/a: not defined") for note in t.all_notes()), t.name


@pytest.mark.slow
def test_published_rows_stand_beside_and_are_marked(written):
    published = table(written[0], "published")
    origins = [row[1] for row in published.rows]
    assert (origins.count("this report"), origins.count("published")) == (3, 6)
    assert "not re-run" in published.notes[0]
    pi05 = next(row for row in published.rows if row[:2] == ("pi05", "published"))
    assert (pi05[3].value, pi05[5]) == (pytest.approx(0.644), pytest.approx(0.857))
    rates = [row[3].value for row in published.rows]
    assert rates == sorted(rates, reverse=True)


def test_published_rows_are_those_of_the_platform(tmp_path):
    elsewhere = results_of(tmp_path, policy_rows("a", 12, 2, 0.5, 0, platform="metaworld"))
    assert "published" not in {t.name for t in all_tables(elsewhere)}


@pytest.mark.slow
def test_policies_stand_best_first_everywhere(written):
    results, files, _ = written
    order = list(results.recovery.arms)
    assert order == ["beta@2", "gamma@3", "alpha@1"]
    tables = {t.name: t for t in files.tables}
    for name in ("overall", "budgets", "variance"):
        assert [row[0] for row in tables[name].rows] == order, name
    assert list(dict.fromkeys(row[0] for row in tables["outcomes"].rows)) == order
    for name in ("cells", "sources", "suites", "source_matrix"):
        assert [c.title for c in tables[name].columns if c.title in order] == order, name
    assert all(row[3].value >= 0 for row in tables["contrasts"].rows)


@pytest.mark.slow
def test_figures_have_a_dark_and_a_narrow_drawing(written):
    out = written[2]
    for name in ("forest", "cells", "paired_differences", "outcomes"):
        wide, narrow = ((out / "figures" / f"{name}{kind}.svg").read_text() for kind in ("", "_narrow"))
        size = [float(re.search(r'<svg[^>]* width="([0-9.]+)pt"', text)[1]) for text in (wide, narrow)]
        assert size[0] > 700
        assert size[1] < 300
        for text in (wide, narrow):
            assert "@media screen and (prefers-color-scheme:dark)" in text
            assert re.search(r"style=\"[^\"]*(fill|stroke): #1a1a1a", text) or "#595959" in text


def test_sparse_cells_are_marked_and_stay(tmp_path):
    results = results_of(tmp_path, policy_rows("a", 12, 2, 0.5, 0))
    cells = table(results, "cells")
    assert len(cells.rows) == 4
    assert cells.sparse == {0, 1, 2, 3}
    assert "fewer than 10 scenarios" in " ".join(cells.all_notes())
    assert to_csv(cells).splitlines()[1].endswith("yes")


@pytest.mark.slow
@pytest.mark.parametrize("success", [True, pytest.param(False, marks=pytest.mark.nightly)])
def test_all_successes_and_all_failures(tmp_path, success):
    arms = [(policy, start) for policy in "ab" for start in ("recovery", "initial")]
    rows = [
        trial_row(n, k, success, policy=p, start=start)
        for n in range(12)
        for k in range(2)
        for p, start in arms
    ]
    results = results_of(tmp_path, rows)
    files = write_report(results, tmp_path / "out")
    rsr = by_policy(table(results, "overall"))["a"]["RSR %"]
    assert rsr.value == success
    assert (rsr.low, rsr.high) == (
        (pytest.approx(0.735, abs=1e-3), 1) if success else (0, pytest.approx(0.265, abs=1e-3))
    )
    paper = by_policy(table(results, "overall"))["a"]["RSR % (percentile bootstrap, as in the paper)"]
    assert (paper.low, paper.high) == (success, success)
    retention = by_policy(table(results, "overall"))["a"]["Retention"]
    assert retention.value == 1 if success else np.isnan(retention.value)
    pair = dict(
        zip(
            [c.title for c in table(results, "contrasts").columns],
            table(results, "contrasts").rows[0],
            strict=True,
        )
    )
    assert pair["Verdict"] == "too few differ"
    assert "To separate" not in pair
    assert "nan" not in _ENCODED.sub("", files.html.read_text()).lower()


@pytest.mark.slow
def test_a_single_scenario(tmp_path):
    results = results_of(tmp_path, [trial_row(0, k, k < 2) for k in range(5)])
    no_bare_nan(write_report(results, tmp_path / "out"))
    rsr = by_policy(table(results, "overall"))["alpha@1"]["RSR %"]
    assert rsr.value == 0.4
    assert np.isnan(rsr.low)
    assert "40.0 [n/a]" in to_markdown(table(results, "overall"))
    assert headline(results) == "Success of alpha: 40.0 % from recovery points."


@pytest.mark.slow
def test_no_valid_trial(tmp_path):
    results = results_of(tmp_path, [trial_row(n, outcome="sim_error") for n in range(3)])
    write_report(results, tmp_path / "out")
    row = by_policy(table(results, "overall"))["alpha@1"]
    assert np.isnan(row["RSR %"].value), "no rate over invalid trials alone"
    assert row["Invalid"] == 3
    assert np.isnan(row["RSR % without invalid"])
    found = table(results, "overall")
    assert "not defined here: Initial state %" in to_markdown(found)
    assert "RSR % without invalid" in to_markdown(found).splitlines()[-1]
    assert "n/a" in to_csv(found)


HOLES = {
    "nothing in common": [trial_row(n, policy="ab"[n > 2]) for n in range(6)],
    "not run on some cells": policy_rows("a", 9, 2, 0.5, 0)
    + [r for r in policy_rows("b", 9, 2, 0.5, 1) if r.stage == "Approach"],
    "intervention elsewhere": [trial_row(0), trial_row(1, policy="b", interventions=[["rollback", 1]])],
}


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("case", HOLES)
def test_no_file_shows_a_bare_nan(tmp_path, case):
    no_bare_nan(write_report(results_of(tmp_path, HOLES[case]), tmp_path / "out"))


def no_bare_nan(files):
    for path in (files.html, files.markdown, files.results):
        text = _ENCODED.sub("", path.read_text())
        assert not re.search(r"\b[+-]?nan\b", text, re.I), path.name


def test_unfinished_runs_are_pointed_out(tmp_path):
    rows = policy_rows("a", 6, 3, 0.5, 0)[:-1] + policy_rows("b", 5, 3, 0.5, 1)
    remarks = results_of(tmp_path, rows).remarks
    assert any("a: 1 of 6 scenarios have fewer than 3 trials (s005)" in r for r in remarks)
    assert any("b: no trials on 1 of 6 scenarios" in r for r in remarks)


def test_scheduled_trials(tmp_path):
    rows = [trial_row(0), trial_row(1), trial_row(1, 1)]
    assert by_policy(table(results_of(tmp_path, rows), "overall"))["alpha@1"]["RSR %"].value == 1
    results = results_of(tmp_path, rows, Options(draws=200, scheduled=2))
    assert by_policy(table(results, "overall"))["alpha@1"]["RSR %"].value == 0.75
    (card,) = [c for c in make_cards(results.recovery, {}, {}) if c.id == "s000"]
    assert card.marks[0].signs == "●–"
    assert card.marks[0].words == "solved 1 of 2 trials, 1 without a row"


def test_interventions_are_kept_out_of_the_comparison(tmp_path):
    direct = policy_rows("base", 20, 2, 0.4, 0)
    composite = [replace(r, interventions=[["rollback", 9]]) for r in policy_rows("monitored", 20, 2, 0.6, 1)]
    reversion = policy_rows("base", 20, 2, 0.6, 2, start="reversion", rewind_steps=30)
    results = results_of(tmp_path, direct + composite + reversion)
    assert results.recovery.arms == ("base",)
    rows = by_policy(table(results, "interventions"))
    assert set(rows) == {"monitored", "base, 30 steps back"}
    assert rows["monitored"]["rollback per trial"] == 1
    assert rows["monitored"]["Direct control"] == "base"
    two = direct + policy_rows("other", 20, 2, 0.4, 3) + composite
    assert any("--baseline does not say" in r for r in results_of(tmp_path, two).remarks)
    named = results_of(tmp_path, two, Options(draws=200, baseline="other"))
    assert by_policy(table(named, "interventions"))["monitored"]["Direct control"] == "other"
    with pytest.raises(RowsError, match="no policy 'nobody' in the logs"):
        results_of(tmp_path, direct, Options(baseline="nobody"))


@pytest.mark.slow
def test_markup_in_a_log_stays_text(tmp_path):
    bad = "<script>alert(1)</script> & | _$"
    results = results_of(tmp_path, [trial_row(n, policy=bad, instruction=bad, reason=bad) for n in range(2)])
    files = write_report(results, tmp_path / "out")
    assert "<script>alert" not in files.html.read_text()
    assert "&lt;script&gt;alert(1)" in files.html.read_text()
    assert r"\& $|$ \_\$" in (tmp_path / "out" / "tables" / "overall.tex").read_text()
    assert "\\|" in files.markdown.read_text()
    formula = results_of(tmp_path, [trial_row(n, policy="=1+1") for n in range(2)])
    assert "\n'=1+1," in to_csv(table(formula, "overall"))


def test_cards_are_sorted_by_disagreement(tmp_path):
    marks = ["11", "10", "00"]
    rows = [trial_row(n, 0, marks[n][p] == "1", policy="ab"[p]) for n in range(3) for p in range(2)]
    cards = make_cards(results_of(tmp_path, rows).recovery, {"s001": b"\x89PNG..."}, {})
    assert [(c.id, c.outcome_classes) for c in cards] == [
        ("s001", ("split",)),
        ("s000", ("all",)),
        ("s002", ("none",)),
    ]
    assert cards[0].frame.startswith("data:image/png;base64,")


@pytest.mark.slow
def test_command_on_logs_of_the_real_runner(tmp_path, capsys):
    """Rows as the vector env writes them, the set that was run, a video and a wrong set."""
    data = fake_dataset(tmp_path / "set", 6)
    runs = tmp_path / "runs"
    evaluate(data, runs / "trials.jsonl", trials=2, batch=2)
    evaluate(data, runs / "trials.jsonl", trials=2, batch=2, start="initial")
    video = tmp_path / "videos" / "toy_fake-push-left-000"
    video.mkdir(parents=True)
    (video / "eval_episode_0.mp4").write_bytes(b"video")
    out = tmp_path / "out"
    options = ["--draws=200", f"--scenarios={data}", f"--videos=push={tmp_path / 'videos'}"]
    assert main(["report", str(runs), f"--out={out}", *options]) == 0
    assert "push" in capsys.readouterr().out
    page = (out / "report.html").read_text()
    policy = re.search('http-equiv="Content-Security-Policy" content="([^"]+)"', page)[1]
    assert {"default-src 'none'", "base-uri 'none'", "form-action 'none'"} <= set(policy.split("; "))
    assert page.count('<li class="card"') == 6
    assert page.count("data:video/mp4;base64,dmlkZW8=") == 2, "on the first screen and on its card"
    other = fake_dataset(tmp_path / "other", 3)
    assert main(["report", str(runs), f"--out={out}", f"--scenarios={other}"]) == 2
    assert "3 scenario(s) that" in capsys.readouterr().err
    assert main(["report", str(runs), f"--out={out}", "--draws=5"]) == 2
    assert "take at least 100" in capsys.readouterr().err
