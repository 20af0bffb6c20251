"""A policy that is a Python callable: `(observation, instruction) -> action or chunk`.

A function is stateless and shared by all trials. A class, or a function without arguments that returns a
policy, gives each trial an instance of its own. An object with a `reset()` method keeps one history, so it
runs one trial at a time and is reset at each handoff.

Python's, NumPy's and torch's global generators start from the trial's seed and are kept per trial. A policy
that draws from them gives the same trial whatever other trials run.
"""

from __future__ import annotations

import inspect
import logging
import random
import secrets
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.logs.fields import CALLABLE, OBJECT
from lerobot_roborecover.policies.action_checks import type_problem
from lerobot_roborecover.policies.callable_identity import UnhashableError, callable_hash
from lerobot_roborecover.policies.metadata import PolicyMetadata
from lerobot_roborecover.policies.runner import Chunk, PolicyError

logger = logging.getLogger(__name__)

type PolicyFunction = Callable[[dict[str, Any], str], Any]
"""Takes a raw observation (arrays without a batch dimension) and the instruction; returns (A,) or (n, A)."""


def is_callable_policy(policy: Any) -> bool:
    """Returns whether a policy is a callable, not a LeRobot policy."""
    lerobots = isinstance(getattr(policy, "config", None), PreTrainedConfig)
    return callable(policy) and not lerobots


def makes_instances(policy: Callable[..., Any]) -> bool:
    """Returns whether each trial gets an instance: `policy` is a class, or takes no arguments.

    Raises:
        OptionError: it takes neither (observation, instruction) nor no arguments.
    """
    takes_none, takes_two = _accepts(policy), _accepts(policy, None, None)
    if inspect.isclass(policy) and takes_none:
        return True
    if takes_two and not inspect.isclass(policy):
        return False
    if takes_none:
        return True
    wanted = "no arguments" if inspect.isclass(policy) else "(observation, instruction), or no arguments"
    raise OptionError(
        f"policy={_name(policy)}: must be callable with {wanted}. Bind the others, for example with "
        "functools.partial(policy, model=model)"
    )


def keeps_history(policy: Callable[..., Any]) -> bool:
    """Returns whether one object keeps a history that trials cannot share: it has `reset()`."""
    return not makes_instances(policy) and callable(getattr(policy, "reset", None))


def callable_metadata(policy: Callable[..., Any], name: str, **others: Any) -> PolicyMetadata:
    """Returns the metadata of a run of a callable.

    Args:
        policy: see the module.
        name: its name in the rows.
        others: further fields of `PolicyMetadata`.

    Raises:
        OptionError: it has no name.
    """
    if not name:
        raise OptionError(
            f"policy={_name(policy)}: a callable needs a name in the rows: evaluate(..., name=NAME)"
        )
    if keeps_history(policy):
        policy.reset()  # ty: ignore[missing-attribute] - an earlier trial's history is no part of the policy
    try:
        identity = f"{CALLABLE}@{callable_hash(policy)[:12]}"
    except UnhashableError as err:
        identity = f"{CALLABLE}@run-{secrets.token_hex(6)}"
        logger.warning(
            "policy %s cannot be identified (%s): its rows are not reused by a later run",
            name,
            err,
        )
    settings = {"policy_type": CALLABLE, OBJECT: identity}
    return PolicyMetadata(policy=name, policy_type=CALLABLE, policy_settings=settings, **others)


@dataclass
class CallableState:
    """State that the policy side keeps for one trial."""

    seed: int | None
    """The trial's; None where the run has none."""
    policy: PolicyFunction | None = None
    """Fresh, made or reset at the trial's first observation."""
    generators: tuple[Any, ...] | None = None
    """States of the global generators for the trial's next call; None before the first."""


class CallableRunner:
    """Asks a callable, trial by trial (`policies.runner.PolicyRunner`).

    Args:
        policy: see the module.
        width: A, values in an action.
        max_batch: trials asked for at once, at most; each is asked alone.
    """

    batched = False

    def __init__(self, policy: Callable[..., Any], width: int, max_batch: int = 64):
        self._policy, self._width, self.max_batch = policy, width, max_batch
        self._makes_instances = makes_instances(policy)
        self._raised: set[str] = set()

    def noise(self, seed: int | None) -> str:
        """How noise is drawn; the value of `TrialRow.noise`."""
        return "unseeded" if seed is None else "per_trial"

    def start(self, seed: int | None) -> CallableState:
        """Fresh history for a trial of that seed."""
        return CallableState(seed)

    def finish(self, history: CallableState) -> None:
        """Drops the trial's instance."""
        history.policy = None

    def act(
        self,
        observations: Sequence[Mapping[str, Any]],
        instructions: Sequence[str],
        histories: Sequence[CallableState],
    ) -> list[Chunk | PolicyError]:
        """One chunk of actions (n, A) per trial; an error in place of each for which the policy raised."""
        return [self._ask(*one) for one in zip(observations, instructions, histories, strict=True)]

    def _ask(
        self, observation: Mapping[str, Any], instruction: str, history: CallableState
    ) -> Chunk | PolicyError:
        try:
            with _generators(history):
                if history.policy is None:
                    history.policy = self._fresh()
                answer = history.policy(dict(observation), instruction)
            return as_chunk(answer, self._width)
        except PolicyError as err:
            return err
        except Exception as err:  # a policy may raise anything, and it costs its trial alone
            told = f"{type(err).__name__}: {err}"
            logger.warning("the policy raised %s", told, exc_info=told not in self._raised)
            self._raised.add(told)
            return PolicyError(told)

    def _fresh(self) -> PolicyFunction:
        policy = self._policy() if self._makes_instances else self._policy
        if not callable(policy):
            raise PolicyError(
                f"{_name(self._policy)}() returned a {type(policy).__name__}, which cannot be called. Return "
                "a policy: a callable that takes (observation, instruction)"
            )
        reset = getattr(policy, "reset", None)
        if callable(reset):
            reset()
        return policy


def as_chunk(answer: Any, width: int) -> np.ndarray:
    """Returns a callable's answer as (n, A) float32 or float64.

    Args:
        answer: an array, tensor or list of numbers: (A,) for one action, (n, A) for a chunk.
        width: A.

    Raises:
        PolicyError: it holds no real numbers, or has another shape.
    """
    if isinstance(answer, torch.Tensor):
        answer = answer.detach().cpu()
        answer = answer.float() if answer.dtype in (torch.bfloat16, torch.float16) else answer
    elif answer is None:
        raise PolicyError("the policy returned None. Return an action: an array of numbers")
    try:
        values = np.asarray(answer)
    except (TypeError, ValueError) as err:
        raise PolicyError(f"the policy returned a {type(answer).__name__} that is no array: {err}") from None
    if problem := type_problem(values):
        raise PolicyError(problem)
    if values.ndim == 1:
        values = values[None]
    if values.ndim != 2 or values.shape[1] != width or not len(values):
        raise PolicyError(
            f"the policy returned an array of shape {np.shape(answer)}; expected ({width},) for one action, "
            f"or (n, {width}) for a chunk of n actions"
        )
    if values.dtype in (np.float32, np.float64):
        return values
    return values.astype(np.float32 if values.dtype == np.float16 else np.float64)


@contextmanager
def _generators(history: CallableState) -> Generator[None]:
    """Sets the global generators to where the trial left them; `untouched` of the caller puts them back."""
    if history.seed is None:
        yield
        return
    gpus = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else ()
    if history.generators is None:
        random.seed(history.seed)
        np.random.seed(history.seed % 2**32)
        torch.manual_seed(history.seed)
    else:
        python, numpy, cpu, cuda = history.generators
        random.setstate(python)
        np.random.set_state(numpy)
        torch.set_rng_state(cpu)
        for gpu, state in zip(gpus, cuda, strict=False):
            torch.cuda.set_rng_state(state, gpu)
    try:
        yield
    finally:
        cuda = [torch.cuda.get_rng_state(gpu) for gpu in gpus]
        history.generators = random.getstate(), np.random.get_state(), torch.get_rng_state(), cuda


def _accepts(policy: Callable[..., Any], *arguments: Any) -> bool:
    try:
        inspect.signature(policy).bind(*arguments)
    except TypeError:
        return False
    except ValueError:  # a builtin that does not tell its arguments
        return bool(arguments)
    return True


def _name(policy: Any) -> str:
    return getattr(policy, "__qualname__", None) or type(policy).__name__
