"""The paper's release to scenario datasets and back: nothing lost, nothing padded, and bad input named."""

from __future__ import annotations

import hashlib
import json
import os

import numpy as np
import pytest

from lerobot_roborecover.datasets import load_scenarios, write_scenarios
from lerobot_roborecover.datasets.release.convert import read_release
from lerobot_roborecover.datasets.release.export import export_release
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.scenario import ScenarioError, Source
from tests.support.conversion_scripts import script
from tests.support.release_files import (
    files_of,
    libero_record,
    read_rows,
    robotwin_record,
    task_name,
    write_release,
    write_table,
)

convert = script("roborecover_release").main


@pytest.fixture
def release(tmp_path):
    """Twelve records of both platforms, both prefix-length conventions and both action types."""
    records = {
        "libero": {
            "train": [libero_record(i) for i in range(4)],
            "test": [libero_record(i, extra_action=False) for i in range(10, 13)],
        },
        "robotwin": {
            "train": [robotwin_record(i, ee=i == 1) for i in range(3)],
            "test": [robotwin_record(i) for i in range(10, 12)],
        },
    }
    return write_release(tmp_path / "release", records)


def edit(root, platform, split, row, *, cells=None, record=None, text=None, rehash=True):
    """Changes one record and its row as someone who keeps the hashes right would."""
    rows = read_rows(root, platform, split)
    path = root / rows[row]["path"]
    if record or text:
        value = json.loads(path.read_text())
        if record:
            record(value)
        path.write_text(text(json.dumps(value)) if text else json.dumps(value))
        if rehash:
            rows[row]["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    rows[row].update(cells or {})
    write_table(root, platform, split, rows)


def test_every_record_becomes_a_scenario_with_its_exact_actions(release, tmp_path):
    assert convert([str(release), "--out", str(tmp_path / "out")]) == 0
    for platform, count in (("libero", 7), ("robotwin", 5)):
        scenarios = load_scenarios(tmp_path / "out" / platform)
        assert len(scenarios) == count
        for split in ("train", "test"):
            for row in read_rows(release, platform, split):
                record = json.loads((release / row["path"]).read_text())
                scenario = scenarios[row["sample_id"]]
                assert scenario.prefix.tobytes() == np.array(record["actions"], np.float64).tobytes()
                assert (scenario.split, scenario.stage, scenario.deviation) == (
                    split, record["s_stage"], record["d_stage"],
                )  # fmt: skip
                assert scenario.reset.seed == record["seed"]
                assert scenario.fingerprint is None
    libero = load_scenarios(tmp_path / "out" / "libero")
    assert libero[0].reset.init_state_index == 0
    assert libero[0].reset.settle_steps == 10
    assert (
        libero[0].task.name
        == "pick_up_the_black_bowl_between_the_plate_and_the_ramekin_and_place_it_on_the_plate"
    )
    assert [libero[i].task.horizon for i in (0, 1)] == [220, 520]
    robotwin = load_scenarios(tmp_path / "out" / "robotwin")
    assert [s.task.horizon for s in robotwin[:2]] == [800, 1500]
    assert {s.task.suite for s in robotwin} == {"demo_clean"}
    assert [s.prefix.shape[1] for s in robotwin[:2]] == [14, 16]
    assert robotwin[0].task.instruction == "Put the red block on the gréen one."


@pytest.mark.parametrize(
    ("dump", "newline"),
    [
        ({}, "\n"),
        ({"indent": 4}, "\r\n"),
        ({"indent": 2, "ensure_ascii": False}, "\n"),
        ({"separators": (",", ":"), "ensure_ascii": False}, "\n"),
    ],
)
def test_export_gives_every_file_back_byte_for_byte(tmp_path, dump, newline):
    whole = libero_record(2)
    whole["actions"] = [[int(v) if v in (0, 1, -1) else v for v in row] for row in whole["actions"]]
    whole["actions"][12][3] = -0.0
    # A style that no option of json.dumps gives.
    odd = json.dumps(libero_record(3)).replace('"seed": 7', '"seed":  7') + "\n"
    records = {
        "libero": {"train": [libero_record(0), odd], "test": [whole]},
        "robotwin": {"test": [robotwin_record(0), robotwin_record(1, ee=True)]},
    }
    release = write_release(tmp_path / "release", records, newline, **dump)
    assert convert([str(release), "--out", str(tmp_path / "out")]) == 0
    datasets = [str(tmp_path / "out" / p) for p in ("libero", "robotwin")]
    assert convert([*datasets, "--export", "--out", str(tmp_path / "back")]) == 0
    assert files_of(tmp_path / "back") == files_of(release)


def test_actions_beyond_the_recovery_point_are_kept_but_not_replayed(release, tmp_path):
    edit(release, "libero", "train", 0, cells={"replay_prefix_steps": "29"})
    scenarios = read_release(release, "libero").scenarios
    assert len(scenarios[0].prefix) == 29
    export_release(scenarios, tmp_path / "back")
    path = "libero/train/libero_train_0000.json"
    assert files_of(tmp_path / "back")[path] == (release / path).read_bytes()


def test_sources_follow_the_name_and_a_table_overrules_it(release, tmp_path):
    scenarios = read_release(release, "libero").scenarios[:3]
    assert [(s.source, s.source_policy) for s in scenarios] == [
        (Source.PERTURBED, "pi05"),
        (Source.NATURAL, "being_h05"),
        (Source.HUMAN, "human_teleop"),
    ]
    table = tmp_path / "sources.csv"
    table.write_text("name,source,source_policy\nbeing_h05,perturbed,Being-H0.5\n")
    assert convert([str(release), "--out", str(tmp_path / "out"), "--sources", str(table)]) == 0
    scenario = load_scenarios(tmp_path / "out" / "libero")[1]
    assert (scenario.source, scenario.source_policy) == (Source.PERTURBED, "Being-H0.5")
    table.write_text("name,source,source_policy\nbeing_h05,alien,x\n")
    assert convert([str(release), "--out", str(tmp_path / "out2"), "--sources", str(table)]) == 2


def change(**fields):
    return {"record": lambda r: r.update(fields)}


def drop(field):
    return {"record": lambda r: r.pop(field)}


def action(value, at=(12, 3)):
    return {"record": lambda r: r["actions"][at[0]].__setitem__(at[1], value)}


BAD_RECORDS = {
    "nan": (action(float("nan")), ["NaN", "finite"]),
    "infinite": ({"text": lambda t: t.replace("1.0,", "1e999,", 1)}, ["not usable JSON", "inf"]),
    "string": (action("0.1"), ["actions[12][3]", "'0.1'", "not a number"]),
    "boolean": (action(True), ["actions[12][3]", "True"]),
    "null": (action(None), ["actions[12][3]"]),
    "ragged": ({"record": lambda r: r["actions"][12].pop()}, ["actions[12]", "6 numbers"]),
    "wide": (
        {"record": lambda r: [a.append(0.0) for a in r["actions"]]},
        ["actions", "width 8", "7 numbers"],
    ),
    "huge": (action(1e300), ["the limit is 1000"]),
    "no actions": (change(actions=[]), ["actions"]),
    "missing": (drop("seed"), ["field seed", "missing"]),
    "extra": (change(colour="red"), ["'colour'", "--keep-extra"]),
    "task": (change(task_id=10), ["task_id", "0 to 9"]),
    "suite": (change(task_suite_name="libero_99"), ["task_suite_name", "libero_99"]),
    "stage": (change(s_stage="Lift"), ["stage", "'Lift'", "Approach"]),
    "step": (change(annotated_step=3), ["annotated_step", "3"]),
    "state": (change(initial_state={"xyz": [0, 0, 0]}), ["initial_state", "quat[4]"]),
    "seed": (change(seed=-1), ["seed", "-1"]),
    "twice": ({"text": lambda t: t.replace('"seed": 7', '"seed": 7, "seed": 8')}, ["'seed'", "twice"]),
    "truncated": ({"text": lambda t: t[:200]}, ["not usable JSON"]),
    "list": ({"text": lambda t: "[]"}, ["list", "not an object"]),
    "long name": (change(model_name="x" * 300), ["source_policy", "256"]),
    "half a pair": ({"text": lambda t: t.replace("OOD_data", "\\ud800")}, ["not usable JSON", "surrogates"]),
    "infinite note": (
        {
            "record": lambda r: r.update(data_type=1),
            "text": lambda t: t.replace('"data_type": 1', '"data_type": 1e999'),
        },
        ["not usable JSON", "inf"],
    ),
    "other label": (change(d_stage="Scene Change"), ["column d_stage", "'Scene Change'"]),
    "pickle": ({"text": lambda t: "\x80\x04."}, ["not usable JSON"]),
    "episode": (change(episode_idx=77), ["field episode_idx: 77", "init states 0 to 49"]),
    "no rotation": (
        {"record": lambda r: r["initial_state"].update(quat=[0, 0, 0, 0])},
        ["field initial_state", "quaternion has norm 0, not 1"],
    ),
    "contradiction": (
        change(error_category="S:Place;D:Scene Change"),
        ["field error_category: 'S:Place;D:Scene Change' contradicts s_stage 'Contact'"],
    ),
    "escape": (change(task_description="put \x1b[31m it"), ["field task_description", "control character"]),
    "right to left": (change(model_name="pi05\u202e"), ["field model_name", "control character"]),
    "escape in a note": (change(data_type=["a", {"b\x00": 1}]), ["field 'data_type'", "control character"]),
    "deep": (
        {
            "record": lambda r: r.update(data_type=1),
            "text": lambda t: t.replace('"data_type": 1', f'"data_type": {"[" * 900}{"]" * 900}'),
        },
        ["nested more than 64 deep"],
    ),
}
BAD_ROBOTWIN = {
    "success": (change(success="false"), ["field success: 'false' is not true, false or null"]),
    "total": (
        change(total_steps=12),
        ["field total_steps: 12, before the recovery point", "annotated_step = 20"],
    ),
    "no rotation": (
        {"record": lambda r: r["initial_state"].update(left_endpose=[0.0] * 7)},
        ["field initial_state", "a rotation in left_endpose: its quaternion has norm 0, not 1"],
    ),
    "contradiction": (change(error_type="S:Move;D:Wrong Pose"), ["field error_type", "contradicts s_stage"]),
    "escape": (change(instruction="Put it.\n"), ["field instruction", "control character"]),
}


@pytest.mark.parametrize("case", BAD_RECORDS)
def test_a_bad_record_is_named_by_file_and_field_and_the_rest_goes_on(release, tmp_path, capsys, case):
    how, words = BAD_RECORDS[case]
    edit(release, "libero", "train", 1, **how)
    assert convert([str(release), "--out", str(tmp_path / "out"), "--platform", "libero"]) == 1
    said = capsys.readouterr().err
    assert all(word in said for word in ["libero/train/libero_train_0001.json", *words]), said
    found = load_scenarios(tmp_path / "out" / "libero")
    assert len(found) == 6
    assert "libero_train_0001" not in found
    report = json.loads((tmp_path / "out" / "libero" / FOLDER / "conversion.json").read_text())
    assert [r["sample_id"] for r in report["refused"]] == ["libero_train_0001"]


@pytest.mark.parametrize("case", BAD_ROBOTWIN)
def test_a_bad_robotwin_record_is_named_by_field_without_a_replay(release, case):
    how, words = BAD_ROBOTWIN[case]
    edit(release, "robotwin", "train", 1, **how)
    result = read_release(release, "robotwin")
    assert len(result.scenarios) == 4
    (failure,) = map(str, result.failures)
    assert all(word in failure for word in ["robotwin/train/robotwin_train_0001.json", *words]), failure


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-32", "latin-1"])
def test_a_record_in_another_encoding_is_refused_and_the_rest_goes_on(release, tmp_path, capsys, encoding):
    path = release / "robotwin/train/robotwin_train_0001.json"
    path.write_bytes(json.dumps(json.loads(path.read_text()), ensure_ascii=False).encode(encoding))
    edit(release, "robotwin", "train", 1, cells={"sha256": hashlib.sha256(path.read_bytes()).hexdigest()})
    assert convert([str(release), "--out", str(tmp_path / "out")]) == 1
    assert "robotwin_train_0001.json: not usable JSON" in capsys.readouterr().err
    assert len(load_scenarios(tmp_path / "out" / "robotwin")) == 4


def test_notes_of_several_lines_are_kept(release, tmp_path):
    edit(release, "robotwin", "train", 1, record=lambda r: r["annotation_meta"].update(note="one\n\ttwo"))
    scenarios = read_release(release, "robotwin").scenarios
    assert len(scenarios) == 5
    assert scenarios[1].provenance["release"]["record"]["annotation_meta"]["note"] == "one\n\ttwo"


BAD_ROWS = {
    "path above": ({"path": "../secret.json"}, ["column path", "'../secret.json'", "inside the release"]),
    "path absolute": ({"path": "/etc/hostname"}, ["column path", "/etc/hostname"]),
    "path windows": ({"path": "..\\secret.json"}, ["column path"]),
    "no file": ({"path": "libero/train/none.json"}, ["libero/train/none.json", "does not exist"]),
    "hash": ({"sha256": "0" * 64}, ["SHA-256", "column sha256", "Fetch it again"]),
    "no hash": ({"sha256": "abc"}, ["column sha256", "'abc'"]),
    "count": ({"actions": "29", "replay_prefix_steps": "29"}, ["column actions", "'29'", "'30'"]),
    "steps": ({"replay_prefix_steps": "31"}, ["column replay_prefix_steps", "31", "never padded"]),
    "steps text": ({"replay_prefix_steps": "-3"}, ["column replay_prefix_steps", "'-3'"]),
    "task": ({"task_name": "libero_10/9"}, ["column task_name", "libero_10/9"]),
    "id": ({"sample_id": "../x"}, ["column sample_id", "'../x'"]),
}


@pytest.mark.parametrize("case", BAD_ROWS)
def test_a_bad_row_is_named_and_the_rest_goes_on(release, tmp_path, case):
    cells, words = BAD_ROWS[case]
    (tmp_path / "secret.json").write_text(json.dumps(libero_record(1)))
    edit(release, "libero", "train", 1, cells=cells)
    result = read_release(release, "libero")
    assert len(result.scenarios) == 6
    said = "\n".join(map(str, result.failures))
    assert all(word in said for word in words), said


def test_ids_in_both_splits_or_twice_in_one_are_refused_on_both_sides(release):
    for split, row in (("train", 0), ("test", 0)):
        edit(release, "libero", split, row, cells={"sample_id": "same"})
    for row in (1, 2):
        edit(release, "libero", "train", row, cells={"sample_id": "twice"})
    result = read_release(release, "libero")
    assert [s.id for s in result.scenarios] == ["libero_train_0003", "libero_test_0001", "libero_test_0002"]
    said = [str(f) for f in result.failures]
    assert sum("is in train and in test" in s for s in said) == 2
    assert sum("'twice' is in 2 rows" in s for s in said) == 2


def test_the_same_scenario_under_another_id_in_the_other_split_is_refused(release):
    source = json.loads((release / "libero/train/libero_train_0000.json").read_text())
    row = {
        "task_name": task_name("libero", source),
        "s_stage": source["s_stage"],
        "d_stage": source["d_stage"],
    }
    edit(release, "libero", "test", 0, cells=row, text=lambda _: json.dumps(source))
    result = read_release(release, "libero")
    assert len(result.scenarios) == 5
    assert {f.sample_id for f in result.failures} == {"libero_train_0000", "libero_test_0000"}
    assert all("in train and in test" in str(f) for f in result.failures)


def test_a_file_without_a_row_and_a_link_out_are_refused(release, tmp_path):
    (release / "libero/train/extra.json").write_text(json.dumps(libero_record(9)))
    secret = tmp_path / "secret.json"
    target = release / "libero/train/libero_train_0002.json"
    os.replace(target, secret)
    target.symlink_to(secret)
    said = [str(f) for f in read_release(release, "libero").failures]
    assert len(said) == 2
    assert any("extra.json" in s and "no row" in s for s in said)
    assert any("libero_train_0002.json" in s and "leaves the release" in s for s in said)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sample_id,path\na,b\n", ["header", "sha256"]),
        ("", ["header"]),
        ("\x00\x01", ["header"]),
        (None, ["splits/libero_train.csv"]),
    ],
)
def test_a_release_without_usable_tables_is_refused_as_a_whole(release, tmp_path, capsys, text, words):
    table = release / "splits" / "libero_train.csv"
    if text is None:
        for path in (release / "splits").iterdir():
            path.unlink()
    else:
        table.write_text(text)
    assert convert([str(release), "--out", str(tmp_path / "out"), "--platform", "libero"]) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in words), said
    assert not (tmp_path / "out").exists()


def test_extra_fields_are_kept_when_asked_and_come_back(release, tmp_path):
    edit(release, "libero", "train", 1, **change(colour={"r": 1}))
    assert (
        convert([str(release), "--out", str(tmp_path / "out"), "--platform", "libero", "--keep-extra"]) == 0
    )
    scenario = load_scenarios(tmp_path / "out" / "libero")["libero_train_0001"]
    assert scenario.provenance["release"]["record"]["colour"] == {"r": 1}
    assert convert([str(tmp_path / "out" / "libero"), "--export", "--out", str(tmp_path / "back")]) == 0
    path = "libero/train/libero_train_0001.json"
    assert files_of(tmp_path / "back")[path] == (release / path).read_bytes()


@pytest.mark.parametrize("path", ["../evil.json", "/tmp/evil.json", "a/../../evil.json"])
def test_an_export_writes_nothing_outside_its_folder(release, tmp_path, path):
    scenarios = read_release(release, "libero").scenarios
    scenarios[0].provenance["release"]["split_row"]["path"] = path
    write_scenarios(tmp_path / "set", scenarios)
    before = files_of(tmp_path)
    with pytest.raises(ScenarioError, match="column path"):
        export_release(load_scenarios(tmp_path / "set"), tmp_path / "inner" / "back")
    assert files_of(tmp_path) == before


def test_only_converted_scenarios_can_be_exported(release, tmp_path):
    scenario = read_release(release, "libero").scenarios[0]
    for provenance in ({}, {"release": {}}, {"release": {"json": {"zlib": "!"}}}, {"release": 3}):
        object.__setattr__(scenario, "provenance", provenance)
        with pytest.raises(ScenarioError, match="only converted scenarios"):
            export_release([scenario], tmp_path / "back")
    assert not (tmp_path / "back").exists()
