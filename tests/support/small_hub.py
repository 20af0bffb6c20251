"""A Hugging Face cache with what the policy families load by a hard-coded name, tiny and random: tokenizers,
the Wan VAE and its text encoder. Tests stay offline and LeRobot's loaders stay untouched."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

TEXT_WIDTH = 16
"""Width of the tiny UMT5's embeddings."""
PALIGEMMA, UMT5 = "google/paligemma-3b-pt-224", "google/umt5-xxl"
WAN, SMOLVLM = "Wan-AI/Wan2.2-TI2V-5B-Diffusers", "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"
BART = "facebook/bart-large"


def make_hub(cache: Path) -> Path:
    """Fills a cache folder in `huggingface_hub`'s own layout; point `HF_HUB_CACHE` at it."""
    for repo, model_type in ((PALIGEMMA, "paligemma"), (UMT5, "umt5"), (BART, "bart")):
        folder = _repo(cache, repo)
        _tokenizer(folder)
        (folder / "config.json").write_text(json.dumps({"model_type": model_type}))
    wan = _repo(cache, WAN)
    _tokenizer(wan / "tokenizer")
    _wan(wan)
    _smolvlm(_repo(cache, SMOLVLM))
    return cache


def snapshot(cache: Path, repo: str) -> Path:
    """Where the cache holds a repository's files."""
    return cache / f"models--{repo.replace('/', '--')}" / "snapshots" / ("0" * 40)


def _repo(cache: Path, repo: str) -> Path:
    folder = snapshot(cache, repo)
    folder.mkdir(parents=True)
    refs = folder.parents[1] / "refs"
    refs.mkdir()
    (refs / "main").write_text("0" * 40)
    return folder


def _tokenizer(folder: Path, extra: dict[str, str] | None = None) -> Any:
    """One token a character; any text can be distinguished from any other."""
    from tokenizers import Tokenizer, decoders, models
    from transformers import PreTrainedTokenizerFast

    special = ["<pad>", "</s>", "<unk>", "<s>", *(extra or {}).values()]
    letters = [chr(c) for c in range(32, 127)]
    # Unigram, because LeRobot's LingBot-VA loads its tokenizer as T5's, which knows nothing else.
    tokenizer = Tokenizer(models.Unigram([(token, -1.0) for token in [*special, *letters]], unk_id=2))
    tokenizer.decoder = decoders.Fuse()
    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", unk_token="<unk>", bos_token="<s>", eos_token="</s>",
        **({"extra_special_tokens": extra} if extra else {}),
    )  # fmt: skip
    fast.save_pretrained(folder)
    return fast


def _wan(folder: Path) -> None:
    import torch
    from diffusers import AutoencoderKLWan
    from transformers import UMT5Config, UMT5EncoderModel

    torch.manual_seed(0)
    AutoencoderKLWan(
        base_dim=4, z_dim=48, dim_mult=[1, 1, 1, 1], num_res_blocks=1, is_residual=True, patch_size=2,
        in_channels=12, out_channels=12, scale_factor_spatial=16, latents_mean=[0.0] * 48,
        latents_std=[1.0] * 48,
    ).save_pretrained(folder / "vae")  # fmt: skip
    UMT5EncoderModel(
        UMT5Config(
            vocab_size=120, d_model=TEXT_WIDTH, d_kv=8, d_ff=16, num_layers=1, num_heads=2,
            relative_attention_num_buckets=4,
        )
    ).save_pretrained(folder / "text_encoder")  # fmt: skip


def _smolvlm(folder: Path) -> None:
    from transformers import (
        SmolVLMConfig,
        SmolVLMImageProcessor,
        SmolVLMProcessor,
        SmolVLMVideoProcessor,
    )

    sizes = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 2}
    SmolVLMConfig(
        vision_config={**sizes, "num_attention_heads": 2, "image_size": 32, "patch_size": 8},
        text_config={
            **sizes, "model_type": "llama", "num_attention_heads": 2, "num_key_value_heads": 1,
            "head_dim": 16, "vocab_size": 120, "pad_token_id": 0,
        },
        scale_factor=2,
    ).save_pretrained(folder)  # fmt: skip
    marks = {
        "fake_image_token": "<fake_token_around_image>", "global_image_token": "<global-img>",
        "image_token": "<image>", "end_of_utterance_token": "<end_of_utterance>",
    }  # fmt: skip
    tokenizer = _tokenizer(folder, marks)
    SmolVLMProcessor(SmolVLMImageProcessor(), tokenizer, SmolVLMVideoProcessor()).save_pretrained(folder)
