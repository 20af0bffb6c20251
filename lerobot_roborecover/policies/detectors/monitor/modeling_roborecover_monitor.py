"""The Qwen3-VL monitor: a vision-language model with LoRA adapters that answers "0" or "1" to a frame."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from lerobot_roborecover.policies.detectors.base import Answers
from lerobot_roborecover.policies.detectors.interface import TASK, DetectorError
from lerobot_roborecover.policies.detectors.monitor.base import MonitorRewardModel
from lerobot_roborecover.policies.detectors.monitor.configuration_roborecover_monitor import (
    RoboRecoverMonitorConfig,
)

logger = logging.getLogger(__name__)

ADAPTER_FILE, ADAPTER_CONFIG_FILE = "adapter_model.safetensors", "adapter_config.json"
"""peft's names, so that the adapters can be merged and served by other tools."""
ANSWERS = ("0", "1")


class _WithGradients(torch.autograd.Function):
    """A loss whose gradients are known already."""

    @staticmethod
    def forward(ctx: Any, loss: Tensor, gradients: Sequence[Tensor], *parameters: Tensor) -> Tensor:
        """The loss; `gradients` are its derivatives by the parameters."""
        ctx.gradients = gradients
        return loss.clone()

    @staticmethod
    def backward(ctx: Any, *outer: Tensor) -> tuple[Tensor | None, ...]:
        """The parameters' gradients, times what the loss was scaled by."""
        return None, None, *(g * outer[0] for g in ctx.gradients)


class RoboRecoverMonitorRewardModel(MonitorRewardModel):
    """One forward pass a frame: the answer is the most likely next token of the whole vocabulary.

    Anything but "0" and "1" is an answer that could not be read, and never triggers.
    """

    config_class = RoboRecoverMonitorConfig
    name = "roborecover_monitor"
    weights_file = ADAPTER_FILE
    config: RoboRecoverMonitorConfig

    def __init__(
        self,
        config: RoboRecoverMonitorConfig,
        dataset_stats: Any = None,
        dataset_meta: Any = None,
        **_: Any,
    ):
        super().__init__(config, dataset_stats, dataset_meta)
        from peft import LoraConfig, get_peft_model

        base, self.processor = load_base(config)
        self.answer_ids = [answer_id(self.processor.tokenizer, a) for a in ANSWERS]
        found = base_fingerprint(base)
        if config.base_fingerprint and config.base_fingerprint != found:
            raise DetectorError(
                f"the adapters were trained on another base than {config.base_model!r} (fingerprint "
                f"{config.base_fingerprint[:12]}, here {found[:12]}). Put the right "
                "base_model and base_revision into the checkpoint's config.json, or give --base-model"
            )
        config.base_fingerprint = found
        base.requires_grad_(False)
        if config.gradient_checkpointing:
            base.gradient_checkpointing_enable({"use_reentrant": False})
        lora = LoraConfig(
            r=config.lora_rank,
            lora_alpha=config.lora_alpha,
            lora_dropout=config.lora_dropout,
            # The language model alone; the vision encoder stays frozen.
            target_modules=rf".*language_model.*\.({'|'.join(config.lora_targets)})",
            task_type="CAUSAL_LM",
            base_model_name_or_path=config.base_model,
            revision=config.base_revision,
        )
        try:
            self.model = get_peft_model(base, lora, autocast_adapter_dtype=True)
        except ValueError as err:
            raise DetectorError(f"lora_targets={config.lora_targets}: {err}") from None

    def get_optim_params(self) -> list[nn.Parameter]:
        """The adapters alone."""
        return [p for p in self.model.parameters() if p.requires_grad]

    # --- training

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Any]]:
        """Cross-entropy of the answer over the whole vocabulary, mean over the batch.

        The batch is worked off in pieces of `micro_batch_size`. In training each piece's gradient is worked
        out here, as soon as its loss is there, and `backward` hands out their sum. So memory is that of one
        piece, nothing is computed twice but what `gradient_checkpointing` asks for, and the gradient is the
        whole batch's, from one `backward`: all that LeRobot's training loop calls.
        """
        labels = self.labels(batch)
        count = len(labels)
        size = self.config.micro_batch_size
        total = torch.zeros((), device=self._device)
        in_pieces = self.training and torch.is_grad_enabled() and count > size
        adapters, gradients = self.get_optim_params(), None
        right = unreadable = 0
        for start in range(0, count, size):
            rows = slice(start, start + size)
            inputs = self._inputs(batch, rows)
            targets = torch.tensor([self.answer_ids[int(v)] for v in labels[rows]], device=self._device)
            loss, best = self._piece(inputs, targets)
            loss = loss / count
            if in_pieces:
                with torch.autocast(self._device.type, enabled=False):  # the caller's is for forward passes
                    found = torch.autograd.grad(loss, adapters)
                gradients = (
                    found if gradients is None else [a + b for a, b in zip(gradients, found, strict=True)]
                )
                loss = loss.detach()
            total = total + loss
            right += int((best == targets).sum())
            unreadable += int((~torch.isin(best, torch.tensor(self.answer_ids, device=self._device))).sum())
        if gradients is not None:
            total = _WithGradients.apply(total, gradients, *adapters)
        return total, {
            "accuracy": right / count, "unparsed": unreadable / count, "positives": labels.mean().item(),
        }  # fmt: skip

    def _piece(self, inputs: dict[str, Tensor], targets: Tensor) -> tuple[Tensor, Tensor]:
        """Summed cross-entropy of a piece, and its answers."""
        logits = self._logits(inputs)
        loss = nn.functional.cross_entropy(logits, targets, reduction="sum")
        return loss, logits.detach().argmax(dim=1)

    # --- inference

    @torch.no_grad()
    def answer(self, batch: Mapping[str, Any]) -> Answers:
        """The strict answer, and p("1") / (p("0") + p("1")) as its score."""
        count = len(batch[next(iter(self.config.input_features))]) if self._has_inputs(batch) else 0
        parts = []
        for start in range(0, count, self.config.max_batch):
            autocast = torch.autocast(
                self._device.type, torch.bfloat16, enabled=self.config.dtype == "bfloat16"
            )
            with autocast:
                logits = self._logits(self._inputs(batch, slice(start, start + self.config.max_batch)))
            parts.append(logits)
        logits = torch.cat(parts)
        zero, one = self.answer_ids
        best = logits.argmax(dim=1)
        scores = torch.softmax(logits[:, [zero, one]], dim=1)[:, 1]
        parsed = (best == zero) | (best == one)
        if self.config.threshold is None:
            decisions = best == one
        else:
            decisions = parsed & (scores > self.config.threshold)
        return Answers(scores, decisions, parsed)

    def _has_inputs(self, batch: Mapping[str, Any]) -> bool:
        self.check_inputs(batch)
        return True

    def _logits(self, inputs: dict[str, Tensor]) -> Tensor:
        """(B, V) float32 logits of the answer."""
        return self.model(**inputs, logits_to_keep=1, use_cache=False).logits[:, -1].float()

    def _inputs(self, batch: Mapping[str, Any], rows: slice) -> dict[str, Tensor]:
        """Chat prompts with their pictures, padded on the left so that every answer comes last."""
        self.check_inputs(batch)
        keys = list(self.config.input_features)
        pictures = [_to_bytes(batch[key][rows], self.config.image_size) for key in keys]
        count = len(pictures[0])
        tasks = batch.get(TASK)
        if tasks is None:
            raise DetectorError("the monitor needs the instruction of every frame; the batch has no 'task'")
        texts = [self._prompt(text, len(keys)) for text in list(tasks)[rows]]
        images = [[column[i] for column in pictures] for i in range(count)]
        encoded = self.processor(
            text=texts, images=images, padding=True, padding_side="left", return_tensors="pt"
        )
        return {k: v.to(self._device) for k, v in encoded.items() if isinstance(v, Tensor)}

    def _prompt(self, instruction: str, cameras: int) -> str:
        content: list[dict[str, str]] = [{"type": "image"}] * cameras
        content.append({"type": "text", "text": self.config.prompt.replace("{instruction}", instruction)})
        return self.processor.apply_chat_template(
            [{"role": "user", "content": content}], tokenize=False, add_generation_prompt=True
        )

    @property
    def _device(self) -> torch.device:
        return next(self.model.parameters()).device

    # --- saving and loading: adapters alone

    def save_weights(self, folder: Path) -> None:
        """Writes the adapters as peft does; the base stays where it is."""
        from peft import get_peft_model_state_dict

        state = get_peft_model_state_dict(self.model, save_embedding_layers=False)
        save_file(
            {k: v.contiguous().cpu() for k, v in state.items()}, folder / ADAPTER_FILE, {"format": "pt"}
        )
        self.model.peft_config["default"].save_pretrained(str(folder))

    def restore(self, weights: Any) -> None:
        from peft import set_peft_model_state_dict

        try:
            result = set_peft_model_state_dict(self.model, weights())
        except RuntimeError as err:
            raise DetectorError(f"{ADAPTER_FILE} does not fit its config.json: {err}") from None
        missing = [k for k in result.missing_keys if "lora_" in k]
        if missing or result.unexpected_keys:
            odd = missing[0] if missing else result.unexpected_keys[0]
            raise DetectorError(
                f"{ADAPTER_FILE} does not fit its config.json: {len(missing)} adapters are missing and "
                f"{len(result.unexpected_keys)} not known, e.g. {odd}"
            )


def load_base(config: RoboRecoverMonitorConfig) -> tuple[Any, Any]:
    """The base model and its processor.

    Raises:
        DetectorError: it cannot be found, or is not a Qwen3-VL model.
    """
    from transformers import AutoConfig, AutoProcessor, Qwen3VLForConditionalGeneration

    revision = config.base_revision or "main"
    try:
        kind = AutoConfig.from_pretrained(config.base_model, revision=revision).model_type
        if kind != "qwen3_vl":
            raise DetectorError(
                f"base_model={config.base_model}: is a {kind!r} model; this monitor is built on Qwen3-VL"
            )
        base = Qwen3VLForConditionalGeneration.from_pretrained(
            config.base_model,
            revision=revision,
            dtype=getattr(torch, config.dtype),
            attn_implementation=config.attention,
        )
        processor = AutoProcessor.from_pretrained(config.base_model, revision=revision)
    except (OSError, ValueError) as err:
        if isinstance(err, DetectorError):
            raise
        raise DetectorError(
            f"base_model={config.base_model}: cannot be loaded ({str(err)[:300]}). Give a Hub id or the "
            "folder of a Qwen3-VL model with its processor, e.g. Qwen/Qwen3-VL-2B-Instruct"
        ) from err
    return base, processor


def answer_id(tokenizer: Any, answer: str) -> int:
    """The one token of an answer.

    Raises:
        DetectorError: the tokenizer splits it.
    """
    ids = tokenizer.encode(answer, add_special_tokens=False)
    if len(ids) != 1:
        raise DetectorError(
            f"the base's tokenizer makes {len(ids)} tokens of {answer!r}; the answer must be one"
        )
    return ids[0]


def base_fingerprint(base: nn.Module) -> str:
    """Hash of a model's shapes and some of its weights; in bfloat16, whatever it was loaded as."""
    parameters = sorted(base.named_parameters())
    shapes = [[name, list(p.shape)] for name, p in parameters]
    digest = hashlib.sha256(json.dumps(shapes).encode())
    for name, parameter in parameters[:: max(len(parameters) // 16, 1)]:
        sample = parameter.detach().reshape(-1)[:1024].to(torch.bfloat16).view(torch.int16).cpu()
        digest.update(name.encode() + sample.numpy().tobytes())
    return digest.hexdigest()


def _to_bytes(pictures: Tensor, longest: int | None) -> Tensor:
    """(B, 3, H, W) uint8, as the image processor expects, brought down in size where asked."""
    pictures = pictures.float()
    height, width = pictures.shape[-2:]
    if longest is not None and max(height, width) > longest:
        scale = longest / max(height, width)
        size = (max(round(height * scale), 1), max(round(width * scale), 1))
        pictures = nn.functional.interpolate(
            pictures, size, mode="bilinear", antialias=True, align_corners=False
        )
    return (pictures.clamp(0, 1) * 255).round().to(torch.uint8)
