"""A SmolVLA of a few thousand weights, random, made without the Hub."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any


def small_smolvla(folder, monkeypatch, *, chunk: int = 6, n_action_steps: int = 3) -> tuple[Any, Any]:
    """A policy for the fake simulator's pictures, and a preprocessor that stands in for its tokenizer.

    Args:
        folder: where the backbone's configuration goes.
        monkeypatch: pytest's; the backbone's tokenizer is replaced by the two ids that the policy reads.
    """
    import torch
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies import get_policy_class, make_policy_config
    from lerobot.policies.smolvla import smolvlm_with_expert
    from transformers import SmolVLMConfig

    sizes = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 2}
    SmolVLMConfig(
        vision_config={**sizes, "num_attention_heads": 2, "image_size": 32, "patch_size": 8},
        text_config={
            **sizes, "model_type": "llama", "num_attention_heads": 2, "num_key_value_heads": 1,
            "head_dim": 16, "vocab_size": 40, "pad_token_id": 0,
        },
        scale_factor=2,
    ).save_pretrained(folder)  # fmt: skip
    ids = SimpleNamespace(tokenizer=SimpleNamespace(fake_image_token_id=1, global_image_token_id=2))
    monkeypatch.setattr(smolvlm_with_expert, "AutoProcessor", SimpleNamespace(from_pretrained=lambda *_: ids))
    config = make_policy_config(
        "smolvla",
        input_features={
            "observation.image": PolicyFeature(FeatureType.VISUAL, (3, 32, 32)),
            "observation.state": PolicyFeature(FeatureType.STATE, (4,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        device="cpu", push_to_hub=False, load_vlm_weights=False, vlm_model_name=str(folder),
        resize_imgs_with_padding=(32, 32), chunk_size=chunk, n_action_steps=n_action_steps, num_steps=2,
        num_vlm_layers=2, max_state_dim=8, max_action_dim=5, self_attn_every_n_layers=2,
    )  # fmt: skip
    torch.manual_seed(0)
    policy = get_policy_class("smolvla")(config).float()
    policy.eval()

    def preprocessor(batch: dict) -> dict:
        count = batch["observation.state"].shape[0]
        batch["observation.state"] = batch["observation.state"].float()
        batch["observation.language.tokens"] = torch.tensor([[5, 6, 7]] * count)
        batch["observation.language.attention_mask"] = torch.ones(count, 3, dtype=torch.bool)
        return batch

    return policy, preprocessor
