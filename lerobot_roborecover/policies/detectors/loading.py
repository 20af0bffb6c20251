"""Detectors by what a user writes: a kind with options, or a checkpoint."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot_roborecover.policies.detectors.base import PREFIX, DetectorRewardModel
from lerobot_roborecover.policies.detectors.files import CONFIG_FILE, find_file
from lerobot_roborecover.policies.detectors.interface import Detector, DetectorError, DetectorNeeds
from lerobot_roborecover.policies.detectors.monitor.base import MonitorRewardModel
from lerobot_roborecover.policies.detectors.probe import PolicyProbe
from lerobot_roborecover.policies.detectors.progress import (
    PROGRESS_TYPES,
    ProgressOptions,
    load_progress,
)

KINDS = (
    "chunk_disagreement", "constant", "elapsed", "no_progress", "oracle", "policy_features", "recovery_gain",
    "state_distance",
)  # fmt: skip
"""Kinds that need no checkpoint; `policy_features`, `recovery_gain` and `state_distance` are fitted before
they are asked."""


def split_options(text: str) -> tuple[str, dict[str, str]]:
    """`WHAT,name=value,...`: what, and its options. A folder whose name holds commas is taken as it stands.

    Raises:
        DetectorError: an option without a name or a value.
    """
    if Path(text).exists():
        return text, {}
    what, *parts = text.split(",")
    options: dict[str, str] = {}
    last = ""
    for part in parts:
        name, equals, value = part.partition("=")
        if not equals and last:  # keys=a,b
            options[last] += f",{part}"
            continue
        if not equals or not name.strip():
            raise DetectorError(f"--detector {text}: {part!r} is no option. Write {what},name=value")
        last = name.strip()
        options[last] = value
    return what, options


def load_detector(
    what: str, device: str | None = None, revision: str | None = None, **overrides: str
) -> Detector:
    """A detector.

    Args:
        what: one of `KINDS` with its options (`constant,rate=0.02`), or a checkpoint, folder or Hub id: a
            monitor, a detector that `roborecover detect evaluate` saved, or a reward model of LeRobot's
            (`PATH,lag=15`).
        device: where it runs.
        revision: of a Hub id.
        overrides: more options, which win.

    Raises:
        DetectorError: it is not there, or an option is none of its.
    """
    from lerobot_roborecover.policies.detectors import register_detectors
    from lerobot_roborecover.policies.detectors.monitor import register_monitors

    register_monitors()
    register_detectors()
    head, options = split_options(what)
    options = {**options, **overrides}
    if head in KINDS and not Path(head).exists():
        return _made(head, device, options)
    kind = _type_of(head, revision)
    if kind in PROGRESS_TYPES:
        own = {k: options.pop(k) for k in list(options) if k in ProgressOptions.__dataclass_fields__}
        config = _config(head, revision, device, options)
        return load_progress(head, config, revision, _progress_options(own))
    if kind in {PREFIX + k for k in KINDS}:
        config = _config(head, revision, device, options)
        cls = _class(kind)
        return cls.from_pretrained(head, config=config, revision=revision)
    try:
        return load_monitor(head, device, revision=revision, **options)
    except DetectorError as err:
        if kind:
            raise
        raise DetectorError(f"{err}. Kinds that need no checkpoint: {', '.join(KINDS)}") from None


def load_monitor(
    path: str, device: str | None = None, revision: str | None = None, **overrides: str
) -> MonitorRewardModel:
    """Loads a monitor by LeRobot's own registry of reward models.

    Args:
        path: folder or Hub id of a checkpoint.
        device: where it runs; None takes what its config says, or what there is.
        revision: of a Hub id.
        overrides: other values of its config, e.g. `threshold="0.7"` or `base_model=FOLDER`.

    Raises:
        DetectorError: it is not there, is not a monitor, or lacks a part.
    """
    from lerobot.configs.rewards import RewardModelConfig

    from lerobot_roborecover.policies.detectors.monitor import register_monitors
    from lerobot_roborecover.utils.plugins import register_plugins

    register_monitors()
    register_plugins()
    file = find_file(path, CONFIG_FILE, revision)
    try:
        kind = json.loads(file.read_text()).get("type")
    except (ValueError, AttributeError) as err:
        raise DetectorError(f"{file} is not a checkpoint's configuration ({err})") from None
    if kind not in RewardModelConfig.get_known_choices():
        known = sorted(k for k in RewardModelConfig.get_known_choices() if k.startswith(PREFIX))
        raise DetectorError(f"{path} is a checkpoint of type {kind!r}; a monitor is one of {known}")
    config = _config(path, revision, device, overrides)
    cls: Any = _class(config.type)
    if not issubclass(cls, MonitorRewardModel):
        raise DetectorError(
            f"{path} is a reward model of type {config.type!r}, which does not judge single frames as a "
            "monitor does; train one with policies/train/monitor_qwen3vl.yaml or monitor_small.yaml"
        )
    return cls.from_pretrained(path, config=config, revision=revision).eval()


def check_needs(
    name: str,
    needs: DetectorNeeds,
    features: Mapping[str, Any],
    probe: PolicyProbe | None,
    truths: tuple[str, ...] = (),
) -> None:
    """Refuses a detector that would not be given what it needs.

    Args:
        name: what the user calls it.
        needs: what the detector needs.
        features: the environment's observations, by LeRobot key.
        probe: reads the acting policy's internals; None where they cannot be read.
        truths: ground truths that the caller knows.

    Raises:
        DetectorError: naming what is missing, what there is, and the remedy.
    """
    for key, feature in needs.features.items():
        if key not in features:
            remedy = (
                "Use --env.obs_type with pictures (--env obs_type=... of detect evaluate), or set "
                "its image_key"
                if key.startswith("observation.image")
                else "See --env.obs_type, or name other keys (keys=...)"
            )
            raise DetectorError(
                f"{name} reads {key}; the environment gives no {key}, only {sorted(features)}. {remedy}"
            )
        own, there = getattr(feature, "shape", None), getattr(features[key], "shape", None)
        vector = own is not None and there is not None and len(own) == 1
        if vector and tuple(own) != tuple(there):
            raise DetectorError(
                f"{name} reads {key} of shape {tuple(own)}; the environment's is {tuple(there)}. Use a "
                "detector of this platform"
            )
    if needs.truth and needs.truth not in truths:
        raise DetectorError(
            f"{name} needs to know the {needs.truth.replace('_', ' ')}, which is unknown while a trial "
            "runs; it can be measured (`roborecover detect evaluate --detector oracle`), not used"
        )
    if needs.of_policy:
        if probe is None:
            raise DetectorError(
                f"{name} looks into the policy that acts, which is not a LeRobot checkpoint in this process. "
                "Use one, or a detector that reads observations alone"
            )
        probe.check(needs, name)


def _made(kind: str, device: str | None, options: Mapping[str, str]) -> DetectorRewardModel:
    import draccus
    from draccus.utils import DecodingError, ParsingError
    from lerobot.configs.rewards import RewardModelConfig

    cls = RewardModelConfig.get_choice_class(PREFIX + kind)
    fields = set(cls.__dataclass_fields__)
    unknown = sorted(set(options) - fields)
    if unknown:
        own = sorted(fields - set(RewardModelConfig.__dataclass_fields__))
        raise DetectorError(f"detector {kind}: no option {unknown[0]!r}; it has {own}")
    given = [f"--{k}={v}" for k, v in options.items()]
    given += [f"--device={device}"] if device else []
    try:
        config = draccus.parse(cls, args=given)
    except (DecodingError, ParsingError, ValueError) as err:
        raise DetectorError(f"detector {kind}: {_reason(err)}") from None
    return _class(PREFIX + kind)(config)


def _class(kind: str) -> type[DetectorRewardModel]:
    from lerobot.rewards import get_reward_model_class

    found: Any = get_reward_model_class(kind)
    return found


def _type_of(path: str, revision: str | None) -> str:
    try:
        file = find_file(path, CONFIG_FILE, revision)
        return str(json.loads(file.read_text()).get("type"))
    except (DetectorError, ValueError, AttributeError):
        return ""  # the monitors' loader says what is wrong with it


def _config(path: str, revision: str | None, device: str | None, options: Mapping[str, str]) -> Any:
    from draccus.utils import DecodingError, ParsingError
    from lerobot.configs.rewards import RewardModelConfig

    given = [f"--{k}={v}" for k, v in options.items()]
    given += [f"--device={device}"] if device else []
    try:
        config = RewardModelConfig.from_pretrained(path, revision=revision, cli_overrides=given)
    except (DecodingError, ParsingError, OSError, ValueError) as err:
        raise DetectorError(f"{path}, with {dict(options) or 'no options'}: {_reason(err)}") from None
    except SystemExit:
        raise DetectorError(f"{path}: options {dict(options)} are not all of its") from None
    config.pretrained_path = str(path)
    return config


def _progress_options(given: Mapping[str, str]) -> ProgressOptions:
    try:
        return ProgressOptions(
            **{k: float(v) if k == "threshold" else int(v) for k, v in given.items()}  # ty: ignore
        )
    except ValueError as err:
        if isinstance(err, DetectorError):
            raise
        raise DetectorError(f"{dict(given)}: lag, stride and max_batch are whole numbers ({err})") from None


def _reason(err: BaseException) -> str:
    while err.__cause__ is not None:
        err = err.__cause__
    return str(err)
