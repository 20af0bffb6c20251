"""The trial log's row of a trial on a robot."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

from lerobot_roborecover.logs.robot import RobotTrial, StartError
from lerobot_roborecover.logs.row import EvalProtocol, RunExtent, TrialRow, make_row
from lerobot_roborecover.robot.connection import calibration_sha256
from lerobot_roborecover.robot.plan import LockedPlan, PlannedTrial
from lerobot_roborecover.robot.points import PointSet
from lerobot_roborecover.scenario import Outcome, Start


class TrialRows:
    """Makes the rows of a run.

    Args:
        robot: connected.
        plan: locked.
        points: of the plan.
        rater: who gives the verdicts.
        inference: LeRobot's type of it.
    """

    def __init__(self, robot: Any, plan: LockedPlan, points: PointSet, rater: str, inference: str = "sync"):
        self._robot, self._plan, self._points = robot, plan, points
        self._rater, self._inference = rater, inference
        self._by_id = {p.id: p for p in points.points}

    def make(
        self,
        trial: PlannedTrial,
        record: Mapping[str, Any],
        outcome: Outcome,
        reason: str,
        verdict: Any,
        note: str = "",
    ) -> TrialRow:
        """The row of a trial.

        Args:
            trial: of the plan.
            record: what the journal says of it.
            outcome: how it ended.
            reason: why it is invalid, if it is.
            verdict: the rater's.
            note: the rater's.
        """
        point = self._by_id[trial.point]
        start = record.get("start_error")
        robot = RobotTrial(
            robot_type=point.robot_type,
            calibration_sha256=calibration_sha256(self._robot),
            verdict=verdict,
            rater=self._rater,
            code=trial.code,
            start_error=None if start is None else StartError.of_json(start),
            reset_s=record.get("reset_s"),
            attempts=record.get("attempts", 0),
            duration_s=record.get("duration_s", 0.0),
            block=trial.block,
            order=trial.order,
            episode=record.get("episode"),
            note=note,
            clock_jump_s=record.get("clock_jump_s", 0.0),
        )
        return make_row(
            point.scenario,
            self._protocol(trial.policy),
            dataset=str(self._points.root),
            dataset_revision=None,
            trial=trial.trial,
            noise="unseeded",
            batch_size=1,
            outcome=outcome,
            reason=reason,
            steps=record.get("steps", 0),
            handoff=None,
            sim_s=record.get("reset_s") or 0.0,
            policy_s=record.get("duration_s", 0.0),
            actions_sha256=record.get("actions_sha256", ""),
            interventions=record.get("interventions", ()),
            extent=RunExtent(len(self._by_id), self._plan.plan.repeats),
            robot=robot.as_json(),
        )

    def _protocol(self, name: str) -> EvalProtocol:
        plan, identities = self._plan.plan, self._plan.identities
        planned = plan.policies[name]
        settings: dict[str, Any] = {
            "overrides": list(planned.overrides),
            "rename_map": dict(planned.rename_map),
        }
        if list(identities.values()).count(identities[name]) > 1:
            settings["name"] = name  # an A/A comparison: one policy under two names
        return EvalProtocol(
            start=Start.RECOVERY.value,
            rewind_steps=0,
            policy=identities[name],
            run_seed=plan.seed,
            execution_horizon=None,
            policy_settings=settings,
            options={"plan_sha256": self._plan.sha256, "policy_name": name, "inference": self._inference},
            versions={"lerobot": version("lerobot")},
        )
