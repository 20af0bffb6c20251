"""A small ACT that has learned the fake simulator's task from its scripted expert: it succeeds now and then."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def taught_policy(folder: Path, *, starts: int = 60, steps: int = 600) -> Path:
    """Saves it as a LeRobot checkpoint; seconds of a core.

    Args:
        folder: where to.
        starts: demonstrations.
        steps: of training, of 64 frames each.
    """
    import torch
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies import get_policy_class, make_policy_config, make_pre_post_processors

    states, scenes, actions = demonstrations(starts)
    chunk = 4
    config = make_policy_config(
        "act",
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (4,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (6,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        device="cpu", push_to_hub=False, chunk_size=chunk, n_action_steps=2, dim_model=32, n_heads=2,
        dim_feedforward=64, n_encoder_layers=1, use_vae=False, pretrained_backbone_weights=None, dropout=0.0,
    )  # fmt: skip
    rows = {"observation.state": states, "observation.environment_state": scenes, "action": actions[:, 0]}
    stats = {
        key: {
            "mean": torch.from_numpy(v.mean(0)), "std": torch.from_numpy(v.std(0) + 1e-3),
            "min": torch.from_numpy(v.min(0)), "max": torch.from_numpy(v.max(0)),
        }
        for key, v in rows.items()
    }  # fmt: skip
    with torch.random.fork_rng():
        torch.manual_seed(0)
        policy = get_policy_class("act")(config)
        pre, post = make_pre_post_processors(config, dataset_stats=stats)
        optimizer = torch.optim.Adam(policy.parameters(), 1e-3)
        for _ in range(steps):
            at = torch.randint(len(states), (64,)).numpy()
            batch = pre(
                {
                    "observation.state": torch.from_numpy(states[at]),
                    "observation.environment_state": torch.from_numpy(scenes[at]),
                    "action": torch.from_numpy(actions[at]),
                    "action_is_pad": torch.zeros(64, chunk, dtype=torch.bool),
                    "task": [""] * 64,
                }
            )
            batch["action_is_pad"] = torch.zeros(64, chunk, dtype=torch.bool)
            loss, _ = policy.forward(batch)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    for part in (policy, pre, post):
        part.save_pretrained(folder)
    return folder


def demonstrations(starts: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (N, 4), scenes (N, 6) and the next four actions (N, 4, 2) of the expert, float32."""
    from lerobot_roborecover.platforms import make_simulator, platform_named
    from lerobot_roborecover.scenario import Reset, Task

    simulator = make_simulator("fake")
    states, scenes, chunks = [], [], []
    for seed in range(1000, 1000 + starts):
        task = Task("fake", "toy", ("push-left", "push-right")[seed % 2], "push the puck to the goal", 120)
        simulator.reset(task, Reset(seed=seed))
        act = platform_named("fake").experts["expert"].make(simulator, task, np.random.default_rng(seed))
        taken = []
        while not simulator.succeeded() and len(taken) < 120:
            seen = simulator.observe()
            states.append(seen["agent_pos"])
            scenes.append(seen["environment_state"])
            taken.append(np.asarray(act(len(taken))))
            simulator.step(taken[-1])
        padded = [*taken, *[taken[-1]] * 4]
        chunks += [padded[i : i + 4] for i in range(len(taken))]
    return tuple(np.asarray(v, np.float32) for v in (states, scenes, chunks))
