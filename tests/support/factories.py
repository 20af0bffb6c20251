"""What tests are made of: fake scenarios, and small random policies saved as LeRobot checkpoints."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.replay.handoff import with_fingerprint
from lerobot_roborecover.scenario import Reset, Scenario, Task

CELLS = [("Approach", "Wrong Pose"), ("Place", "Wrong Target"), ("Move", "Wrong Pose")]


def fake_scenario(
    index: int, *, name: str | None = None, suite: str = "toy", steps: int = 10, horizon: int = 45
) -> Scenario:
    """A scenario of the fake simulator, with its fingerprint."""
    rng = np.random.default_rng(index)
    name = name or ("push-left", "push-right")[index % 2]
    stage, deviation = CELLS[index % len(CELLS)]
    scenario = Scenario(
        id=f"fake-{name}-{index:03d}",
        task=Task("fake", suite, name, "push the puck to the goal", horizon),
        reset=Reset(seed=index, settle_steps=2),
        prefix=rng.uniform(-1.5, 1.5, (steps, 2)),
        stage=stage,
        deviation=deviation,
        source=("natural", "perturbed")[index % 2],
        source_policy="noise",
    )
    return with_fingerprint(make_simulator("fake"), scenario)


def fake_dataset(root: Path, count: int, **kwargs) -> Path:
    """A dataset folder of `count` fake scenarios."""
    return write_scenarios(root, [fake_scenario(i, **kwargs) for i in range(count)], description="fake")


def save_policy(
    folder: Path,
    kind: str = "act",
    *,
    state: int = 4,
    env_state: int = 6,
    action: int = 2,
    images: tuple[str, ...] = (),
    image_size: int = 64,
) -> Path:
    """A small random policy as `lerobot-train` would save it: `act` is deterministic, `diffusion` draws
    noise.

    Args:
        folder: where to.
        kind: `act` or `diffusion`.
        state: width of `observation.state`.
        env_state: width of `observation.environment_state`; 0 leaves it out.
        action: width of the action.
        images: camera keys, square pictures of `image_size` (`act` only).
        image_size: pixels.
    """
    import torch
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies import get_policy_class, make_policy_config, make_pre_post_processors

    widths = {"observation.state": state, "observation.environment_state": env_state, "action": action}
    widths = {key: n for key, n in widths.items() if n}
    kinds = {"observation.state": FeatureType.STATE, "observation.environment_state": FeatureType.ENV}
    features = {key: PolicyFeature(kinds[key], (widths[key],)) for key in kinds if key in widths}
    picture = PolicyFeature(FeatureType.VISUAL, (3, image_size, image_size))
    common = {
        "input_features": {**features, **dict.fromkeys(images, picture)},
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (action,))},
        "device": "cpu",
        "push_to_hub": False,
    }
    if kind == "act":
        sizes = {"chunk_size": 4, "n_action_steps": 2, "dim_model": 16, "n_heads": 2, "dim_feedforward": 16}
        config = make_policy_config(
            "act", **common, **sizes, n_encoder_layers=1, use_vae=False, pretrained_backbone_weights=None
        )
    else:
        config = make_policy_config(
            "diffusion", **common, horizon=8, n_action_steps=4, n_obs_steps=2, down_dims=(16, 32),
            n_groups=4, diffusion_step_embed_dim=8, num_train_timesteps=4, num_inference_steps=2,
        )  # fmt: skip
    torch.manual_seed(0)
    policy = get_policy_class(kind)(config)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.mul_(2.0)
    shapes = {key: (n,) for key, n in widths.items()} | dict.fromkeys(images, (3, 1, 1))
    stats = {
        key: {
            "mean": torch.zeros(s), "std": torch.ones(s), "min": -torch.ones(s), "max": torch.ones(s),
        }
        for key, s in shapes.items()
    }  # fmt: skip
    preprocessor, postprocessor = make_pre_post_processors(config, dataset_stats=stats)
    policy.save_pretrained(folder)
    preprocessor.save_pretrained(folder)
    postprocessor.save_pretrained(folder)
    return folder
