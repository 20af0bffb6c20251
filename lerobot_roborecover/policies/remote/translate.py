"""One slot's observation in the server's words, and its answer in ours, as a mapping says."""

from __future__ import annotations

from collections.abc import Mapping as Map
from collections.abc import Sequence
from typing import Any

import numpy as np
from PIL import Image

from lerobot_roborecover.policies.action_checks import type_problem
from lerobot_roborecover.policies.remote.errors import MappingError, WireError
from lerobot_roborecover.policies.remote.mapping import ImageEntry, Mapping, StateEntry

_MAX_ROWS = 10_000


class Translator:
    """A mapping at work.

    Args:
        mapping: checked.
        execute: actions executed per request; None leaves it to the mapping.
        width: values in an action of the environment; None where it is not known.
    """

    def __init__(self, mapping: Mapping, execute: int | None = None, width: int | None = None):
        self.mapping = mapping
        self.flags: frozenset[str] = frozenset()
        """What the server asked for; entries that want something else are left out."""
        self._width = width
        self.execute = execute or mapping.actions.execute

    @property
    def frames(self) -> int:
        """Observations that a request holds."""
        return self.mapping.window.frames if self.mapping.window else 1

    def frame(self, observation: Map[str, np.ndarray]) -> dict[str, Any]:
        """The pictures and states of one observation.

        Args:
            observation: of one slot, after the env's processor: pictures (3, H, W) float from 0 to 1, vectors
                float.

        Raises:
            MappingError: the observation lacks something, or has another shape.
        """
        if self.mapping.native:
            return {key: _native(key, value) for key, value in observation.items()}
        out: dict[str, Any] = {}
        for image in (i for i in self.mapping.images if holds(i.when, self.flags)):
            _put(out, image.under, image.key, _picture(image, observation))
        for state in (s for s in self.mapping.state if holds(s.when, self.flags)):
            _put(out, state.under, state.key, _vector(state, observation))
        return out

    def request(self, frames: Sequence[dict[str, Any]], task: str) -> dict[str, Any]:
        """A request.

        Args:
            frames: of `frame`, oldest first; as many as `self.frames` says.
            task: the instruction.
        """
        window, prompt = self.mapping.window, self.mapping.prompt
        text = task.lower() if prompt.lower else task
        if window:
            out = {window.key: list(frames)} if window.key else self._stacked(frames)
        else:
            out = {k: dict(v) if isinstance(v, dict) else v for k, v in frames[-1].items()}
        out |= self.mapping.constants
        worded: Any = [text] if prompt.as_list else text
        _put(out, prompt.under, prompt.key, [worded] if prompt.batch_axis else worded)
        return out

    def _stacked(self, frames: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """One map of all frames, which follow each other along the time axes."""
        out: dict[str, Any] = {}
        for entry in (*self.mapping.images, *self.mapping.state):
            if holds(entry.when, self.flags):
                parts = [(f[entry.under] if entry.under else f)[entry.key] for f in frames]
                whole = np.concatenate(parts, axis=int(entry.batch_axis)) if entry.time_axis else parts[-1]
                _put(out, entry.under, entry.key, whole)
        return out

    def actions(self, answer: Any) -> np.ndarray:
        """(n, A) float32 actions to execute.

        Args:
            answer: unpacked.

        Raises:
            WireError: it holds no such actions.
        """
        rule = self.mapping.actions
        chunk = self._chunk(answer)
        if rule.columns is not None:
            if max(rule.columns) >= chunk.shape[1]:
                raise WireError(
                    f"the server gave actions of width {chunk.shape[1]}; the mapping executes columns "
                    f"{list(rule.columns)}"
                )
            chunk = chunk[:, rule.columns]
        if self._width is not None and chunk.shape[1] != self._width:
            raise WireError(
                f"the server gave actions of width {chunk.shape[1]}; the environment takes {self._width}. It "
                "was trained for another platform or action mode, or the mapping lacks 'columns'"
            )
        chunk = chunk.astype(np.float32 if chunk.dtype.itemsize <= 4 else np.float64)
        for values, apply in ((rule.scale, np.multiply), (rule.offset, np.add)):
            if values is not None:
                if len(values) != chunk.shape[1]:
                    raise WireError(
                        f"the server gave actions of width {chunk.shape[1]}; the mapping's scale or offset "
                        f"has {len(values)} numbers"
                    )
                chunk = apply(chunk, values)
        for grip in rule.gripper:
            if not -chunk.shape[1] <= grip.column < chunk.shape[1]:
                raise WireError(f"actions of width {chunk.shape[1]} have no gripper column {grip.column}")
            column = chunk[:, grip.column]
            if grip.threshold is not None:
                column = np.where(column > grip.threshold, grip.above, grip.below)
            chunk[:, grip.column] = column * grip.scale + grip.offset
        return np.ascontiguousarray(chunk, dtype=np.float32)

    def _chunk(self, answer: Any) -> np.ndarray:
        rule = self.mapping.actions
        if rule.joined is not None and isinstance(answer, dict) and rule.key not in answer:
            parts = [_rows(answer, key) for key in rule.joined.keys]
            if len({len(p) for p in parts}) > 1 or max(rule.joined.columns) >= sum(p.shape[1] for p in parts):
                raise WireError(
                    f"the server's {list(rule.joined.keys)} have shapes {[p.shape for p in parts]}; the "
                    f"mapping takes columns {list(rule.joined.columns)} of them"
                )
            chunk = np.concatenate(parts, axis=1)[:, rule.joined.columns]
        else:
            chunk = _rows(answer, rule.key)
        if self.execute is not None:
            if len(chunk) < self.execute:
                raise WireError(
                    f"the server gave {len(chunk)} actions, fewer than the {self.execute} that are executed "
                    "before it is asked again; lower --policy.n_action_steps"
                )
            chunk = chunk[: self.execute]
        if not np.isfinite(chunk).all():
            row = int(np.argmin(np.isfinite(chunk).all(1)))
            raise WireError(f"the server gave a non-finite action, the {row}th of its chunk: {chunk[row]}")
        return chunk


def _rows(answer: Any, key: str) -> np.ndarray:
    if not isinstance(answer, dict) or key not in answer:
        seen = sorted(map(str, answer)) if isinstance(answer, dict) else type(answer).__name__
        raise WireError(f"the server's answer has no {key!r}; it has {seen!r:.300}")
    rows = answer[key]
    if not isinstance(rows, np.ndarray):
        raise WireError(f"the server's {key!r} is a {type(rows).__name__}, not an array")
    if problem := type_problem(rows):
        raise WireError(f"the server's {key!r}: {problem}")
    if rows.ndim == 3 and len(rows) == 1:
        rows = rows[0]
    if rows.ndim != 2 or not 1 <= len(rows) <= _MAX_ROWS or not 1 <= rows.shape[1] <= 1000:
        raise WireError(f"the server's {key!r} has shape {rows.shape}; actions are (n, width)")
    return rows


def resize(picture: np.ndarray, size: tuple[int, int], how: str) -> np.ndarray:
    """A picture at another size, as openpi's client resizes (Pillow, bilinear).

    Args:
        picture: (H, W, 3) uint8.
        size: (height, width).
        how: `pad` or `stretch`.
    """
    height, width = size
    if picture.shape[:2] == (height, width):
        return picture
    image = Image.fromarray(picture)
    if how == "stretch":
        return np.asarray(image.resize((width, height), Image.Resampling.BILINEAR))
    ratio = max(image.width / width, image.height / height)
    inner = int(image.width / ratio), int(image.height / ratio)
    canvas = Image.new("RGB", (width, height))
    corner = max(0, (width - inner[0]) // 2), max(0, (height - inner[1]) // 2)
    canvas.paste(image.resize(inner, Image.Resampling.BILINEAR), corner)
    return np.asarray(canvas)


def quat_xyzw(axis_angle: np.ndarray) -> np.ndarray:
    """(4,) float64 quaternion of an axis-angle vector whose angle is from 0 to 2 pi."""
    vector = np.asarray(axis_angle, np.float64)
    angle = float(np.linalg.norm(vector))
    if angle < 1e-9:
        return np.array([0.0, 0.0, 0.0, 1.0])
    return np.append(vector / angle * np.sin(angle / 2), np.cos(angle / 2))


def axis_angle_to_pi(axis_angle: np.ndarray) -> np.ndarray:
    """(3,) float64: the same rotation by an angle of at most pi."""
    vector = np.asarray(axis_angle, np.float64)
    angle = float(np.linalg.norm(vector))
    return vector * ((angle - 2 * np.pi) / angle) if angle > np.pi else vector


def holds(conditions: Sequence[str], flags: frozenset[str]) -> bool:
    """Whether all of `name` and `not name` hold.

    Args:
        conditions: of a mapping's `when`.
        flags: names that are true.
    """
    return all((c.removeprefix("not ") in flags) is not c.startswith("not ") for c in conditions)


_CONVERSIONS = {
    "none": np.asarray, "axis_angle_to_quat_xyzw": quat_xyzw, "axis_angle_to_pi": axis_angle_to_pi
}  # fmt: skip


def _put(out: dict[str, Any], under: str, key: str, value: Any) -> None:
    (out.setdefault(under, {}) if under else out)[key] = value


def _find(key: str, observation: Map[str, np.ndarray]) -> np.ndarray:
    if key not in observation:
        raise MappingError(
            f"the mapping wants {key!r}, and the environment gives {sorted(observation)}. Change the "
            "mapping's source, or the env's cameras and observation type"
        )
    return observation[key]


def _bytes(key: str, value: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 of a picture (3, H, W) float; exact where the float came from such bytes."""
    if value.ndim != 3 or value.shape[0] != 3 or value.dtype.kind != "f":
        raise MappingError(f"{key!r} is {value.dtype} of shape {value.shape}; a picture is (3, H, W) float")
    if not (value.min() >= 0.0 and value.max() <= 1.0):  # NaN fails too
        raise MappingError(
            f"{key!r} has values from {value.min()} to {value.max()}; pictures are from 0 to 1"
        )
    return np.ascontiguousarray(np.rint(value * 255).astype(np.uint8).transpose(1, 2, 0))


def _picture(entry: ImageEntry, observation: Map[str, np.ndarray]) -> np.ndarray:
    picture = _bytes(entry.source, _find(entry.source, observation))
    if entry.flip in ("vertical", "rotate_180"):
        picture = picture[::-1]
    if entry.flip in ("horizontal", "rotate_180"):
        picture = picture[:, ::-1]
    if entry.size is not None:
        picture = resize(np.ascontiguousarray(picture), entry.size, entry.resize)
    if entry.layout == "chw":
        picture = picture.transpose(2, 0, 1)
    if entry.dtype == "float32":
        picture = picture.astype(np.float32) / 255
    return np.ascontiguousarray(_with_axes(entry, picture))


def _vector(entry: StateEntry, observation: Map[str, np.ndarray]) -> np.ndarray:
    parts = []
    for part in entry.parts:
        vector = _find(part.source, observation)
        if vector.ndim != 1 or (part.slice is not None and part.slice[1] > len(vector)):
            raise MappingError(
                f"{part.source!r} has shape {vector.shape}; the mapping takes numbers "
                f"{list(part.slice or ())} of it"
            )
        vector = vector[slice(*part.slice)] if part.slice is not None else vector
        parts.append(_CONVERSIONS[part.convert](vector))
    whole = np.concatenate(parts).astype(entry.dtype)
    return _with_axes(entry, whole)


def _with_axes(entry: ImageEntry | StateEntry, value: np.ndarray) -> np.ndarray:
    return value.reshape((1,) * (entry.batch_axis + entry.time_axis) + value.shape)


def _native(key: str, value: np.ndarray) -> np.ndarray:
    """Pictures as the bytes they were rendered as: a quarter of the size, and the same floats at the other
    end."""
    if value.ndim == 3 and value.shape[0] == 3 and value.dtype == np.float32:
        return _bytes(key, value)
    return value
