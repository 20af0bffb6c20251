"""The paper's release as its users have it: tables and archive apart, single examples, what goes wrong."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.datasets import load_scenarios, write_scenarios
from lerobot_roborecover.datasets.release.convert import read_release
from lerobot_roborecover.datasets.release.fixtures import check_fixtures, released_fixtures
from lerobot_roborecover.datasets.release.previous import compare_with_earlier, read_converted, read_earlier
from lerobot_roborecover.datasets.release.record import Reading
from lerobot_roborecover.platforms.libero.catalog import libero_tasks
from lerobot_roborecover.scenario import Pose, Reset, ScenarioError, Task
from tests.support.conversion_scripts import script
from tests.support.factories import fake_scenario
from tests.support.release_files import files_of, libero_record, robotwin_record, write_release

convert = script("roborecover_release").main
OTHER_WORDS = "Pick the akita black bowl between the plate and the ramekin and place it on the plate"
PROMPT = "pick up the black bowl between the plate and the ramekin and place it on the plate"


def record(**fields):
    return {**libero_record(0), "task_description": PROMPT, **fields}


@pytest.fixture
def release(tmp_path):
    """One record of each platform."""
    return write_release(
        tmp_path / "release", {"libero": {"test": [record()]}, "robotwin": {"test": [robotwin_record(0)]}}
    )


def written(tmp_path, value, *, name="example.json"):
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(value if isinstance(value, str) else json.dumps(value))
    return path


# --- instructions


def test_policies_are_prompted_as_the_evaluators_do_and_both_wordings_are_kept(tmp_path, capsys):
    records = [
        record(task_description=OTHER_WORDS),
        record(task_description=OTHER_WORDS, episode_idx=1),
        record(episode_idx=2),
    ]
    release = write_release(tmp_path / "release", {"libero": {"test": records}})
    assert convert([str(release), "--out", str(tmp_path / "out")]) == 0
    scenarios = load_scenarios(tmp_path / "out" / "libero")
    assert {s.task.instruction for s in scenarios} == {PROMPT}
    kept = [s.provenance["release"]["record"]["task_description"] for s in scenarios]
    assert kept == [OTHER_WORDS, OTHER_WORDS, PROMPT]
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert all(words in said[0] for words in ("2 record(s) of libero_spatial/0", OTHER_WORDS, PROMPT))


@pytest.mark.libero
def test_the_prompt_of_every_task_is_the_one_of_libero_s_benchmark():
    from lerobot_roborecover.platforms.libero.assets import find_assets, quiet_import
    from lerobot_roborecover.platforms.libero.catalog import libero_instruction

    quiet_import(find_assets())
    from libero.libero.benchmark import grab_language_from_filename

    names = [name for tasks in libero_tasks().values() for name in tasks]
    assert [libero_instruction(n) for n in names] == [grab_language_from_filename(f"{n}.bddl") for n in names]


# --- tables and data apart


@pytest.mark.parametrize("named", ["clone", "clone/splits"])
def test_tables_and_data_may_be_two_folders(release, tmp_path, named):
    shutil.move(release / "splits", tmp_path / "clone" / "splits")
    arguments = [str(release), "--splits", str(tmp_path / named), "--out", str(tmp_path / "out")]
    assert convert(arguments) == 0
    datasets = [str(tmp_path / "out" / p) for p in ("libero", "robotwin")]
    assert convert([*datasets, "--export", "--out", str(tmp_path / "back")]) == 0
    assert files_of(tmp_path / "back") == files_of(release) | {
        f"splits/{n}": d for n, d in files_of(tmp_path / "clone" / "splits").items()
    }


def test_folders_may_be_links_and_a_file_may_not(release, tmp_path):
    before = files_of(release)
    for name in ("splits", "libero", "robotwin/test"):
        (tmp_path / "far" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.move(release / name, tmp_path / "far" / name)
        (release / name).symlink_to(tmp_path / "far" / name)
    assert convert([str(release), "--out", str(tmp_path / "out")]) == 0
    datasets = [str(tmp_path / "out" / p) for p in ("libero", "robotwin")]
    assert convert([*datasets, "--export", "--out", str(tmp_path / "back")]) == 0
    assert files_of(tmp_path / "back") == before
    target = tmp_path / "far/libero/test/libero_test_0000.json"
    os.replace(target, tmp_path / "secret.json")
    target.symlink_to(tmp_path / "secret.json")
    (failure,) = read_release(release, "libero").failures
    assert "leaves the release" in str(failure)


def test_half_a_release_says_where_the_other_half_is(release, tmp_path, capsys):
    shutil.move(release / "splits", tmp_path / "clone" / "splits")
    for source, words in (
        (tmp_path / "clone", ["none of the 1 files", "archive", "--splits"]),
        (release, ["no splits/libero_*.csv", "--splits", "git clone"]),
    ):
        assert convert([str(source), "--out", str(tmp_path / "out")]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert all(word in said for word in words), said
    assert not (tmp_path / "out").exists()


# --- single files


def test_single_examples_are_converted_without_a_table_and_come_back(tmp_path, capsys):
    libero = written(tmp_path, record(), name="train/a-libero.json")
    robotwin = written(tmp_path, json.dumps(robotwin_record(3), indent=2), name="b-robotwin.json")
    assert convert([str(libero), str(robotwin), "--out", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().err.count("no split table") == 2
    (one,), (other,) = (load_scenarios(tmp_path / "out" / p) for p in ("libero", "robotwin"))
    assert (one.id, one.split, len(one.prefix)) == ("a-libero", "train", 30)
    assert (other.id, other.split, len(other.prefix)) == ("b-robotwin", "test", 20)
    datasets = [str(tmp_path / "out" / p) for p in ("libero", "robotwin")]
    assert convert([*datasets, "--export", "--out", str(tmp_path / "back")]) == 0
    back = files_of(tmp_path / "back")
    assert back["libero/train/a-libero.json"] == libero.read_bytes()
    assert back["robotwin/test/b-robotwin.json"] == robotwin.read_bytes()
    assert convert([str(tmp_path / "back"), "--out", str(tmp_path / "again")]) == 0


def test_two_single_files_of_one_name_are_one_scenario_and_a_refusal(tmp_path, capsys):
    paths = [written(tmp_path, record(episode_idx=i), name=f"{i}/same.json") for i in range(2)]
    assert convert([*map(str, paths), "--out", str(tmp_path / "out")]) == 1
    assert "another file is named same.json" in capsys.readouterr().err
    assert len(load_scenarios(tmp_path / "out" / "libero")) == 1


# --- refusals for users who downloaded the data


def edited(**fields):
    return lambda r: r.update(fields)


BAD = {
    "1e999": (None, lambda t: t.replace("-1.0]", "1e999]", 1), ["1e999", "infinite"]),
    "2000": (lambda r: r["actions"][12].__setitem__(3, 2000.0), None, ["[12][3]: 2000", "limit is 1000"]),
    "stage": (edited(s_stage="Lift"), None, ["field s_stage", "'Lift'", "Approach, Contact, Move, Place"]),
    "type": (edited(d_stage="Dropped"), None, ["field d_stage", "'Dropped'", "Scene Change"]),
    "task": (edited(task_id=12), None, ["task_id: 12", "0 to 9"]),
    "cut": (None, lambda t: t[:2000], ["ends in the middle of its record", "2000 bytes"]),
    "nan": (lambda r: r["actions"][3].__setitem__(0, float("nan")), None, ["NaN", "finite"]),
    "ragged": (lambda r: r["actions"][12].pop(), None, ["actions[12]: 6 numbers"]),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
@pytest.mark.parametrize("table", [True, False])
def test_a_bad_record_has_a_remedy_for_its_user(tmp_path, capsys, case, table):
    change, text, words = BAD[case]
    value = record()
    if change:
        change(value)
    body = text(json.dumps(value)) if text else json.dumps(value)
    if table:
        release = write_release(tmp_path / "release", {"libero": {"test": [record()]}})
        path = release / "libero/test/libero_test_0000.json"
        old, new = (hash_of(data) for data in (path.read_bytes(), body.encode()))
        path.write_text(body)
        rows = release / "splits/libero_test.csv"
        rows.write_text(rows.read_text().replace(old, new))
        source, remedy = release, "fetching it again changes nothing: tell those who published"
    else:
        source, remedy = written(tmp_path, body), "Fetch the file again"
    assert convert([str(source), "--out", str(tmp_path / "out")]) == 2
    said, *rest = capsys.readouterr().err.splitlines()
    assert all(word in said for word in [*words, remedy]), said
    assert "ecord the rollout" not in said
    # All of it was refused: that is status 2, and no word of scenarios that could be used.
    assert rest == ["roborecover_release: libero: nothing was converted, all of its 1 records were refused"]


def hash_of(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def test_one_platform_refused_whole_and_another_converted_is_status_1(tmp_path, capsys):
    records = {"libero": {"test": [record(task_id=12)]}, "robotwin": {"test": [robotwin_record(0)]}}
    release = write_release(tmp_path / "release", records)
    assert convert([str(release), "--out", str(tmp_path / "out")]) == 1
    printed = capsys.readouterr()
    assert "libero: nothing was converted" in printed.err
    assert "0 scenarios" not in printed.out + printed.err
    assert os.listdir(tmp_path / "out") == ["robotwin"]


def test_a_missing_checkout_is_refused_in_this_script_s_own_words(release, tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("ROBOTWIN_ROOT", raising=False)
    assert convert([str(release), "--out", str(tmp_path / "out"), "--fingerprint"]) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in ("--robotwin-root FOLDER", "--platform libero"))
    assert "--env." not in said


# --- seeds and fixtures


def test_another_seed_than_the_release_s_is_refused_unless_asked_for(tmp_path, capsys):
    release = write_release(tmp_path / "release", {"libero": {"test": [record(seed=8)]}})
    assert convert([str(release), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in ("field seed: 8", "env.seed(7)", "--any-seed"))
    assert convert([str(release), "--out", str(tmp_path / "out"), "--any-seed"]) == 0
    assert load_scenarios(tmp_path / "out" / "libero")[0].reset.seed == 8
    # A dataset that was converted before is asked the same when it is replayed again.
    (failure,) = read_converted(tmp_path / "out" / "libero").failures
    assert "field seed: 8" in str(failure)
    assert not read_converted(tmp_path / "out" / "libero", Reading(any_seed=True)).failures


CADDY = "desk_caddy_1_main"
NAME = "STUDY_SCENE1_pick_up_the_book_and_place_it_in_the_back_compartment_of_the_caddy"


def caddy_scenario(**reset):
    scenario = fake_scenario(0)
    task = Task("libero", "libero_10", NAME, "pick up the book", 520)
    return replace(
        scenario, task=task, prefix=np.zeros((10, 7)), reset=Reset(init_state_index=30, **reset),
        fingerprint=None,
    )  # fmt: skip


class Drawn:
    """Stands for a simulator whose reset draws the caddy's place from the seed."""

    def __init__(self):
        self.x_m = {7: released_fixtures()["libero_10", NAME][CADDY].position_m[0]}
        self.x_m[8] = self.x_m[7] + 0.0025

    def reset(self, task, reset):
        right = released_fixtures()["libero_10", NAME][CADDY]
        moved = Pose((self.x_m[reset.seed], *right.position_m[1:]), right.quat_xyzw)
        self.poses = dict(reset.fixtures) or {CADDY: moved}

    def fixtures(self):
        return self.poses


def test_fixtures_must_be_where_the_release_s_seed_puts_them():
    assert len(released_fixtures()) == 25
    simulator, right = Drawn(), released_fixtures()["libero_10", NAME]
    wrong = {
        CADDY: Pose(
            (right[CADDY].position_m[0] + 0.0025, *right[CADDY].position_m[1:]), right[CADDY].quat_xyzw
        )
    }
    for reset, off in (
        ({"seed": 7}, False),
        ({"seed": 7, "fixtures": right}, False),
        # A dataset that was converted with other poses, and one whose seed is not the release's.
        ({"seed": 7, "fixtures": wrong}, True),
        ({"seed": 8, "fixtures": right}, True),
        ({"seed": 8, "fixtures": wrong}, False),
    ):
        scenario = caddy_scenario(**reset)
        simulator.reset(scenario.task, scenario.reset)
        before = dict(simulator.fixtures())
        if off:
            with pytest.raises(ScenarioError, match=rf"{CADDY} is 2\.5 mm .* (env.seed\(7\)|seed 8)"):
                check_fixtures(simulator, scenario)
        else:
            assert check_fixtures(simulator, scenario)["fixture_mm"] < 1e-9
        assert simulator.fixtures() == before
    # Nothing tells where another seed should put them, the first time.
    scenario = caddy_scenario(seed=8)
    simulator.reset(scenario.task, scenario.reset)
    assert check_fixtures(simulator, scenario) == {}


def test_a_version_that_draws_otherwise_is_found_out():
    simulator = Drawn()
    simulator.x_m[7] += 0.0003
    scenario = caddy_scenario(seed=7)
    simulator.reset(scenario.task, scenario.reset)
    with pytest.raises(ScenarioError, match=r"0\.3 mm.*doctor"):
        check_fixtures(simulator, scenario)


def test_replaying_again_compares_with_what_was_there_and_loses_nothing(tmp_path):
    right = {CADDY: Pose((0.0, 0.0, 0.9), (0.0, 0.0, 0.0, 1.0))}
    moved = {CADDY: Pose((0.002, 0.0, 0.9), (0.0, 0.0, 0.0, 1.0))}
    before = fake_scenario(0)
    note = {"release": {"split_row": {"path": "libero/test/x.json"}}}
    before = replace(before, reset=replace(before.reset, fixtures=right), provenance=note)
    write_scenarios(tmp_path / "set", [before])
    with pytest.raises(ScenarioError, match="is fingerprinted, which would be lost"):
        read_earlier(tmp_path / "set", replayed=False)
    earlier = read_earlier(tmp_path / "set", replayed=True)
    assert compare_with_earlier(tmp_path / "set", earlier, [before]) == []
    with pytest.raises(ScenarioError, match=rf"{CADDY} is 2 mm .*set has it.*Nothing was written"):
        compare_with_earlier(
            tmp_path / "set", earlier, [replace(before, reset=replace(before.reset, fixtures=moved))]
        )
    other = replace(
        before, fingerprint=replace(before.fingerprint, state_sha256="0" * 64, versions={"mujoco": "4"})
    )
    (warning,) = compare_with_earlier(tmp_path / "set", earlier, [other])
    assert "in another state" in str(warning)
    assert "mujoco None then, 4 now" in str(warning)
    (tmp_path / "set/meta/info.json").write_text("{}")
    with pytest.raises(ScenarioError, match="rendered episodes, which would be lost"):
        read_earlier(tmp_path / "set", replayed=True)


@pytest.mark.nightly
@pytest.mark.libero
@pytest.mark.slow
def test_the_recorded_fixtures_are_those_of_a_first_reset_here():
    from lerobot_roborecover.platforms import make_simulator

    simulator = make_simulator("libero", obs_type="state")
    try:
        for (suite, name), poses in list(released_fixtures().items())[::6]:
            simulator.reset(Task("libero", suite, name, "go", 220), Reset(seed=7, init_state_index=3))
            assert simulator.fixtures() == poses
            simulator.reset(Task("libero", suite, name, "go", 220), Reset(seed=8, init_state_index=3))
            assert all(p.distance_m(poses[n]) > 1e-3 for n, p in simulator.fixtures().items())
    finally:
        simulator.close()


@pytest.mark.nightly
@pytest.mark.libero
@pytest.mark.slow
def test_a_wrong_seed_is_refused_when_it_is_replayed(tmp_path, capsys):
    """The robot's first state is the same whatever the seed, so that only the caddy tells."""
    from lerobot_roborecover.platforms import make_simulator

    task = Task("libero", "libero_10", NAME, "go", 520)
    simulator = make_simulator("libero", obs_type="state")
    simulator.reset(task, Reset(seed=8, init_state_index=30))
    robot, poses = simulator.observe()["robot_state"], dict(simulator.fixtures())
    simulator.close()
    state = {
        "gripper": float(robot["gripper"]["qpos"][0]), "quat": robot["eef"]["quat"].tolist(),
        "rpy": [0.0, 0.0, 0.0], "xyz": robot["eef"]["pos"].tolist(),
    }  # fmt: skip
    value = libero_record(1, 2) | {"task_id": 5, "episode_idx": 30, "initial_state": state}
    release = write_release(tmp_path / "release", {"libero": {"test": [value]}})
    # As it was converted before, with what seed 8 draws.
    (scenario,) = read_release(release, "libero").scenarios
    write_scenarios(tmp_path / "old", [replace(scenario, reset=replace(scenario.reset, fixtures=poses))])
    arguments = ["--out", str(tmp_path / "out"), "--fingerprint", "--workers", "1"]
    assert convert([str(tmp_path / "old"), *arguments]) == 2
    assert re.search(
        rf"fixture {CADDY} is 2\.\d+ mm and \S+ rad from where the release", capsys.readouterr().err
    )
    assert convert([str(release), *arguments]) == 0
    (good,) = load_scenarios(tmp_path / "out" / "libero")
    assert good.reset.fixtures == released_fixtures()["libero_10", NAME]


def test_nothing_to_convert_is_a_refusal(tmp_path, capsys):
    release = write_release(tmp_path / "release", {"libero": {"test": []}})
    assert convert([str(release), "--out", str(tmp_path / "out")]) == 2
    assert "nothing was converted, it has no rows" in capsys.readouterr().err
