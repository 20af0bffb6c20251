"""fieldtrial itself schedules, starts and labels trials of ours; its labels end in our log."""

from __future__ import annotations

import time

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.logs.trial_log import read_trial_log

pytest.importorskip("fieldtrial", reason="fieldtrial is not installed")
pytestmark = [pytest.mark.lerobot, pytest.mark.slow, pytest.mark.nightly]


def test_fieldtrial_runs_a_plan_of_ours(made, tmp_path, capsys):
    import yaml
    from fieldtrial.runners.base import ArmSpec, TrialContext
    from fieldtrial.runners.command import CommandRunner
    from fieldtrial.services import session, study, transfer, trial
    from fieldtrial.services._context import open_study
    from fieldtrial.services.runner_check import check_runners

    plan = {
        "points": str(made / "points"),
        "policies": {"good": str(made / "good"), "worse": str(made / "worse")},
        "tolerance": {"joint": 4.0},
        "motion": {"speed": 300.0, "max_lag": 250.0, "max_detour": 50.0},
    }
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(plan))
    run, folder = tmp_path / "run", tmp_path / "evening"
    robot = (
        "--rater=kim --operator=simulated --robot.type=roborecover_lab --robot.id=lab --robot.realtime=false "
        f"--robot.size=48 --robot.calibration_dir={made}"
    )
    argv = ["robot", "fieldtrial", str(run), "--plan", str(tmp_path / "plan.yaml"), "--out", str(folder)]
    assert main([*argv, f"--options={robot}"]) == 0
    assert main(argv) == 2
    assert "is there already" in capsys.readouterr().err
    study.lock_study(folder)
    assert all(check.ok for check in check_runners(folder))

    with open_study(folder) as ctx:
        shift = session.start_session(ctx, operator="lee", rig="lab")
        runner = CommandRunner(ctx.spec.runners.command, study="evening", folder=folder, success_index=0)
        ended = []
        for slot in trial.pending_slots(ctx)[:2]:
            arm = ctx.spec.arm(slot.arm)
            started = trial.start_trial(ctx, slot.slot_id, shift)
            runner.prepare(ArmSpec(arm.id, slot.blind_code, dict(arm.policy)))
            runner.start(TrialContext(slot.seq, slot.condition, slot.factors, trial_id=started.trial_id))
            while "command ended" not in runner.status().message:
                time.sleep(0.5)
            found = runner.stop("other")
            assert found.metrics["exit_code"] in (0, 1), found.log
            ended.append((started.trial_id, found.stage_index))
        # The operator confirms the first suggestion and contradicts the second one.
        for (name, stage), change in zip(ended, (False, True), strict=True):
            done = (stage == 0) != change
            trial.complete_trial(ctx, name, stage_index=0 if done else -1, termination="other")
    rows = read_trial_log(run / "trials.jsonl")
    assert [r.success for r in rows] == [stage == 0 for _, stage in ended]
    transfer.export_trials(folder, tmp_path / "labels.jsonl", fmt="jsonl")
    assert main(["robot", "fieldtrial", str(run), "--labels", str(tmp_path / "labels.jsonl")]) == 0
    assert "2 labels, 1 verdict changed" in capsys.readouterr().out
    after = read_trial_log(run / "trials.jsonl")
    by_order = sorted(
        after, key=lambda r: [x.scenario_id + x.policy for x in rows].index(r.scenario_id + r.policy)
    )
    assert [r.success for r in by_order] == [rows[0].success, not rows[1].success]
    assert {r.robot["rater"] for r in after} == {"kim", "lee"}
