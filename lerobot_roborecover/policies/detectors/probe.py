"""Looks into the policy that acts, beside the trial: what it would do now, and what it computes on the way.

Neither the trial's history nor its random stream is touched: chunks are drawn from a generator of their own,
seeded by trial and step. A policy that keeps an observation queue is given the last observations anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from lerobot_roborecover.policies.detectors.interface import DetectorError, DetectorNeeds
from lerobot_roborecover.policies.local_runner import STATELESS

FEATURE_MODULES: Mapping[str, str] = {
    "act": "model.action_head",
    "diffusion": "diffusion.unet.final_conv",
    "smolvla": "model.action_out_proj",
    "pi0": "model.action_out_proj",
    "pi05": "model.action_out_proj",
}
"""By policy type of LeRobot 0.6.1: the module that turns features into actions. What goes into it, at its
last call of an inference (the last denoising step), is what `policy_features` reads."""
_CHANNELS_FIRST = ("diffusion",)
_QUEUED = ("diffusion",)
"""Types that read their last `n_obs_steps` observations, and take them as (B, n_obs_steps, ...)."""


class PolicyProbe:
    """Asks a policy beside the trial.

    Args:
        policy: a loaded LeRobot policy, in eval mode.
        preprocessor: its own.
    """

    def __init__(self, policy: Any, preprocessor: Any):
        self._policy, self._pre = policy, preprocessor
        self.kind = getattr(policy.config, "type", "")
        """The policy's type."""
        self._device = next(policy.parameters()).device
        self._noise = STATELESS.get(self.kind, "inside")

    @property
    def past(self) -> int:
        """Observations before the last that the policy reads."""
        return int(self._policy.config.n_obs_steps) - 1 if self.kind in _QUEUED else 0

    @property
    def deterministic(self) -> bool:
        """Whether the policy draws no noise, so that all its chunks are one."""
        fixed = self._noise == "fixed" and self._policy.config.inference_seed is not None
        return fixed or self._noise == "none"

    def check(self, needs: DetectorNeeds, name: str) -> None:
        """Refuses what this policy cannot show.

        Raises:
            DetectorError: naming the detector, the policy type and the types that can.
        """
        chunks = sorted({*STATELESS, *_QUEUED})
        if needs.chunks and self.kind not in chunks:
            raise DetectorError(
                f"{name} needs the policy's action chunks; a {self.kind!r} policy gives none beside a trial. "
                f"It works with {chunks}"
            )
        if needs.internals and self.kind not in FEATURE_MODULES:
            raise DetectorError(
                f"{name} needs the policy's own features; where a {self.kind!r} policy has them is not known "
                f"(interventions/detectors/probe.py). It works with {sorted(FEATURE_MODULES)}"
            )

    @torch.no_grad()
    def look(
        self,
        windows: Sequence[Sequence[Mapping[str, Tensor]]],
        instructions: Sequence[str],
        seeds: Sequence[int],
        needs: DetectorNeeds,
    ) -> list[tuple[Tensor | None, Tensor | None]]:
        """Chunks and features at the end of each window.

        Args:
            windows: B histories of observations without a batch axis, oldest first; `past` + 1 of each are
                used, the first repeated where there are fewer.
            instructions: B.
            seeds: B, of the noise.
            needs: what is asked.

        Returns:
            B pairs: (K, H, A) chunks as predicted, and (F,) features; None for what is not asked.
        """
        if self.deterministic:
            chunks, features = self._infer(windows, instructions, 1, None)
            return [
                (chunks[i : i + 1].expand(max(needs.chunks, 1), -1, -1) if needs.chunks else None, features[i]
                 if needs.internals else None)
                for i in range(len(windows))
            ]  # fmt: skip
        found: list[tuple[Tensor | None, Tensor | None]] = []
        for window, text, seed in zip(windows, instructions, seeds, strict=True):
            # One window at a time: what it draws does not depend on who shares the batch.
            chunks, features = self._infer([window], [text], max(needs.chunks, 1), seed)
            found.append((chunks if needs.chunks else None, features.mean(0) if needs.internals else None))
        return found

    def _infer(
        self, windows: Sequence, instructions: Sequence[str], copies: int, seed: int | None
    ) -> tuple[Tensor, Tensor]:
        """(B * copies, H, A) chunks and (B * copies, F) features; of width 0 where they are not known."""
        batch = self._batch(windows, copies)
        prepared = self._pre({**batch, "task": [t for t in instructions for _ in range(copies)]})
        seen: list[Tensor] = []
        module = self._module()
        hook = module.register_forward_pre_hook(lambda _, given: seen.append(given[0])) if module else None
        gpus = [self._device] if self._device.type == "cuda" else []
        try:
            with torch.random.fork_rng(devices=gpus):
                if seed is not None:
                    torch.manual_seed(seed)
                self._policy.reset()
                chunks = self._policy.predict_action_chunk(prepared)
        finally:
            if hook is not None:
                hook.remove()
        chunks = chunks.float().cpu()
        if not seen:
            return chunks, torch.zeros(len(chunks), 0)
        last = seen[-1].float().cpu()
        if self.kind in _CHANNELS_FIRST:
            last = last.movedim(1, -1)
        return chunks, last.flatten(1, -2).mean(1)

    def _batch(self, windows: Sequence[Sequence[Mapping[str, Tensor]]], copies: int) -> dict[str, Tensor]:
        keys = windows[0][-1]
        if self.kind not in _QUEUED:
            rows = {k: torch.stack([w[-1][k] for w in windows]) for k in keys}
        else:
            rows = {k: torch.stack([_last(w, k, self.past + 1) for w in windows]) for k in keys}
        return {k: v.repeat_interleave(copies, 0) for k, v in rows.items()}

    def _module(self) -> nn.Module | None:
        path = FEATURE_MODULES.get(self.kind)
        return self._policy.get_submodule(path) if path else None


def _last(window: Sequence[Mapping[str, Tensor]], key: str, count: int) -> Tensor:
    """(count, ...) last observations, the first repeated where there are fewer."""
    row = [o[key] for o in window[-count:]]
    return torch.stack([row[0]] * (count - len(row)) + row)
