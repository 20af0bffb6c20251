"""The policy families of the paper that LeRobot knows by itself, small and random, saved as `lerobot-train`
saves them: `config.json`, weights, both processors with their statistics."""

from __future__ import annotations

import json
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

from tests.support.small_hub import TEXT_WIDTH, WAN, snapshot

FAMILIES = ("pi0", "pi05", "smolvla", "xvla", "fastwam", "lingbot_va")
IMAGE = "observation.images.image"
SIDE = 32
"""Pixels of the square pictures that the policies are declared for."""


def save_family(
    folder: Path,
    family: str,
    hub: Path,
    *,
    state: int = 4,
    action: int = 2,
    images: tuple[str, ...] = (IMAGE,),
    stats: dict[str, dict[str, Any]] | None = None,
    **changes: Any,
) -> Path:
    """Saves a checkpoint.

    Args:
        folder: where to.
        family: one of `FAMILIES`.
        hub: cache made by `small_hub.make_hub`; `fix_sizes` must hold for pi0 and pi05.
        state: width of `observation.state`.
        action: width of the action.
        images: camera keys.
        stats: statistics of the processors; by default mean 0, std 1, and -1 to 1.
        changes: of the policy's configuration.
    """
    import torch
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies import get_policy_class, make_policy_config, make_pre_post_processors

    height, width = (SIDE, SIDE * len(images)) if family == "fastwam" else (SIDE, SIDE)
    picture = PolicyFeature(FeatureType.VISUAL, (3, SIDE, SIDE))
    common = {
        "input_features": {
            **dict.fromkeys(images, picture),
            "observation.state": PolicyFeature(FeatureType.STATE, (state,)),
        },
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (action,))},
        "device": "cpu",
        "push_to_hub": False,
    }  # fmt: skip
    own = _SIZES[family](hub, state, action, (height, width), images)
    config = make_policy_config(family, **{**common, **own, **changes})
    torch.manual_seed(0)
    policy = get_policy_class(family)(config).float()
    with torch.no_grad():  # so that two observations give two clearly different actions
        for name, parameter in policy.named_parameters():
            parameter.copy_(torch.randn_like(parameter) * 0.3 if "norm" not in name else parameter)
    shapes = {"observation.state": (state,), "action": (action,)} | dict.fromkeys(images, (3, 1, 1))
    stats = stats or {key: unit_stats(shape) for key, shape in shapes.items()}
    preprocessor, postprocessor = make_pre_post_processors(config, dataset_stats=stats)
    policy.save_pretrained(folder)
    preprocessor.save_pretrained(folder)
    postprocessor.save_pretrained(folder)
    return folder


def unit_stats(shape: tuple[int, ...]) -> dict[str, Any]:
    """Mean 0, deviation 1, from -1 to 1."""
    import torch

    one = torch.ones(shape)
    return {"mean": 0 * one, "std": one, "min": -one, "max": one, "q01": -one, "q99": one}


def edit_config(folder: Path, **changes: Any) -> Path:
    """Changes fields of a saved checkpoint's `config.json`."""
    file = folder / "config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    return folder


def fix_sizes(setattr_: Callable[..., None]) -> None:
    """Makes pi0 and pi05 build small backbones: LeRobot fixes their sizes in code.

    Args:
        setattr_: `monkeypatch.setattr`.
    """
    from lerobot.policies import pi_gemma
    from lerobot.policies.pi0 import modeling_pi0
    from lerobot.policies.pi05 import modeling_pi05

    def small_vlm(config: Any) -> Any:
        config = deepcopy(config)
        for key, value in {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1,
                           "num_attention_heads": 2, "projection_dim": _WIDTH}.items():  # fmt: skip
            setattr(config.vision_config, key, value)
        config.vision_config.patch_size = SIDE // 2
        config.text_config.vocab_size = 120
        return pi_gemma.PaliGemmaForConditionalGenerationWithPiGemma(config=config)

    def small_expert(config: Any) -> Any:
        config = deepcopy(config)
        config.vocab_size = 120
        return pi_gemma.PiGemmaForCausalLM(config=config)

    for module in (modeling_pi0, modeling_pi05):
        make = module.GemmaConfig

        def sizes(variant: str, make: Any = make) -> Any:
            return make(width=_WIDTH, depth=2, mlp_dim=32, num_heads=2, num_kv_heads=1, head_dim=16)

        setattr_(module, "get_gemma_config", sizes)
        setattr_(module, "PaliGemmaForConditionalGenerationWithPiGemma", lambda config: small_vlm(config))
        setattr_(module, "PiGemmaForCausalLM", lambda config: small_expert(config))


_WIDTH = 32
type _Size = tuple[int, int]


def _pi(hub: Path, state: int, action: int, size: _Size, images: tuple[str, ...]) -> dict[str, Any]:
    return {
        "image_resolution": (SIDE, SIDE), "chunk_size": 6, "n_action_steps": 3, "num_inference_steps": 2,
        "max_state_dim": 32, "max_action_dim": 8, "tokenizer_max_length": 64,
    }  # fmt: skip


def _smolvla(hub: Path, state: int, action: int, size: _Size, images: tuple[str, ...]) -> dict[str, Any]:
    return {
        "load_vlm_weights": False, "resize_imgs_with_padding": (SIDE, SIDE), "chunk_size": 6,
        "n_action_steps": 3, "num_steps": 2, "num_vlm_layers": 2, "max_state_dim": 32, "max_action_dim": 16,
        "self_attn_every_n_layers": 2,
    }  # fmt: skip


def _xvla(hub: Path, state: int, action: int, size: _Size, images: tuple[str, ...]) -> dict[str, Any]:
    vision = {
        "embed_dim": [8, 8], "num_heads": [2, 2], "num_groups": [2, 2], "depths": [1, 1],
        "patch_size": [7, 3], "patch_stride": [4, 2], "patch_padding": [3, 1],
        "patch_prenorm": [False, True], "window_size": 4,
        "projection_dim": 16, "max_position_embeddings": 20, "max_temporal_embeddings": 10,
    }  # fmt: skip
    text = {
        "model_type": "bart", "vocab_size": 120, "d_model": 16, "encoder_layers": 1, "decoder_layers": 1,
        "encoder_attention_heads": 2, "decoder_attention_heads": 2, "encoder_ffn_dim": 16,
        "decoder_ffn_dim": 16, "max_position_embeddings": 200, "pad_token_id": 0,
    }  # fmt: skip
    return {
        "florence_config": {"vision_config": vision, "text_config": text}, "action_mode": "auto",
        "resize_imgs_with_padding": (SIDE, SIDE),
        "max_action_dim": 20, "max_state_dim": 20, "hidden_size": 16, "depth": 1, "num_heads": 2,
        "len_soft_prompts": 2, "chunk_size": 6, "n_action_steps": 3, "num_denoising_steps": 2,
        "tokenizer_max_length": 32, "max_len_seq": 128,
    }  # fmt: skip


def _fastwam(hub: Path, state: int, action: int, size: _Size, images: tuple[str, ...]) -> dict[str, Any]:
    shared = {
        "num_heads": 2, "attn_head_dim": 12, "num_layers": 1, "text_dim": TEXT_WIDTH, "freq_dim": 16,
        "eps": 1e-6, "ffn_dim": 16,
    }  # fmt: skip
    video = {
        "patch_size": [1, 2, 2], "in_dim": 48, "hidden_dim": 24, "out_dim": 48, "seperated_timestep": True,
        "video_attention_mask_mode": "first_frame_causal", "action_conditioned": False, "action_dim": action,
        "action_group_causal_mask_mode": "group_diagonal",
    }  # fmt: skip
    return {
        "action_dim": action, "proprio_dim": state, "action_horizon": 4, "n_action_steps": 3,
        "num_video_frames": 5, "action_video_freq_ratio": 1, "image_size": size, "context_len": 8,
        "tokenizer_max_len": 64, "torch_dtype": "float32", "num_inference_steps": 2, "base_model_id": None,
        "video_dit_config": {**shared, **video},
        "action_dit_config": {**shared, "action_dim": action, "hidden_dim": 16},
    }  # fmt: skip


def _lingbot_va(hub: Path, state: int, action: int, size: _Size, images: tuple[str, ...]) -> dict[str, Any]:
    return {
        "num_attention_heads": 2, "attention_head_dim": 12, "text_dim": TEXT_WIDTH, "freq_dim": 16,
        "ffn_dim": 16, "num_layers": 1, "rope_max_seq_len": 64,
        "wan_pretrained_path": str(snapshot(hub, WAN)), "dtype": "float32",
        "obs_cam_keys": list(images), "height": SIDE, "width": SIDE,
        "frame_chunk_size": 2, "attn_window": 8, "num_inference_steps": 2, "action_num_inference_steps": 2,
        "max_sequence_length": 32, "used_action_channel_ids": list(range(action)),
    }  # fmt: skip


_SIZES: dict[str, Callable[..., dict[str, Any]]] = {
    "pi0": _pi,
    "pi05": _pi,
    "smolvla": _smolvla,
    "xvla": _xvla,
    "fastwam": _fastwam,
    "lingbot_va": _lingbot_va,
}
