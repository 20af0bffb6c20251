"""A LeRobot policy as a server has it: observations come off the wire, in LeRobot's keys."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType

from lerobot_roborecover.policies.local_runner import LocalPolicyRunner
from lerobot_roborecover.policies.remote.sessions import PROTOCOL, RequestError

_LONGEST_SIDE = 8192
_MOST_NUMBERS = 3 * 2048 * 2048
"""Of one array: each becomes a float32, for a moment twice."""


class ServedPolicy(LocalPolicyRunner):
    """A policy host that takes `observation.*` arrays in place of a simulator's own.

    Args:
        policy: a loaded LeRobot policy, in eval mode.
        preprocessor: the policy's own.
        postprocessor: the policy's own.
        rename_map: as of `--rename_map`: the client's key to the policy's.
        max_batch: requests inferred together, at most.
    """

    def __init__(
        self,
        policy: Any,
        preprocessor: Any,
        postprocessor: Any,
        rename_map: Mapping[str, str] | None = None,
        max_batch: int = 64,
    ):
        super().__init__(policy, _same, _same, preprocessor, postprocessor, max_batch)
        config = policy.config
        theirs = {new: old for old, new in (rename_map or {}).items()}
        self.expected = {
            theirs.get(key, key): feature
            for key, feature in (config.input_features or {}).items()
            if "empty_camera" not in key  # pictures that pi0 and xvla fill in themselves
        }
        """Features of an observation, by the client's keys."""
        self.action_width = int(config.output_features["action"].shape[0])

    def batch_key(self, observation: Mapping[str, np.ndarray]) -> Hashable:
        """Returns the keys and shapes that observations of one batch must share.

        Args:
            observation: of `check`.
        """
        return tuple(sorted((key, array.shape, array.dtype.str) for key, array in observation.items()))

    def metadata(self, name: str) -> dict[str, Any]:
        """Metadata that a client receives when it connects.

        Args:
            name: of the policy.
        """
        return {
            "server": "roborecover",
            "protocol": PROTOCOL,
            "policy": name,
            "policy_type": str(self._policy.config.type),
            "action_width": self.action_width,
            "chunk": self.horizon,
            "observation": {key: list(f.shape) for key, f in self.expected.items()},
            "noise": self.noise(0),
        }

    def check(self, message: Mapping[Any, Any]) -> dict[str, np.ndarray]:
        """The observation of a request.

        Args:
            message: unpacked.

        Raises:
            RequestError: it lacks something, or has another shape, in words for the client.
        """
        found = {k: v for k, v in message.items() if isinstance(k, str) and k.startswith("observation.")}
        for key, value in found.items():
            if not isinstance(value, np.ndarray):
                raise RequestError(f"{key!r:.100} is a {type(value).__name__}, not an array")
            if value.dtype == np.uint8 and (value.ndim != 3 or value.shape[2] != 3 or not value.size):
                raise RequestError(f"{key!r:.100} has shape {value.shape}; a uint8 picture is (H, W, 3)")
            size = value.size if key in self.expected else 0
            if max(value.shape, default=1) > _LONGEST_SIDE or value.ndim > 4 or size > _MOST_NUMBERS:
                raise RequestError(
                    f"{key!r:.100} has shape {value.shape}; the limits are {_MOST_NUMBERS} numbers, 4 "
                    f"dimensions and {_LONGEST_SIDE} a side. Make the pictures smaller"
                )
        pictures = {k for k, f in self.expected.items() if f.type is FeatureType.VISUAL}
        missing = set(self.expected) - set(found)
        # A policy fills in some of its cameras, as it does when it is loaded beside the simulator.
        if missing - pictures or (pictures and not pictures & set(found)):
            raise RequestError(
                f"the observation lacks {sorted(missing)}; it has {sorted(map(str, message))!r:.300}. This "
                f"policy takes { {k: tuple(f.shape) for k, f in self.expected.items()} }"
            )
        for key, feature in self.expected.items():
            if key in found and len(feature.shape) == 1 and found[key].shape != tuple(feature.shape):
                raise RequestError(
                    f"{key!r} has shape {found[key].shape}; this policy takes {tuple(feature.shape)}"
                )
        # What the policy does not take is neither kept nor converted.
        return {key: found[key] for key in self.expected if key in found}

    def _prepare(self, observations: Sequence[Mapping[str, Any]], instructions: Sequence[str]) -> Any:
        keys = observations[0]
        batch: dict[str, Any] = {k: _tensor(np.stack([o[k] for o in observations])) for k in keys}
        batch["task"] = list(instructions)
        return self._pre(batch)


def _tensor(array: np.ndarray) -> torch.Tensor:
    """As `lerobot.envs.preprocess_observation` makes tensors: pictures (B, 3, H, W) from 0 to 1, all
    float32."""
    if array.dtype == np.uint8:
        return torch.from_numpy(array).permute(0, 3, 1, 2).contiguous().type(torch.float32).div_(255)
    return torch.from_numpy(array).float()


def _same(value: Any) -> Any:
    return value
