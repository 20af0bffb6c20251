"""What numbers tell about a mistake: a checkpoint's statistics against states, recorded actions and pictures.

A recovery point is off nominal by design, so a value outside of the training data's range is a warning; only
what no deviation explains is a failure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.findings import Check, failure, ok, warning

type Stats = Mapping[str, np.ndarray]
"""Of one feature: `mean`, `std`, `min`, `max`, `q01`, `q99`, as far as a checkpoint has them."""

_MARGIN = 0.5
"""Of a range, that a value may be outside of it."""
_CLEAR = 0.3
"""Mean of a gripper command from which on it says which way the gripper goes."""


def bounds(stats: Stats) -> tuple[np.ndarray, np.ndarray] | None:
    """Lowest and highest values to be expected; None where the statistics do not say."""
    for low, high in (("min", "max"), ("q01", "q99")):
        if low in stats and high in stats:
            return np.ravel(stats[low]), np.ravel(stats[high])
    if "mean" in stats and "std" in stats:
        mean, std = np.ravel(stats["mean"]), np.ravel(stats["std"])
        return mean - 3 * std, mean + 3 * std
    return None


def statistics_problem(stats: Stats | None, needed: Sequence[str], width: int) -> str:
    """Why a feature cannot be normalised with its statistics; empty if it can.

    Args:
        stats: of the feature; None where the checkpoint has none.
        needed: which ones the normalisation mode reads.
        width: values in the feature.
    """
    if not stats:
        return "there are none: LeRobot then passes the values on as they are"
    missing = [name for name in needed if name not in stats]
    if missing:
        return f"{' and '.join(missing)} missing"
    for name in needed:
        values = np.ravel(stats[name])
        if len(values) != width:
            return f"{name} has {len(values)} values, the feature {width}"
        if not np.isfinite(values).all():
            return f"{name} is not finite in dimensions {np.flatnonzero(~np.isfinite(values)).tolist()}"
    low, high = (np.ravel(stats[n]) for n in needed)
    if list(needed) == ["mean", "std"]:
        if (high < 0).any():
            return f"std is negative in dimensions {np.flatnonzero(high < 0).tolist()}"
        if (high < 1e-8).all():
            return "std is 0 in every dimension"
    elif (low > high).any():
        wrong = np.flatnonzero(low > high).tolist()
        return f"{needed[0]} is above {needed[1]} in dimensions {wrong}"
    elif np.allclose(low, high):
        return f"{needed[0]} and {needed[1]} are the same in every dimension"
    return ""


def check_states(states: np.ndarray, stats: Stats | None, platform: str) -> Check:
    """Robot states of the first steps against those of the training data.

    Args:
        states: (T, D), as they reach the policy's normaliser.
        stats: the checkpoint's.
        platform: `libero`, ...
    """
    name = "states fit the training data"
    limits = bounds(stats) if stats else None
    if limits is None or len(limits[0]) != states.shape[1]:
        return ok(name, "not checked: the checkpoint has no statistics of states of this width")
    outside = _outside(states, *limits).mean(0) > 0.5
    if not outside.any():
        return ok(
            name,
            f"all {states.shape[1]} values of observation.state within half a range of theirs; no other "
            "state is compared",
        )
    dims = np.flatnonzero(outside)
    low, high = limits
    shown = ", ".join(
        f"{d}: {states[:, d].mean():.3g} (trained on {low[d]:.3g} to {high[d]:.3g})" for d in dims[:4]
    )
    rotation = platform_named(platform).axis_angle.get(states.shape[1])
    if rotation is not None and set(dims) & set(rotation):
        other = states.copy()
        other[:, rotation] = other_axis_angle(states[:, rotation])
        if not (_outside(other, *limits).mean(0) > 0.5)[list(rotation)].any():
            return failure(
                name,
                f"the rotation, {shown}, fits only with its angle counted the other way round (2 pi less)",
                "axis-angle of robosuite's quaternion as it comes, not of its antipode",
                "the checkpoint was trained with another quaternion convention: convert its training data's "
                "states, or turn the state in its preprocessor. Published policies lost 14 to 40 points to "
                "this",
            )
    if outside.mean() > 0.5:
        return failure(
            name,
            f"{len(dims)} of {len(outside)} values far outside: {shown}",
            "states of the training data's kind: same robot, same units, same order",
            "the checkpoint is of another robot, or reads another state (end effector or joints, metres or "
            "radians, order of values). Compare with the env's state in docs/servers.md",
        )
    return warning(
        name,
        f"{len(dims)} of {len(outside)} values far outside: {shown}",
        "inside the training data's range, widened by half of it",
        "a recovery point may be that far off; if other scenarios are too (--env.select), the state's units, "
        "order or convention differ",
    )


def other_axis_angle(rotations: np.ndarray) -> np.ndarray:
    """(T, 3) axis-angles of the same rotations, from the antipodal quaternions."""
    angles = np.linalg.norm(rotations, axis=1, keepdims=True)
    axes = rotations / np.maximum(angles, 1e-9)
    return axes * (angles - 2 * np.pi)


def check_recorded_actions(recorded: np.ndarray, stats: Stats | None) -> Check:
    """Recorded prefixes against the actions that the checkpoint was trained on.

    Args:
        recorded: (N, A) actions of the chosen scenarios' prefixes.
        stats: the checkpoint's.
    """
    name = "recorded actions fit the training data"
    if not stats or (limits := bounds(stats)) is None or len(limits[0]) != recorded.shape[1]:
        return ok(name, "not checked: the checkpoint has no statistics of actions of this width")
    low, high = limits
    spread = np.maximum(recorded.std(0), 1e-6)
    trained = np.ravel(stats["std"]) if "std" in stats else (high - low) / 4
    ratio = np.log10(np.maximum(trained, 1e-6) / spread)
    share = _outside(recorded, low, high).mean()
    value = f"{share:.0%} of {len(recorded)} x {recorded.shape[1]} values far outside"
    if (np.abs(ratio) > 1).mean() > 0.5:
        return failure(
            name,
            f"{value}; they spread {10 ** -np.median(ratio):.3g} times as far",
            "the same order of magnitude",
            "the checkpoint's actions are in other units or of another kind (deltas or absolute, joints or "
            "end effector): see --env.control_mode and --env.action_mode",
        )
    if share > 0.3:
        return warning(
            name, value, "under 30 %",
            "perturbed prefixes leave the range; natural ones should not. Compare --env.control_mode and "
            "--env.action_mode with what the checkpoint was trained on",
        )  # fmt: skip
    return ok(name, value)


def check_gripper(recorded: np.ndarray, stats: Stats | None, columns: Sequence[int], turned: bool) -> Check:
    """Whether the checkpoint's gripper commands run the way of the simulator's.

    Args:
        recorded: (N, A) actions of the chosen scenarios' prefixes.
        stats: the checkpoint's, before any processor turns the gripper.
        columns: where the gripper is.
        turned: whether a processor of the checkpoint converts the gripper.
    """
    name = "gripper"
    limits = bounds(stats) if stats else None
    if not stats or limits is None or len(limits[0]) != recorded.shape[1] or "mean" not in stats:
        return ok(name, "not checked: the checkpoint has no statistics of actions of this width")
    low, high = limits
    mean = np.ravel(stats["mean"])
    for c in columns:
        ours = (recorded[:, c].min(), recorded[:, c].max())
        if turned:
            continue
        if low[c] >= -0.01 and ours[0] < -0.5:
            return failure(
                name, f"trained on {low[c]:.2g} to {high[c]:.2g}", f"{ours[0]:.2g} to {ours[1]:.2g}",
                "the simulator takes -1 (open) to 1 (close), the checkpoint gives 0 to 1: without a "
                "processor that converts (Fast-WAM's: policy.toggle_action_dimensions) it never opens",
            )  # fmt: skip
        if mean[c] * recorded[:, c].mean() < 0 and min(abs(mean[c]), abs(recorded[:, c].mean())) > _CLEAR:
            return warning(
                name,
                f"mean {mean[c]:+.2f} in training, {recorded[:, c].mean():+.2f} in the recorded prefixes",
                "the same sign",
                "if the checkpoint was trained with 1 for open, its gripper does the opposite here: turn the "
                "sign in its postprocessor. Prefixes that hold something nearly always also look like this",
            )
    return ok(name, "converted by a processor" if turned else "range and sign as in the recorded prefixes")


def check_executed(actions: np.ndarray, platform: str) -> Check:
    """Actions of the first steps, as they were sent to the simulator.

    Args:
        actions: (T, A).
        platform: `libero`, ...
    """
    name = "actions"
    value = f"{len(actions)} of width {actions.shape[1]}, from {actions.min():.3g} to {actions.max():.3g}"
    arm = np.delete(actions, platform_named(platform).grippers(actions.shape[1]), axis=1)
    if platform_named(platform).action_bound <= 1 and (np.abs(arm) > 1).mean() > 0.5:
        return warning(
            name, value, "mostly between -1 and 1, beyond which the simulator cuts",
            "actions look as if they were not brought to the simulator's scale: check the postprocessor's "
            "statistics, and relative against absolute actions (--env.control_mode)",
        )  # fmt: skip
    if len(actions) > 1 and np.abs(arm).max() < 1e-4:
        return warning(
            name, value, "some movement",
            "the policy hardly moves: check the weights and the postprocessor's statistics",
        )  # fmt: skip
    return ok(name, value)


def check_upright(seen: np.ndarray, upright: np.ndarray, key: str) -> Check:
    """Whether a picture reaches the policy the way LeRobot's data has it.

    Args:
        seen: (3, H, W), as the policy's own processor gets it.
        upright: (H, W, 3) uint8, the simulator's picture turned as LeRobot's datasets are.
        key: whose picture.
    """
    name = f"picture {key}"
    pictures = [p.reshape(-1) - p.mean() for p in (seen, np.moveaxis(upright, -1, 0) / 255.0)]
    if pictures[0].shape != pictures[1].shape or min(np.abs(p).max() for p in pictures) < 1e-6:
        return ok(name, "not checked: another size than the camera's, or without content")
    as_seen = _correlation(*pictures)
    turned = seen[:, ::-1, ::-1]
    if _correlation(turned.reshape(-1) - turned.mean(), pictures[1]) > as_seen + 0.05:
        return failure(
            name, "upside down", "turned by 180 degrees, as in LeRobot's LIBERO data",
            "the observation processor did not turn it. Use --env.type=roborecover_libero as it is, and no "
            "processor of the checkpoint's that turns pictures again",
        )  # fmt: skip
    return ok(name, "upright" if as_seen > 0.9 else f"as the camera gives it (correlation {as_seen:.2f})")


def check_cameras_by_colour(colours: Mapping[str, np.ndarray], stats: Mapping[str, Stats]) -> Check | None:
    """Whether two cameras look more like each other's training pictures than like their own.

    Args:
        colours: mean (3,) colour of each camera's picture.
        stats: the checkpoint's, by camera; `mean` is the training pictures' mean colour.

    Returns:
        None where the checkpoint does not know how its cameras looked.
    """
    known = {k: np.ravel(stats[k]["mean"]) for k in colours if k in stats and "mean" in stats[k]}
    known = {k: v for k, v in known.items() if v.shape == (3,) and np.isfinite(v).all()}
    if len(known) < 2 or np.ptp(np.stack(list(known.values())), axis=0).max() < 0.03:
        return None
    names = list(known)
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            own = np.abs(colours[a] - known[a]).sum() + np.abs(colours[b] - known[b]).sum()
            swapped = np.abs(colours[a] - known[b]).sum() + np.abs(colours[b] - known[a]).sum()
            if swapped < 0.5 * own and own > 0.1:
                return warning(
                    "cameras by colour",
                    f"{a} and {b} look like each other's training pictures ({swapped:.2f} off swapped, "
                    f"{own:.2f} as they are)",
                    "each camera nearest to its own training pictures",
                    "the two are probably swapped: check --rename_map and --env.camera_name",
                )
    return ok("cameras by colour", "each nearest to its own training pictures")


def _outside(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    room = np.maximum(_MARGIN * (high - low), 1e-3)
    return (values < low - room) | (values > high + room)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-12))
