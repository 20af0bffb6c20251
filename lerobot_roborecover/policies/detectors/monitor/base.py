"""Base class of both monitors: detectors that `lerobot-train` trains on labelled frames, and the record of
what they were trained on."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from huggingface_hub import HfApi
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.rewards import RewardModelConfig
from lerobot.utils.constants import REWARD
from lerobot.utils.feature_utils import dataset_to_policy_features
from torch import Tensor

from lerobot_roborecover.policies.detectors.base import DetectorRewardModel
from lerobot_roborecover.policies.detectors.interface import DetectorError, DetectorNeeds
from lerobot_roborecover.utils.temporary import TemporaryFolder

if TYPE_CHECKING:
    from lerobot.configs.train import TrainPipelineConfig

logger = logging.getLogger(__name__)

_NO_LABELS = f"the dataset has no column {REWARD}; make one with `roborecover detect data`"


class MonitorRewardModel(DetectorRewardModel):
    """A detector whose reward is the label: 0 before the recovery point, 1 from it on.

    It looks at the last observation alone, and can be trained on labelled frames.
    """

    config_class: type[RewardModelConfig] = RewardModelConfig
    name: str = "roborecover_monitor_base"
    probabilities = True

    def __init__(self, config: Any, dataset_stats: Any = None, dataset_meta: Any = None, **_: Any):
        super().__init__(config)
        if dataset_meta is not None:
            if REWARD not in dataset_meta.features:
                raise DetectorError(_NO_LABELS)
            self.trained_on = _scenarios_of(dataset_meta)
            choose_features(config, dataset_meta.features)
        if not config.input_features:
            raise DetectorError(
                f"{config.type}: it is not known what the monitor reads. Train it on a dataset, load a "
                "checkpoint, or give input_features"
            )

    # --- the contract of detectors

    @property
    def needs(self) -> DetectorNeeds:
        """The observations that it reads, by LeRobot key."""
        return DetectorNeeds(features=self.config.input_features)

    @property
    def decides(self) -> bool:
        """Its answer decides, with or without a threshold."""
        return True

    # --- the contract of LeRobot

    def compute_reward(self, batch: dict[str, Tensor]) -> Tensor:
        """(B,) float32: the decision, 0 or 1."""
        return self.answer(batch).decisions.float()

    def labels(self, batch: Mapping[str, Any]) -> Tensor:
        """(B,) float32 labels of a training batch.

        Raises:
            DetectorError: the dataset has none, or other values than 0 and 1.
        """
        # LeRobot's processors put the number 0.0 where a batch has no reward.
        if not isinstance(batch.get(REWARD), Tensor):
            raise DetectorError(_NO_LABELS)
        labels = batch[REWARD].reshape(-1).float()
        if not ((labels == 0) | (labels == 1)).all():
            raise DetectorError(
                f"column {REWARD} holds {labels[(labels != 0) & (labels != 1)][0].item():g}; a monitor's "
                "labels are 0 and 1. Make the dataset with `roborecover detect data`"
            )
        return labels

    def check_inputs(self, batch: Mapping[str, Any]) -> None:
        """Refuses observations that lack what the monitor reads, or hold it in another form.

        Raises:
            DetectorError: naming the key, and what there is.
        """
        for key, feature in self.config.input_features.items():
            value = batch.get(key)
            if value is None:
                there = sorted(k for k in batch if k.startswith("observation."))
                raise DetectorError(
                    f"the monitor reads {key}, which the environment does not give; it gives {there}. Use a "
                    "monitor trained on these, or the cameras and obs_type that this one was trained on "
                    f"({sorted(self.config.input_features)})"
                )
            width = tuple(value.shape[1:]) if feature.type is not FeatureType.VISUAL else value.shape[1:2]
            wanted = tuple(feature.shape) if feature.type is not FeatureType.VISUAL else feature.shape[:1]
            if tuple(width) != tuple(wanted):
                raise DetectorError(
                    f"the monitor was trained on {key} of shape {tuple(feature.shape)}; here it is "
                    f"{tuple(value.shape[1:])}. Use a monitor of this platform"
                )

    # --- saving

    def add_trained_on(self, earlier: dict[str, Any]) -> None:
        """Adds what the weights that were loaded had been trained on before."""
        if earlier:
            scenarios = {**earlier["scenarios"], **self.trained_on.get("scenarios", {})}
            self.trained_on = {**earlier, **self.trained_on, "scenarios": scenarios}

    def push_model_to_hub(self, cfg: TrainPipelineConfig, **_: Any) -> None:
        """Uploads weights, configs and a card.

        `lerobot-train` 0.6.1 calls this with `state_dict` and `dataset_meta`, which the base class does not
        take, and would fail after the last training step (lerobot/rewards/pretrained.py against
        lerobot/scripts/lerobot_train.py). Both are None or of no use here.
        """
        api = HfApi()
        repo_id = api.create_repo(self.config.repo_id, private=self.config.private, exist_ok=True).repo_id
        with TemporaryFolder("upload") as temporary:
            folder = temporary / "monitor"
            self.save_pretrained(folder)
            cfg.save_pretrained(folder)
            (folder / "README.md").write_text(self.card(cfg.dataset.repo_id), encoding="utf-8")
            commit = api.upload_folder(
                repo_id=repo_id,
                folder_path=folder,
                commit_message="Upload recovery monitor, train config and readme",
                allow_patterns=["*.safetensors", "*.json", "*.md"],
            )
        # `lerobot.jobs.hf.submit_to_hf` waits for this very line.
        logger.info("Model pushed to %s", commit.repo_url.url)

    def card(self, dataset: str) -> str:
        tags = sorted({*(self.config.tags or ()), "robotics", "lerobot", "reward-model", "roborecover"})
        head = ["---", f"license: {self.config.license or 'apache-2.0'}", "library_name: lerobot"]
        head += ["pipeline_tag: robotics", "tags:", *(f"- {t}" for t in [*tags, self.config.type])]
        base = getattr(self.config, "base_model", "")
        if base.count("/") == 1 and not Path(base).exists():
            head += [f"base_model: {base}"]
        reads = "\n".join(f"- `{k}` {tuple(f.shape)}" for k, f in self.config.input_features.items())
        return "\n".join(head) + (
            f"\n---\n\n# Recovery monitor `{self.config.type}`\n\nSays of each observation whether execution "
            f"has gone wrong (1) or not (0). Trained on `{dataset}`. It reads\n\n{reads}\n\n```bash\n"
            "lerobot-eval --env roborecover_libero --policy.type=roborecover_intervention \\\n"
            "  --policy.mode=monitor_reversion --policy.base.path=POLICY \\\n"
            f"  --policy.monitor.path={self.config.repo_id}\n```\n"
        )


def choose_features(config: Any, features: Mapping[str, Mapping[str, Any]]) -> None:
    """Fills `config.input_features` from a dataset, or checks the dataset against them.

    Args:
        config: with `inputs`; none means every key that the monitor can read.
        features: of the dataset, by column.

    Raises:
        DetectorError: the dataset lacks an input, or has it in another shape.
    """
    there = dataset_to_policy_features({k: dict(f) for k, f in features.items()})
    known = {k: f for k, f in there.items() if config.can_read(k, f)}
    if not config.input_features:
        wanted = [k.strip() for k in config.inputs.split(",") if k.strip()] or list(known)
        missing = [k for k in wanted if k not in known]
        if missing or not wanted:
            raise DetectorError(
                f"--reward_model.inputs={config.inputs}: the dataset has no "
                f"{missing[0] if missing else 'input'} that {config.type} can read; it has {sorted(known)}"
            )
        config.input_features = {k: known[k] for k in wanted}
    for key, feature in config.input_features.items():
        own = known.get(key)
        axes = slice(0, 1) if feature.type is FeatureType.VISUAL else slice(None)
        if own is None or tuple(own.shape)[axes] != tuple(feature.shape)[axes]:
            raise DetectorError(
                f"the monitor reads {key} of shape {tuple(feature.shape)}; the dataset has "
                f"{ {k: tuple(f.shape) for k, f in known.items()} }"
            )
    config.output_features = {"label": PolicyFeature(FeatureType.REWARD, (1,))}


def _scenarios_of(dataset_meta: Any) -> dict[str, Any]:
    """Scenarios of a dataset that `roborecover detect data` made; empty for any other."""
    from lerobot_roborecover.datasets.schema import FOLDER
    from lerobot_roborecover.datasets.trajectories import TRAJECTORIES_FILE, read_trajectories

    root = Path(dataset_meta.root)
    if not (root / FOLDER / TRAJECTORIES_FILE).is_file():
        logger.warning(
            "%s has no %s/%s: the checkpoint will not know which scenarios it was trained on",
            root, FOLDER, TRAJECTORIES_FILE,
        )  # fmt: skip
        return {}
    found = read_trajectories(root)
    return {
        "dataset": dataset_meta.repo_id,
        "labels": dict(found.manifest["counts"]["labels"]),
        "scenarios": {link.id: link.sha256 for link in found.scenarios},
    }
