"""The composite policy as LeRobot loads and asks it: one action a slot, for a scenario's batch of trials."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.policies.detectors.interface import Detector
from lerobot_roborecover.policies.detectors.probe import PolicyProbe
from lerobot_roborecover.policies.interventions.configuration_intervention import (
    MonitorConfig,
    RoboRecoverInterventionConfig,
)
from lerobot_roborecover.policies.interventions.control_columns import append_columns
from lerobot_roborecover.policies.interventions.controller import InterventionController, InterventionState
from lerobot_roborecover.policies.interventions.host import InterventionHost, tensors
from lerobot_roborecover.policies.interventions.members import MemberHost, load_member
from lerobot_roborecover.policies.interventions.options import POLICY_TYPE
from lerobot_roborecover.policies.interventions.takeover import load_controller
from lerobot_roborecover.policies.runner import Controller, PolicyError, Processor


class RoboRecoverInterventionPolicy(PreTrainedPolicy):
    """A base policy with interventions. Has no weights of its own: saved, it names its members.

    Under LeRobot's loop, actions carry five columns more than the environment's (`control_columns`). The
    vector env takes them off.
    """

    # LeRobot declares both as None, for subclasses to replace.
    config_class = RoboRecoverInterventionConfig  # ty: ignore[invalid-assignment]
    name = POLICY_TYPE  # ty: ignore[invalid-assignment]
    config: RoboRecoverInterventionConfig

    def __init__(self, config: RoboRecoverInterventionConfig, **_: Any):
        super().__init__(config)
        config.check()
        features, action = config.input_features or {}, (config.output_features or {}).get(ACTION)

        def member(role: str) -> MemberHost:
            return load_member(role, getattr(config, role), str(config.device), features, action)

        members = {Controller.BASE: member("base")}
        if config.mode.endswith("correction"):
            members[Controller.CORRECTION] = member("correction")
            widths = {m.action_width for m in members.values()}
            if len(widths) > 1:
                raise OptionError(
                    f"--policy.correction.path={config.correction.path}: its actions and those of the base "
                    f"policy have widths {sorted(widths)}; they must be of one action space"
                )
        probe = PolicyProbe(*members[Controller.BASE].parts[:2])
        monitor = _monitor(config.monitor, str(config.device), features, probe) if config.monitored else None
        self.director = InterventionController(
            members,
            config.mode,
            monitor=monitor,
            probe=probe,
            takeover=load_controller(config.controller) if config.mode == "human" else None,
            correction_steps=config.correction_steps,
            rewind_steps=config.rewind_steps,
        )
        self._episodes: list[InterventionState] = []
        self._rows: list[list[np.ndarray]] = []

    @property
    def policies(self) -> list[PreTrainedPolicy]:
        """The policies that act: base and correction."""
        return [member.parts[0] for member in self.director.members.values()]

    def make_host(
        self,
        env_preprocessor: Processor,
        env_postprocessor: Processor,
        preprocessor: Processor,
        max_batch: int,
    ) -> InterventionHost:
        """Returns the runner that `roborecover eval` uses in place of `select_action`."""
        return InterventionHost(self.director, env_preprocessor, env_postprocessor, preprocessor, max_batch)

    def reset(self) -> None:
        for episode in self._episodes:
            self.director.finish(episode)
        self._episodes, self._rows = [], []

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """Next action of each slot, with its columns.

        Args:
            batch: observations after the env preprocessor, and `task`.

        Returns:
            (B, A + 5) float32.

        Raises:
            PolicyError: a member raised; LeRobot's loop has no way to go on without one slot.
        """
        observations = tensors(batch)
        count = len(next(iter(observations.values())))
        instructions = list(batch.get("task") or [""] * count)
        if not self._episodes:
            if count > 1 and self.config.mode == "human":
                raise OptionError(
                    "--policy.mode=human needs --eval.batch_size=1: LeRobot's loop goes on asking for trials "
                    "that are over. Or use roborecover eval"
                )
            self._episodes = [self.director.start(None) for _ in range(count)]
            self._rows = [[] for _ in range(count)]
        due = [i for i in range(count) if not self._rows[i]]
        decisions = self.director.act(
            [{k: v[i : i + 1] for k, v in observations.items()} for i in due],
            [instructions[i] for i in due],
            [self._episodes[i] for i in due],
        )
        for i, decision in zip(due, decisions, strict=True):
            if isinstance(decision, PolicyError):
                raise decision
            self._rows[i] = list(append_columns(decision, self.director.action_width))
        return torch.from_numpy(np.stack([rows.pop(0) for rows in self._rows]))

    def predict_action_chunk(self, batch: dict[str, Any], **_: Any) -> Tensor:
        return self.select_action(batch)[:, None]

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, dict | None]:
        """Refuses: its members are trained on their own."""
        self.config.get_optimizer_preset()
        raise AssertionError("unreachable")

    def get_optim_params(self) -> dict:
        return {}

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        self.config._save_pretrained(save_directory)

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: PreTrainedConfig | None = None,
        **kwargs: Any,
    ) -> Self:
        """Loads the members that a saved composite names."""
        if config is None:
            config = RoboRecoverInterventionConfig.from_pretrained(pretrained_name_or_path, **kwargs)
        if not isinstance(config, RoboRecoverInterventionConfig):
            raise OptionError(f"{pretrained_name_or_path}: a {config.type} is no {cls.name}")
        policy = cls(config)
        policy.eval()
        return policy


def _monitor(config: MonitorConfig, device: str, features: dict, probe: PolicyProbe) -> Detector:
    from lerobot_roborecover.policies.detectors.loading import check_needs, load_detector

    overrides = {} if config.threshold is None else {"threshold": str(config.threshold)}
    if config.base_model:
        overrides["base_model"] = config.base_model
    detector = load_detector(config.path, device, revision=config.revision, **overrides)
    option = f"--policy.monitor.path={config.path}"
    if not detector.fitted:
        raise OptionError(
            f"{option}: has not been fitted; `roborecover detect evaluate --detector` fits and saves it"
        )
    if not detector.decides:
        raise OptionError(
            f"{option}: has no threshold, and would never trigger. Give --policy.monitor.threshold, or "
            "the folder that `roborecover detect evaluate --detector` saved, which has one"
        )
    if features or detector.needs.truth or detector.needs.of_policy:
        there = features or dict.fromkeys(detector.needs.features)
        check_needs(option, detector.needs, there, probe)
    return detector
