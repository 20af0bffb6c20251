"""Why a checkpoint cannot be evaluated, in words, where LeRobot's own say little."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager

from lerobot.configs import PreTrainedConfig
from lerobot.utils.constants import ACTION

from lerobot_roborecover.errors import OptionError, RoboRecoverError
from lerobot_roborecover.policies.checkpoint import is_other_width
from lerobot_roborecover.policies.command_line import plain_output
from lerobot_roborecover.utils.text import install_command


def error_words(err: Exception) -> str:
    """An error's message as one line, without LeRobot's general advice on mismatched features."""
    return " ".join(str(err).partition("Please ensure your dataset and policy")[0].split())


def load_remedy(err: Exception, inputs: str = "") -> str:
    """What to do about an error that loading raised; empty where its own message is the best there is.

    Args:
        err: what was raised.
        inputs: what gives the inputs that the environment lacks, where that is known.
    """
    text, kind = str(err).lower(), {c.__name__ for c in type(err).__mro__}
    if "error(s) in loading state_dict" in text:
        return "config.json and the weights are of different policies, or of another LeRobot: copy both again"
    if "processor" in text and (
        "not found" in text or "migrat" in text or isinstance(err, FileNotFoundError)
    ):
        return (
            "the checkpoint has no processor files (policy_preprocessor.json, policy_postprocessor.json). "
            "Take them from where it was trained, or migrate an old one: python -m "
            "lerobot.processor.migrate_policy_normalization --pretrained-path CHECKPOINT"
        )
    if "feature" in text and "mismatch" in text:
        return inputs or "the checkpoint's cameras are not the environment's: take another checkpoint"
    if "SafetensorError" in kind:
        return "its weights are damaged: copy or download the checkpoint again"
    if kind & {"HfHubHTTPError", "LocalEntryNotFoundError", "HFValidationError"} or "huggingface hub" in text:
        return "check the spelling, the network, HF_HUB_OFFLINE, and hf auth login for a private model"
    if isinstance(err, ImportError):
        return f"install what it names: {install_command('policies')} has LeRobot's families"
    if kind & {"OutOfMemoryError", "MemoryError"}:
        return "free memory there, or take another --policy.device"
    if isinstance(err, FileNotFoundError):
        return "the checkpoint is not whole: copy or download all of its files again"
    return ""


@contextmanager
def plain_loading(label: str, inputs: Callable[[], str] = str) -> Generator[None]:
    """Raises what loading a checkpoint fails with as one line, wherever there is a remedy to say.

    What LeRobot prints and means nothing is left out.

    Args:
        label: names the checkpoint.
        inputs: says what gives the inputs that the environment lacks.

    Raises:
        OptionError: in the words of the error, with the remedy.
    """
    try:
        with plain_output():
            yield
    except RoboRecoverError:
        raise
    except Exception as err:  # policies, and what they import, raise types of their own
        remedy = load_remedy(err, inputs())
        if not remedy:
            raise
        words = error_words(err).removesuffix(".")
        raise OptionError(f"{label}: {words:.300}. What to do: {remedy}") from err


def other_action_width(config: PreTrainedConfig, width: int) -> int | None:
    """The action width of a checkpoint for another robot; None where it fits, or does not say.

    Args:
        config: the checkpoint's configuration, before `make_policy` replaces its output by the env's.
        width: the env's.
    """
    feature = (getattr(config, "output_features", None) or {}).get(ACTION)
    if feature is None:
        return None
    own = int(feature.shape[0])
    padded = getattr(config, "max_action_dim", None)
    return own if is_other_width(getattr(config, "type", ""), own, padded, (width,)) else None
