"""A policy whose vision backbone begins from nothing, with the statistics of its batch norms taken from data.

LeRobot's ACT freezes the batch norms of its ResNet, as one does with a backbone that was trained elsewhere.
In one that begins from random weights they pass everything through, and nothing is normalised. Here they get
the mean and the variance of their inputs over some frames of the dataset, layer after layer, before the
training begins; `lerobot-train --policy.path=OUT` goes on from there:

    python -m recipes.calibrated_backbone --config_path=policies/train/libero/act_pixels.yaml \
      --dataset.root=DIR --output_dir=OUT
"""

from __future__ import annotations

from typing import Any

FRAMES = 256


def calibrate(backbone: Any, pictures: Any) -> int:
    """Gives every frozen batch norm the statistics of what comes to it.

    Args:
        backbone: a module with `torchvision.ops.FrozenBatchNorm2d`.
        pictures: (N, C, H, W) as it sees them.

    Returns:
        How many there are.
    """
    import torch
    from torchvision.ops import FrozenBatchNorm2d

    def measured(norm: Any, inputs: tuple) -> None:
        norm.running_var, norm.running_mean = torch.var_mean(inputs[0], dim=(0, 2, 3), correction=0)

    norms = [module for module in backbone.modules() if isinstance(module, FrozenBatchNorm2d)]
    hooks = [norm.register_forward_pre_hook(measured) for norm in norms]
    with torch.no_grad():
        backbone(pictures)
    for hook in hooks:
        hook.remove()
    return len(norms)


def main() -> None:
    """Command line: options of `lerobot-train`."""
    import draccus
    import torch
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.datasets.factory import make_dataset
    from lerobot.policies.factory import make_policy, make_pre_post_processors
    from lerobot.utils.random_utils import set_seed
    from torch.utils.data import default_collate

    from lerobot_roborecover.utils.atomic_io import atomic_dir

    config = draccus.parse(TrainPipelineConfig)
    if config.policy is None or config.output_dir is None:
        raise SystemExit("--config_path and --output_dir: a training configuration, and a new folder")
    set_seed(config.seed)
    dataset: Any = make_dataset(config)
    policy: Any = make_policy(config.policy, ds_meta=dataset.meta)
    processors = make_pre_post_processors(config.policy, dataset_stats=dataset.meta.stats)
    rows = torch.randperm(len(dataset))[:FRAMES].tolist()
    batch = processors[0](default_collate([dataset[row] for row in rows]))
    pictures = torch.cat([batch[key] for key in config.policy.image_features])
    count = calibrate(policy.model.backbone, pictures)
    with atomic_dir(config.output_dir) as folder:
        for part in (policy, *processors):
            part.save_pretrained(folder)
    print(f"{count} norms calibrated on {len(pictures)} pictures: {config.output_dir}", flush=True)


if __name__ == "__main__":
    main()
