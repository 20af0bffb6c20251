"""What a policy's answer must be before anything is computed with it: one account for every policy and loop.

Nothing is repaired. An array of one row or one column would be broadcast to the size that was wanted, and
NumPy drops the imaginary part of a complex number: such actions would run, and would not be the policy's.

1. Tensors, as a policy returns them: `tensor_problem`, before its postprocessor.
2. Rows of a batch: `count_problem`, before each trial gets its own.
3. A trial's chunk: `chunk_problem`, before its first action is executed.
4. An action: `action_problem`, when it is its turn.

Needs numpy only; tensors are read by their `shape` and `dtype`.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from lerobot_roborecover.scenario import TrialStart

_REAL = re.compile(r"b?float\d+\w*|u?int\d+")
"""Names of the data types of real numbers, in NumPy and in torch."""


def type_problem(values: Any) -> str:
    """Returns why an array or tensor does not hold real numbers; empty if it does."""
    shape, dtype = getattr(values, "shape", None), getattr(values, "dtype", None)
    if shape is None or dtype is None:
        return (
            f"the policy gave a {type(values).__name__} where an array of actions was expected. Return an "
            "array or a tensor of float32"
        )
    name = str(dtype).removeprefix("torch.")
    if not _REAL.fullmatch(name):
        return (
            f"the policy gave actions of type {name}; actions are real numbers. Return them as float32, "
            "without an imaginary part"
        )
    return ""


def tensor_problem(values: Any, batch: int, ndim: int, width: int | None) -> str:
    """Returns why what a policy computed for a batch cannot be used; empty if it can.

    Args:
        values: (batch, width) tensor of one action a trial, or (batch, n, width) of chunks. It may be wider:
            policies pad actions, and their postprocessors cut them.
        batch: observations that the policy was given.
        ndim: 2 or 3.
        width: of the actions that the policy's configuration declares; None where it declares none.
    """
    problem = type_problem(values)
    if problem:
        return problem
    shape = tuple(values.shape)
    wanted = f"({batch}, {'' if ndim == 2 else 'n, '}{'width' if width is None else width})"
    given = f"the policy gave actions of shape {shape} for a batch of {batch}"
    if len(shape) != ndim or shape[0] != batch or 0 in shape:
        return f"{given}; expected {wanted}. Return the actions of every observation, in their order"
    if width is not None and shape[-1] < width:
        return (
            f"{given}; expected {wanted}, as its configuration declares. Check the output layer against "
            "output_features"
        )
    return ""


def count_problem(given: int, asked: int) -> str:
    """Returns why answers cannot be distinguished; empty if there is one for each trial.

    Args:
        given: answers, or rows of actions.
        asked: trials.
    """
    if given == asked:
        return ""
    return (
        f"the policy gave {given} rows of actions for {asked} trials; expected {asked}. Return the actions "
        "of every observation, in their order"
    )


def chunk_problem(scenario: TrialStart, chunk: Any, width: int) -> str:
    """Returns why a trial's chunk of actions cannot be executed; empty if it can.

    Args:
        scenario: of the trial.
        chunk: expected to be (n, width), n at least 1. Its numbers are checked when they are executed.
        width: values in an action.
    """
    problem = type_problem(chunk)
    if problem:
        return problem
    if chunk.ndim != 2 or not len(chunk):
        return (
            f"the policy gave a chunk of shape {chunk.shape}; expected (n, {width}), with n at least 1. "
            "Return at least one action"
        )
    return "" if chunk.shape[1] == width else action_problem(scenario, chunk[0], width)


def action_problem(scenario: TrialStart, action: np.ndarray, width: int) -> str:
    """Returns why an action cannot be sent to the scenario's simulator; empty if it can."""
    if action.shape != (width,):
        return (
            f"the policy gave an action of shape {action.shape}; platform {scenario.platform} takes "
            f"({width},). Check that the checkpoint was trained for this platform"
        )
    problem = type_problem(action)
    if not problem and not np.isfinite(action).all():
        return (
            f"the policy gave a non-finite action {action.tolist()}; it was not sent to the simulator. Check "
            "its normalisation statistics, and half precision"
        )
    return problem
