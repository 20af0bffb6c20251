"""Logs from anywhere: whatever a line holds, a row or one refusal that says where, what and the remedy."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import asdict, fields

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.analysis.escape import csv_text, latex, markdown, markdown_alt
from lerobot_roborecover.analysis.leaderboard import make_leaderboard
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.named_path import split_named
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.tables import Column, Table, to_csv, to_markdown
from lerobot_roborecover.cli.main import main
from lerobot_roborecover.logs.fields import FIELD_CHECKS, FieldProblem
from lerobot_roborecover.logs.merge import merge
from lerobot_roborecover.logs.row import TrialRow, make_row
from lerobot_roborecover.logs.schema import RowChecker, parse_json
from lerobot_roborecover.logs.trial_log import TrialLogError, read_log, read_trial_log
from tests.support.trial_rows import trial_row, write_log

GOOD = asdict(trial_row(0))
NAMES = [f.name for f in fields(TrialRow)]
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(), max_size=20),
    lambda inside: st.lists(inside, max_size=4) | st.dictionaries(st.text(max_size=5), inside, max_size=4),
    max_leaves=12,
)


def line_of(**changes) -> str:
    return json.dumps(GOOD | changes) + "\n"


def test_every_field_has_its_check():
    assert list(FIELD_CHECKS) == NAMES


@pytest.mark.slow
@settings(max_examples=400, deadline=None)
@given(st.sampled_from(NAMES), JSON)
def test_any_value_in_any_field_is_a_row_or_one_line_that_names_it(field, value):
    line = line_of(**{field: value}).encode()
    try:
        record = RowChecker().check(parse_json(line))
    except FieldProblem as err:
        text = str(err)
        assert "\n" not in text
        assert len(text) < 600
        together = field in ("outcome", "success", "horizon", "interventions")
        assert field in text or (together and ("'success'" in text or "'steps'" in text))
        assert "Correct the line" in text or "Upgrade" in text
        return
    row = TrialRow(**record)
    text = json.dumps(asdict(row), allow_nan=False)
    text.encode()
    assert json.loads(text) == asdict(row)
    assert row.steps <= row.horizon <= 100_000


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200) | JSON.map(lambda value: json.dumps(value).encode()))
def test_any_line_is_a_row_or_a_refusal(data):
    with pytest.raises(FieldProblem):
        RowChecker().check(parse_json(data))


HOSTILE = {
    "id null": ({"scenario_id": None}, "'scenario_id'"),
    "id number": ({"scenario_id": 3}, "'scenario_id'"),
    "id list": ({"scenario_id": ["s"]}, "'scenario_id'"),
    "id path": ({"scenario_id": "../x"}, "'scenario_id'"),
    "platform null": ({"platform": None}, "'platform'"),
    "split null": ({"split": None}, "'split'"),
    "surrogate": ({"policy": "a\ud800"}, "'policy'"),
    "not a number": ({"policy_s": float("nan")}, "'policy_s'"),
    "infinite": ({"sim_s": float("inf")}, "'sim_s'"),
    "beyond the horizon": ({"steps": 301}, "more than the horizon of 300 steps"),
    "no horizon": ({"horizon": 0}, "'horizon'"),
    "huge": ({"steps": 10**30}, "'steps'"),
    "schema true": ({"schema": True}, "trial schema True"),
    "control characters": ({"policy": "a\x1b[31m\nb"}, "'policy'"),
    "version": ({"versions": {"mujoco": None}}, "'versions.mujoco'"),
    "nested": ({"options": {"a": [[[[[[[[[[1]]]]]]]]]]}}, "'options'"),
    "not a date": ({"finished_at": "<b>"}, "'finished_at'"),
    "hash": ({"scenario_sha256": "abc"}, "'scenario_sha256'"),
    "intervention": ({"interventions": [3]}, "neither an object with 'kind' and 'step'"),
    "rollback": ({"interventions": [{"kind": "rollback", "step": 1, "undone": ""}]}, "interventions.undone"),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_what_was_tried_is_refused_with_file_line_field_and_remedy(tmp_path, case, capsys):
    changes, words = HOSTILE[case]
    path = tmp_path / "log.jsonl"
    path.write_text(line_of() + line_of(**{"trial": 1} | changes))
    with pytest.raises(TrialLogError) as caught:
        read_trial_log(path)
    text = str(caught.value)
    assert text.startswith(f"{path}, line 2: ")
    assert words in text
    assert "Correct the line" in text or "Upgrade" in text
    out = f"--out={tmp_path / 'out'}"
    for command in (
        ["report", str(path), out],
        ["compare", str(path)],
        ["merge", str(path), f"{out}.jsonl"],
    ):
        assert main(command) == 2
        assert capsys.readouterr().err.count("\n") == 1


DEEP = b"[" * 100_000 + b"]" * 100_000 + b"\n"


def test_one_bad_log_does_not_take_a_leaderboard_down(tmp_path):
    good = [trial_row(n, k, n % 2 == 0) for n in range(8) for k in range(2)]
    write_log(tmp_path / "good.jsonl", good)
    (tmp_path / "deep.jsonl").write_bytes(DEEP)
    (tmp_path / "text.jsonl").write_bytes(b"\xff\xfe\n")
    for name, (changes, _) in HOSTILE.items():
        (tmp_path / f"{name}.jsonl").write_text(line_of(**changes))
    found = make_leaderboard(tmp_path, Options(draws=100))
    assert [e.policy for board in found.boards for e in board.entries] == ["alpha@1"]
    assert {name for name, _ in found.refused} == {
        "deep.jsonl", "text.jsonl", *(f"{n}.jsonl" for n in HOSTILE)
    }  # fmt: skip
    assert all(", line 1: " in reason for _, reason in found.refused)
    assert main(["leaderboard", str(tmp_path), f"--out={tmp_path / 'out'}", "--draws=100"]) == 1


def test_a_line_without_end_is_not_taken_into_memory(tmp_path, monkeypatch):
    monkeypatch.setattr("lerobot_roborecover.logs.trial_log.MAX_LINE_BYTES", 2000)
    path = tmp_path / "log.jsonl"
    path.write_text(line_of() + "x" * 5000)
    with pytest.raises(TrialLogError, match="line 2: longer than 2000 bytes"):
        read_trial_log(path)


def test_rows_share_what_they_repeat(tmp_path):
    rows = [trial_row(n, versions={"mujoco": "3.3.2"}) for n in range(3)]
    first, second, _ = read_trial_log(write_log(tmp_path / "log.jsonl", rows))
    assert first.options is second.options
    assert first.versions is second.versions
    assert first.platform is second.platform
    assert first.policy is second.policy
    assert not hasattr(first, "__dict__")


def test_options_that_only_look_alike_stay_apart(tmp_path):
    values = [1, True, 1.0, "1", "True"]
    rows = [trial_row(0, k, options={"x": v}, config_hash=str(k)) for k, v in enumerate(values)]
    found = [row.options["x"] for row in read_trial_log(write_log(tmp_path / "log.jsonl", rows))]
    assert [(type(v), v) for v in found] == [(type(v), v) for v in values]


def test_what_an_error_message_holds_cannot_make_a_row_unreadable(tmp_path):
    from lerobot_roborecover.logs.row import EvalProtocol
    from lerobot_roborecover.logs.trial_log import TrialLog
    from lerobot_roborecover.scenario import Outcome
    from tests.support.factories import fake_scenario

    row = make_row(
        fake_scenario(0), EvalProtocol("recovery", 0, "a\x07\udc80b", 1, None), dataset="/x\udc80",
        dataset_revision=None, trial=0, noise="per_trial", batch_size=1, outcome=Outcome.SIM_ERROR,
        reason="cannot open \udcff" + "x" * 200_000, steps=0, handoff=None, sim_s=0, policy_s=0,
        actions_sha256="",
    )  # fmt: skip
    log = TrialLog(tmp_path / "log.jsonl")
    log.append(row)
    log.close()
    assert read_trial_log(log.path)[0].policy == "a\ufffd\ufffdb"


def test_merge_says_that_a_line_was_cut_off(tmp_path, capsys):
    path = write_log(tmp_path / "log.jsonl", [trial_row(n) for n in range(3)])
    path.write_text(path.read_text()[:-30])
    assert main(["merge", str(path), f"--out={tmp_path / 'merged.jsonl'}"]) == 0
    shown = capsys.readouterr()
    assert "2 trials of 2 scenarios" in shown.out
    assert f"note: {path}: its last line was cut off" in shown.err
    assert merge([path], tmp_path / "again.jsonl").remarks == read_log(path).remarks


def test_revisions_that_differ_under_equal_content_are_said(tmp_path):
    rows = [trial_row(0), trial_row(0, policy="b", dataset_revision="r2")]
    remarks = read_study([str(write_log(tmp_path / "log.jsonl", rows))]).remarks
    (found,) = [r for r in remarks if "dataset_revision" in r]
    assert "made-up at r1" in found
    assert "made-up at r2" in found
    assert "log.jsonl, line 2" in found


def test_a_name_ends_at_the_first_equals_sign_unless_the_path_exists(tmp_path):
    folder = tmp_path / "lr=0.1"
    write_log(folder / "trials.jsonl", [trial_row(0)])
    assert split_named(f"mine={folder}") == ("mine", str(folder))
    assert split_named(str(folder)) == ("", str(folder))
    assert split_named("plain") == ("", "plain")
    assert read_study([f"mine={folder}"]).policies == ("mine",)
    assert read_study([str(folder)]).policies == ("alpha@1",)
    with pytest.raises(RowsError, match="name before the first '=' is empty"):
        split_named("=x")
    with pytest.raises(TrialLogError, match="what comes before the first '=' is taken for the policy's name"):
        read_study([str(tmp_path / "lr=0.2" / "trials.jsonl")])


BAD = ["=HYPERLINK(1)", "+1", "-1+1", "@x", "\t=1", '"=1', " =1"]


@pytest.mark.parametrize("name", BAD)
def test_no_cell_of_a_table_is_a_formula(name):
    table = Table("t", "T", (Column("Policy"), Column(name, "count")), ((name, 1),))
    for row in csv.reader(io.StringIO(to_csv(table))):
        assert all(not cell.startswith(("=", "+", "-", "@", "\t")) for cell in row)
    assert csv_text("plain") == "plain"
    assert csv_text("3-1") == "3-1"


def test_markdown_and_latex_show_text_as_it_is():
    assert markdown("<script>x</script>") == "&lt;script&gt;x&lt;/script&gt;"
    assert markdown("[a](http://b)") == r"[a\](http://b)"
    assert markdown_alt("a] (b) [c") == r"a\] (b) \[c"
    assert markdown("50.0 [25.0, 75.0], a_b, -0.5") == "50.0 [25.0, 75.0], a_b, -0.5"
    assert markdown("# a") == r"\# a"
    assert markdown("1. a") == r"1\. a"
    assert markdown("- a") == r"\- a"
    assert markdown("*a* _b_ `c` | d ~~e~~ $f$") == r"\*a\* \_b\_ \`c\` \| d \~\~e\~\~ \$f\$"
    assert markdown("&lt;") == "&amp;lt;"
    assert markdown("a & b\n\nc") == "a & b c"
    assert latex("a_b|<>\\input{x}") == r"a\_b$|$$<$$>$\textbackslash{}input\{x\}"
    assert "<" not in to_markdown(Table("t", "<b>", (Column("<i>"),), (("<u>",),), ("<s>",)))
