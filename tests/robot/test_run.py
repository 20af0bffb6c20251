"""From a policy's rollout to a compared pair: captured, restored, run blind, judged, logged, reported."""

from __future__ import annotations

import json
import math

import pytest

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.logs.robot import RobotTrial
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.robot.console import Answer, Console
from lerobot_roborecover.robot.plan import lock_plan, parse_plan
from lerobot_roborecover.robot.run_journal import RunJournal, dataset_folder
from lerobot_roborecover.robot.trial_columns import COLUMNS, write_columns
from lerobot_roborecover.scenario import ScenarioError
from tests.support.robot_lab import lab

pytestmark = pytest.mark.lerobot


def plan_of(made, **changes):
    values = {
        "points": str(made / "points"),
        "policies": {"good": {"path": str(made / "good")}, "worse": {"path": str(made / "worse")}},
        "repeats": 1,
        "seed": 3,
        # At 48 pixels a puck is two or three: how alike they look says little.
        "tolerance": {"joint": 4.0, "object_px": 1.5, "background_px": 1.5, "similarity": 0.5},
        "motion": {"speed": 300.0, "tolerance": 2.0, "max_lag": 250.0, "max_detour": 50.0},
    }
    return parse_plan({**values, **changes})


def go(made, folder, robot, operator, **changes):
    from lerobot_roborecover.robot.run import RobotRun, RunConfig

    stop_after, only = changes.pop("stop_after", 0), changes.pop("only", None)
    rater = changes.pop("rater", "kim")
    locked, points = lock_plan(plan_of(made, **changes), folder)
    lines: list[str] = []
    journal = RunJournal(folder)
    try:
        config = RunConfig(folder, rater, stop_after=stop_after, only=only, external="t-1" if only else "")
        RobotRun(robot, locked, points, journal, Console(operator), config, say=lines.append).run()
    finally:
        journal.close()
    return read_trial_log(folder / "trials.jsonl"), lines


class Spoken:
    """The simulated operator, with something else to say on some screens."""

    def __init__(self, operator, **said):
        self.operator, self.said = operator, said

    def answer(self, screen, details):
        if self.said.get(screen):
            return self.said[screen].pop(0)
        return self.operator.answer(screen, details)


def said_by_dataset(folder):
    """The trial columns of each episode, which are the same in all its frames."""
    from lerobot.datasets import LeRobotDataset

    found = LeRobotDataset("local/run", root=dataset_folder(folder))
    rows = found.hf_dataset.with_format(None)
    episodes = [
        [rows[i] for i in range(len(rows)) if rows[i]["episode_index"] == e]
        for e in range(len(found.meta.episodes))
    ]
    for episode in episodes:
        assert len({repr([row[name] for name in COLUMNS]) for row in episode}) == 1
    assert found[0]["observation.images.top"].ndim == 3
    return [episode[0] for episode in episodes]


def test_a_plan_is_run_blind_and_resumed_and_its_log_is_a_study(made, tmp_path):
    from lerobot_roborecover.analysis.analyse import analyse
    from lerobot_roborecover.analysis.logs import read_study
    from lerobot_roborecover.robot.lab.operator import SimulatedOperator

    with lab(made) as robot:
        operator = SimulatedOperator(robot, sd_mm=3.0, max_tries=8)
        first, _ = go(made, tmp_path, robot, operator, stop_after=1)
        assert len(first) == 1
        rows, lines = go(made, tmp_path, robot, operator)
    assert len(rows) == 4
    assert rows[0] == first[0]
    assert {r.platform for r in rows} == {"robot"}
    codes = {RobotTrial.of_json(r.robot).code for r in rows}
    assert codes == {"A", "B"}
    assert not any("good" in line or "worse" in line for line in lines)
    for row in rows:
        trial = RobotTrial.of_json(row.robot)
        assert trial.rater == "kim"
        assert trial.reset_s > 0
        assert abs(trial.start_error.worst("joint")) <= 4.0
        assert row.outcome in ("success", "horizon"), row.reason
        assert not trial.start_error.problems
        assert trial.episode is not None
    good = [r.success for r in rows if r.options["policy_name"] == "good"]
    worse = [r.success for r in rows if r.options["policy_name"] == "worse"]
    assert (good, worse) == ([True, True], [False, False])
    results = analyse(read_study([str(tmp_path / "trials.jsonl")]))
    assert len(results.recovery.arms) == 2
    told = said_by_dataset(tmp_path)
    for row in rows:
        trial = RobotTrial.of_json(row.robot)
        if trial.episode is not None:
            said = told[trial.episode]
            assert (said["verdict"], said["rater"], said["reason"]) == (trial.verdict, "kim", row.reason)
            assert (said["policy"], said["recovery_point"]) == (row.options["policy_name"], row.scenario_id)
            assert said["start_error.joint"] == pytest.approx(trial.start_error.worst("joint"), abs=1e-5)
            assert isinstance(said["intervention"], bool)


def test_the_labs_record_of_a_point_is_that_of_its_frame(made):
    """Replaying the recorded actions brings the puck exactly to where the point says that it was."""
    from lerobot_roborecover.robot.points import read_points

    with lab(made) as robot:
        for point in read_points(made / "points").points:
            robot.new_scene(robot.config.seed + point.episode)
            for action in point.scenario.prefix:
                robot.send_action(dict(zip(robot.action_features, action.tolist(), strict=True)))
            assert robot.world.distance_m(dict(point.truth["objects"])) < 1e-9


def test_a_changed_plan_and_a_second_console_are_refused(made, tmp_path):
    lock_plan(plan_of(made), tmp_path)
    with pytest.raises(OptionError, match="the plan was locked when the run began; its plan changed"):
        lock_plan(plan_of(made, repeats=2), tmp_path)
    journal = RunJournal(tmp_path)
    with pytest.raises(ScenarioError, match="in use by another process; stop that one first"):
        RunJournal(tmp_path)
    journal.close()


def test_the_order_is_random_within_blocks_and_the_same_each_time(made, tmp_path):
    locked, _ = lock_plan(plan_of(made, repeats=5), tmp_path)
    again, _ = lock_plan(plan_of(made, repeats=5), tmp_path)
    assert locked.trials == again.trials
    for block in range(5):
        inside = [(t.point, t.policy) for t in locked.trials if t.block == block]
        assert len(set(inside)) == 4
    orders = {tuple(t.policy for t in locked.trials if t.block == b) for b in range(5)}
    assert len(orders) > 1


def test_undo_asks_again_and_the_log_follows_the_journal(made, tmp_path, monkeypatch):
    from lerobot_roborecover.robot.lab.operator import SimulatedOperator

    with lab(made) as robot:
        operator = SimulatedOperator(robot, sd_mm=0.0)
        said = {
            "running": [None, None, Answer("end")],
            "verdict": [Answer("failure"), Answer("invalid", {"reason": "person", "note": "a hand came in"})],
            "next": [Answer("go"), Answer("undo"), Answer("pause")],
        }
        asked: dict[str, list[str]] = {}
        spoken = Spoken(operator, **said)
        show = Console.show

        def keep(console, name, text="", *args):
            asked.setdefault(name, []).append(text)
            show(console, name, text, *args)

        monkeypatch.setattr(Console, "show", keep)
        rows, lines = go(made, tmp_path, robot, spoken)
    first, again = asked["verdict"]
    assert first == "Trial 1 of 4: is the task done?"
    assert again.endswith(", recorded: was the task done at its end?")
    assert asked["next"][1].endswith(" Trial 1: failure.")
    assert "trial 1: taken back" in lines
    (row,) = rows
    assert (row.outcome, row.reason) == ("sim_error", "invalid (person): a hand came in")
    # A crash between the journal and the log: the log is put right.
    (tmp_path / "trials.jsonl").write_text("")
    RunJournal(tmp_path).close()
    assert read_trial_log(tmp_path / "trials.jsonl") == rows
    (said,) = said_by_dataset(tmp_path)
    assert (said["verdict"], said["reason"]) == ("invalid", row.reason)
    # So is the dataset, where a verdict is missing, was taken back, or a crash cut a file off.
    write_columns(dataset_folder(tmp_path), {0: {"verdict": "success", "start_error.object_px": math.nan}})
    (dataset_folder(tmp_path) / "data/chunk-000/file-001.parquet").write_bytes(b"PAR1")
    journal = RunJournal(tmp_path)
    journal.undo()
    journal.close()
    (dataset_folder(tmp_path) / "data/chunk-000/file-001.parquet").unlink()
    (said,) = said_by_dataset(tmp_path)
    assert (said["verdict"], said["reason"]) == ("", "")
    assert math.isnan(said["start_error.object_px"])


def test_after_a_crash_before_the_verdict_only_the_verdict_is_asked(made, tmp_path):
    from lerobot_roborecover.robot.lab.operator import SimulatedOperator

    class Crashed(Exception):
        pass

    class Crashes(Spoken):
        def answer(self, screen, details):
            if screen == "verdict":
                raise Crashed
            return super().answer(screen, details)

    with lab(made) as robot:
        operator = SimulatedOperator(robot, sd_mm=0.0)
        with pytest.raises(Crashed):
            go(made, tmp_path, robot, Crashes(operator, running=[Answer("end")]))
        said = {"verdict": [Answer("success")], "next": [Answer("pause")]}
        rows, lines = go(made, tmp_path, robot, Spoken(operator, **said))
    assert [r.outcome for r in rows] == ["success"]
    assert "has no verdict yet" in lines[0]


def test_after_the_last_trial_its_verdict_can_still_be_taken_back(made, tmp_path):
    from lerobot_roborecover.robot.lab.operator import SimulatedOperator

    said = {
        "running": [Answer("end")] * 4,
        "verdict": [Answer("failure")] * 4 + [Answer("success")],
        "finished": [Answer("undo"), Answer("finish")],
    }
    with lab(made) as robot:
        operator = Spoken(SimulatedOperator(robot, sd_mm=0.0), **said)
        rows, lines = go(made, tmp_path, robot, operator)
    assert [r.success for r in rows] == [False, False, False, True]
    assert said["finished"] == []
    assert lines[-3:-1] == ["trial 4: taken back", "trial 4: success"]


def test_a_trial_that_was_cut_off_is_said_and_run_again(made, tmp_path):
    from lerobot_roborecover.robot.lab.operator import SimulatedOperator

    class Killed(BaseException):
        pass

    class Kills(Spoken):
        def answer(self, screen, details):
            if screen == "running":
                raise Killed
            return super().answer(screen, details)

    with lab(made) as robot:
        operator = SimulatedOperator(robot, sd_mm=0.0)
        with pytest.raises(Killed):
            go(made, tmp_path, robot, Kills(operator))
        rows, lines = go(made, tmp_path, robot, operator, stop_after=1)
    assert lines[0] == "trial 1 was cut off before it ended; it is run again"
    assert len(rows) == 1


def test_a_button_that_ended_a_trial_is_its_verdict_until_it_is_taken_back(made, tmp_path):
    from lerobot_roborecover.robot.lab.operator import SimulatedOperator

    said = {
        "running": [Answer("success")],
        "verdict": [Answer("failure")],
        "next": [Answer("go"), Answer("undo"), Answer("pause")],
    }
    with lab(made) as robot:
        rows, _ = go(made, tmp_path, robot, Spoken(SimulatedOperator(robot, sd_mm=0.0), **said))
        assert [r.outcome for r in rows] == ["horizon"]
        _, lines = go(
            made, tmp_path, robot, Spoken(SimulatedOperator(robot), next=[Answer("pause")]), rater="lee"
        )
    assert lines[0] == "verdicts so far are by kim; from here on they are by lee"


def test_another_program_runs_single_trials_and_its_labels_replace_the_verdicts(made, tmp_path):
    from lerobot_roborecover.robot.fieldtrial import take_labels
    from lerobot_roborecover.robot.lab.operator import SimulatedOperator

    locked, points = lock_plan(plan_of(made), tmp_path)
    only = (points.points[0].id, locked.codes["good"])
    with lab(made) as robot:
        careless = SimulatedOperator(robot, sd_mm=0.0, bias_mm=(60.0, 0.0), max_tries=1)
        (refused,), _ = go(made, tmp_path, robot, careless, only=only)
        operator = Spoken(SimulatedOperator(robot, sd_mm=0.0), running=[Answer("success")])
        (row,), _ = go(made, tmp_path, robot, operator, only=only)
        with pytest.raises(OptionError, match="all 1 trial of it are done"):
            go(made, tmp_path, robot, operator, only=only)
        with pytest.raises(OptionError, match="the plan has no such point and code"):
            go(made, tmp_path, robot, operator, only=("elsewhere", "A"))
    assert (refused.outcome, row.outcome) == ("state_mismatch", "success")
    assert row.scenario_id == only[0]
    label = {"trial_id": "t-1", "status": "completed", "success": False, "operator": "lee"}
    exported, said = tmp_path / "exported.jsonl", []
    exported.write_text(json.dumps(label) + "\n" + json.dumps({**label, "trial_id": "t-2"}) + "\n")
    assert take_labels(tmp_path, exported, said.append) == 1
    (labelled,) = read_trial_log(tmp_path / "trials.jsonl")
    assert (labelled.outcome, labelled.robot["verdict"], labelled.robot["rater"]) == (
        "horizon",
        "failure",
        "lee",
    )
    assert "1 trial of fieldtrial has no verdict here, e.g. t-2" in said[-1]
    assert take_labels(tmp_path, exported, said.append) == 0
    exported.write_text("no export\n")
    with pytest.raises(ScenarioError, match="is not what `fieldtrial export"):
        take_labels(tmp_path, exported, said.append)
