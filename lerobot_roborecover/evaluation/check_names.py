"""What a checkpoint's own description tells about a mistake: names and shapes of features, cameras crosswise,
statistics that are missing, weights that were not loaded, horizons other than the paper's; and what to do
where the environment does not give an input."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType, NormalizationMode, PreTrainedConfig
from lerobot.utils.constants import ACTION

from lerobot_roborecover.evaluation.check_numbers import Stats, statistics_problem
from lerobot_roborecover.evaluation.env_configs import RecoveryEnvConfig
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.findings import Check, failure, ok, warning
from lerobot_roborecover.policies.load_problems import other_action_width

PAPER_HORIZON: Mapping[tuple[str, str], int] = {
    ("pi0", "libero"): 5,
    ("pi05", "libero"): 5,
    ("fastwam", "libero"): 10,
    ("smolvla", "robotwin"): 50,
    ("pi05", "robotwin"): 32,
}
"""Actions that the paper's release executes of a chunk (policies/eval)."""
_SCENE = re.compile(r"agent|scene|head|high|top|front|primary|base|third|static|exterior", re.IGNORECASE)
_WRIST = re.compile(r"wrist|hand|gripper|in_hand|ego", re.IGNORECASE)
_NEEDED = {
    NormalizationMode.MEAN_STD: ("mean", "std"),
    NormalizationMode.MIN_MAX: ("min", "max"),
    NormalizationMode.QUANTILES: ("q01", "q99"),
    NormalizationMode.QUANTILE10: ("q10", "q90"),
}

BLANK = "empty_camera"
"""Part of the name of inputs that a policy fills with a blank picture by itself."""


def _where(name: str) -> str:
    name = name.removeprefix("observation.images.").replace("eye_in_hand", "wrist")
    if name in ("left_camera", "right_camera") or _WRIST.search(name):
        return "wrist"
    return "scene" if _SCENE.search(name) else ""


def _side(name: str) -> str:
    found = re.findall(r"left|right", name, re.IGNORECASE)
    return found[0].lower() if len(found) == 1 else ""


def check_camera_names(cameras: Mapping[str, str]) -> Check:
    """Cameras that go to a policy's input of another kind.

    Args:
        cameras: the policy's key of each of the simulator's cameras, after all renaming.
    """
    shown = ", ".join(f"{c} -> {k.removeprefix('observation.images.')}" for c, k in cameras.items())
    crossed = []
    for camera, key in cameras.items():
        ours, theirs = _where(camera), _where(key)
        sides = _side(camera), _side(key)
        if (ours and theirs and ours != theirs) or (all(sides) and sides[0] != sides[1]):
            crossed.append(f"{camera} goes to {key}")
    if crossed:
        return failure(
            "cameras by name", "; ".join(crossed), "a scene camera for a scene input, left for left",
            "correct --rename_map (or --env.camera_name_mapping): pictures in the wrong input are the most "
            "expensive mistake there is",
        )  # fmt: skip
    numbers = {c: re.findall(r"(\d+)$", k) for c, k in cameras.items()}
    order = sorted(cameras, key=lambda c: int(numbers[c][0]) if numbers[c] else 0)
    first = next((c for c in order if _where(c)), None)
    if first is not None and _where(first) == "wrist" and any(_where(c) == "scene" for c in cameras):
        return warning(
            "cameras by name", shown, "the scene camera first, where inputs are only numbered",
            "if the checkpoint was trained with the scene camera as its first, correct --rename_map",
        )  # fmt: skip
    return ok("cameras by name", shown or "no pictures")


def check_features(
    wanted: Mapping[str, Any], given: Mapping[str, tuple[int, ...]], kind: str, remedy: str
) -> Check:
    """The policy's inputs against what the env gives.

    Args:
        wanted: the checkpoint's `input_features`.
        given: shapes of the observation as the policy's preprocessor gets it, after renaming.
        kind: policy type.
        remedy: what gives the inputs that are missing (`input_remedy`).
    """
    have = ", ".join(f"{k} {tuple(s)}" for k, s in given.items())
    problems, missing_pictures, pictures = [], [], 0
    for key, feature in wanted.items():
        shape = given.get(key)
        if feature.type is FeatureType.VISUAL:
            pictures += 1
            if shape is None and BLANK not in key:
                missing_pictures.append(key)
        elif shape is None:
            problems.append(f"{key} {tuple(feature.shape)} is missing")
        elif kind != "xvla" and tuple(shape) != tuple(feature.shape):
            problems.append(f"{key} has shape {tuple(shape)}, the checkpoint reads {tuple(feature.shape)}")
    if pictures and len(missing_pictures) == pictures:
        problems.append(f"none of its pictures is there: {', '.join(missing_pictures)}")
    if problems:
        return failure(
            "inputs", "; ".join(problems), "what the checkpoint was trained on",
            f"{remedy or 'take a checkpoint for this robot'}. The env gives {have}",
        )  # fmt: skip
    if missing_pictures:
        return warning(
            "inputs", f"not given: {', '.join(missing_pictures)}", "every camera it was trained on",
            f"{remedy}. Most policies take a blank picture in its place. The env gives {have}",
        )  # fmt: skip
    if kind in ("act", "diffusion", "vqbet", "tdmpc"):
        for key, feature in wanted.items():
            if feature.type is FeatureType.VISUAL and tuple(given[key]) != tuple(feature.shape):
                return warning(
                    "inputs", f"{key} is {tuple(given[key])}", f"{tuple(feature.shape)}, as in training",
                    f"{kind} does not resize: give --env.observation_height={feature.shape[1]} "
                    f"--env.observation_width={feature.shape[2]}",
                )  # fmt: skip
    return ok("inputs", f"{len(wanted)} features present")


def check_action_width(saved: PreTrainedConfig, width: int) -> Check:
    """The checkpoint's own action width against the env's; LeRobot cuts or pads without a word.

    Args:
        saved: the checkpoint's configuration, as saved.
        width: the env's.
    """
    own = other_action_width(saved, width)
    if own is None:
        return ok("action width", str(width))
    return failure(
        "action width", f"{own}", f"{width}",
        "the checkpoint is for another robot or another kind of action"
        + (" (RoboTwin: 14 is --env.action_mode=joint, 16 is ee)" if {own, width} <= {14, 16} else ""),
    )  # fmt: skip


def statistics_of(pipeline: Any) -> tuple[dict[str, Stats], dict[FeatureType, NormalizationMode]]:
    """Statistics and modes of a pipeline's normaliser; empty without one."""
    for step in getattr(pipeline, "steps", ()):
        if hasattr(step, "norm_map"):
            stats = step.state_dict()  # "<feature>.<statistic>" tensors
            found: dict[str, dict[str, np.ndarray]] = {}
            for name, tensor in stats.items():
                key, statistic = name.rsplit(".", 1)
                found.setdefault(key, {})[statistic] = tensor.float().cpu().numpy()
            return {**found}, dict(step.norm_map)
    return {}, {}


def check_statistics(pre: Any, post: Any, wanted: Mapping[str, Any], width: int) -> Check:
    """Whether states and actions can be normalised as the checkpoint says they are.

    Args:
        pre: the policy's preprocessor.
        post: its postprocessor.
        wanted: the checkpoint's `input_features`.
        width: values in its action.
    """
    problems, modes = [], []
    in_stats, in_modes = statistics_of(pre)
    out_stats, out_modes = statistics_of(post)
    for key, feature in wanted.items():
        mode = in_modes.get(feature.type, NormalizationMode.IDENTITY)
        if feature.type is FeatureType.VISUAL or mode not in _NEEDED:
            continue
        modes.append(f"{key} {mode.name}")
        problem = statistics_problem(in_stats.get(key), _NEEDED[mode], feature.shape[0])
        problems += [f"{key} ({mode.name}): {problem}"] if problem else []
    mode = out_modes.get(FeatureType.ACTION, NormalizationMode.IDENTITY)
    if mode in _NEEDED:
        modes.append(f"action {mode.name}")
        problem = statistics_problem(out_stats.get(ACTION), _NEEDED[mode], width)
        problems += [f"action ({mode.name}): {problem}"] if problem else []
    if problems:
        return failure(
            "normalisation", "; ".join(problems), "statistics of the training data for each",
            "take the checkpoint's processor files with their .safetensors from where it was trained, or "
            "make them from its dataset: lerobot.policies.make_pre_post_processors with dataset_stats",
        )  # fmt: skip
    return ok("normalisation", ", ".join(modes) or "none: values go to the policy as they are")


def check_weights(policy: torch.nn.Module, path: str) -> Check:
    """Whether the model holds the checkpoint's numbers: LeRobot's π0 and π0.5 go on with random weights when
    theirs cannot be read (`modeling_pi05.from_pretrained`, "Returning model without loading").

    Args:
        policy: as loaded.
        path: of the checkpoint.
    """
    from safetensors import safe_open

    file = _weights_file(path)
    if file is None:
        return ok("weights", "not checked: no model.safetensors of its own (an adapter, or a server)")
    state = policy.state_dict()
    same = found = 0
    with safe_open(str(file), framework="pt") as saved:
        names = sorted(saved.keys())
        for name in names[:: max(len(names) // 40, 1)]:
            here = next(
                (state[n] for n in (name, f"model.{name}", name.removeprefix("model.")) if n in state), None
            )
            tensor = saved.get_tensor(name)
            if here is None or here.shape != tensor.shape or (tensor == tensor.reshape(-1)[:1]).all():
                continue  # unknown under this name, or constant: tells nothing
            found += 1
            same += int((here.detach().cpu() == tensor.to(here.dtype)).all())
    if found and not same:
        return failure(
            "weights", f"none of {found} tensors looked at is the checkpoint's", "all of them",
            f"the policy has random weights: look for 'Could not load state dict' above. {file.name} is "
            "damaged, or of another LeRobot version",
        )  # fmt: skip
    if same < found or not found:
        return warning(
            "weights", f"{same} of {found} tensors looked at are the checkpoint's", "all of them",
            "some were renamed or left random while loading: look for missing keys above",
        )  # fmt: skip
    return ok("weights", f"{found} tensors looked at are the checkpoint's")


def _weights_file(path: str) -> Path | None:
    local = Path(path) / "model.safetensors"
    if local.is_file():
        return local
    from huggingface_hub import try_to_load_from_cache
    from huggingface_hub.errors import HFValidationError

    try:
        cached = try_to_load_from_cache(path, "model.safetensors")
    except HFValidationError:
        return None
    return Path(cached) if isinstance(cached, str) else None


def check_horizon(config: PreTrainedConfig, platform: str, shortest: int) -> Check:
    """How much of a chunk is executed without looking.

    Args:
        config: the policy's.
        platform: `libero`, ...
        shortest: fewest steps of any chosen scenario.
    """
    executed = getattr(config, "n_action_steps", None)
    chunk = getattr(config, "chunk_size", None) or getattr(config, "action_horizon", None)
    kind = getattr(config, "type", "")
    if executed is None:
        return ok("execution horizon", "the policy does not say")
    value = f"{executed} of {chunk} actions" if chunk else f"{executed} actions"
    paper = PAPER_HORIZON.get((kind, platform))
    if executed > shortest:
        return warning(
            "execution horizon", value, f"under the {shortest} steps that the shortest task has",
            "the policy looks once and never again: give --policy.n_action_steps",
        )  # fmt: skip
    if paper is not None and executed != paper:
        return warning(
            "execution horizon", value, f"{paper}, as the paper's release runs {kind} on {platform}",
            f"--policy.n_action_steps={paper}, or know that rows will not compare with the paper's",
        )  # fmt: skip
    return ok("execution horizon", value)


def inputs_of(env: RecoveryEnvConfig, rename_map: Mapping[str, str]) -> dict[str, FeatureType]:
    """Kind of each of an environment's observations, by the policy's name of it.

    Args:
        env: says what is observed.
        rename_map: the env's observation keys to the policy's.
    """
    found = {}
    for key, feature in env.features.items():
        if feature.type is not FeatureType.ACTION:
            name = env.features_map.get(key, key)
            found[rename_map.get(name, name)] = feature.type
    return found


def missing_inputs(wanted: Mapping[str, Any], given: Collection[str]) -> list[str]:
    """Inputs of a policy that are not given, those aside that it fills in by itself.

    Args:
        wanted: the checkpoint's `input_features`.
        given: names of what there is.
    """
    return [key for key in wanted if key not in given and BLANK not in key]


def input_remedy(
    env: RecoveryEnvConfig,
    wanted: Mapping[str, Any],
    rename_map: Mapping[str, str],
    observed: Collection[str] | None = None,
) -> str:
    """Returns what to do: the env option that gives what is missing, the map of a camera of another name, or
    which checkpoint to take instead. Empty where nothing is missing.

    Args:
        env: what was asked for.
        wanted: the checkpoint's `input_features`.
        rename_map: the env's observation keys to the policy's.
        observed: names in a real observation, after renaming; by default what `env` says there is.
    """
    kinds = inputs_of(env, rename_map)
    given = list(kinds if observed is None else observed)
    missing = missing_inputs(wanted, given)
    if not missing:
        return ""
    for name, value in platform_named(env.platform_name).observation_options:
        other = _with_option(env, name, value)
        if other is not None and not missing_inputs(wanted, inputs_of(other, rename_map)):
            return f"give --env.{name}={json.dumps(value) if isinstance(value, bool) else value}"
    cameras = [key for key in given if kinds.get(key) is FeatureType.VISUAL]
    pictures = [key for key in missing if wanted[key].type is FeatureType.VISUAL]
    spare = [key for key in cameras if key not in wanted]
    if pictures and len(spare) >= len(pictures) and len(pictures) == len(missing):
        ours = {new: old for old, new in rename_map.items()}
        renamed = {ours.get(key, key): theirs for key, theirs in zip(spare, pictures, strict=False)}
        both = json.dumps({**{k: v for k, v in rename_map.items() if v not in spare}, **renamed})
        return (
            f"if the views are the same, give --rename_map='{both}'; else take a checkpoint that was trained "
            f"on {', '.join(cameras)}"
        )
    has = ", ".join(sorted(kinds if observed is None else given)) or "nothing"
    return (
        f"no option of {env.type} gives {', '.join(missing)}: take a checkpoint whose inputs are among what "
        f"it gives ({has})"
    )


def _with_option(env: RecoveryEnvConfig, name: str, value: Any) -> RecoveryEnvConfig | None:
    """The same env type with another option; None where it has the option so, or refuses it."""
    if not hasattr(env, name) or getattr(env, name) == value:
        return None
    base = getattr(env, "base", None)
    try:
        return type(env)(**({} if base is None else {"base": base}), **{name: value})
    except Exception:  # a platform's own configuration may refuse in any way
        return None
